"""Spec G5: ensembles are trained and asked on another device than the CPU."""

import numpy as np
import pytest
import torch
from corridor import Corridor
from far_device import FAR, FarTensor, far_device

from hypogoal.hypotheses.config import EnsembleConfig
from hypogoal.hypotheses.ensemble import Ensemble
from hypogoal.hypotheses.stacked import StackedMembers
from hypogoal.hypotheses.training import EnsembleTraining, train
from hypogoal.options.termination import learned_terminations

SHAPE = (41, 41, 3)
CASES = {
    "dbat, members together": {"diversity": "dbat", "unlabelled_bn": True},
    "divdis, one after another, threshold": {
        "diversity": "divdis",
        "schedule": "sequential",
        "threshold": "unlabelled-split",
    },
    "a view that changes states": {"diversity": "none", "view": "own_view:Moved", "view_settings": ("jitter=0",)},
}


@pytest.mark.parametrize("case", CASES)
def test_another_device_trains_the_same(case: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Spec C, G1: images without repeated patches, which only the CPU looks for: the same bytes."""
    monkeypatch.setenv("HYPOGOAL_TRUST", "1")
    rng = np.random.default_rng(0)
    images = rng.integers(256, size=(90, *SHAPE), dtype=np.uint8)
    labels = np.arange(60) < 20
    config = EnsembleConfig(members=2, steps=6, batch_size=8, **CASES[case])  # type: ignore[arg-type]
    arguments = (images[:60], labels, images[60:], config, 1)
    near = train(*arguments)
    with far_device(monkeypatch):
        training = EnsembleTraining(*arguments, device=FAR)
        for _ in training.steps():
            snapshot = training.snapshot()
        far = training.ensemble
        assert all(isinstance(weight, FarTensor) for weight in far.parameters())
        state = {name: value.cpu() for name, value in far.state_dict().items()}
        np.testing.assert_allclose(far.log_odds(images), near.log_odds(images), atol=1e-6)  # in batches of other sizes
        finished = EnsembleTraining(*arguments, device=FAR, saved=snapshot)
        assert list(finished.steps()) == []
        again = {name: value.cpu() for name, value in finished.ensemble.state_dict().items()}
    for name, value in near.state_dict().items():
        assert torch.equal(value, state[name]), name
        assert torch.equal(value, again[name]), name


def test_another_device_says_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    """Spec D1: few states, many states, all members at once and the running one's alone."""

    class Wide(Corridor):
        observation_shape = (48, 64, 3)

    engine = Wide(2)
    ids = np.arange(engine.n_states)
    options = np.array([0, 1, 2, 3, 0, 1])
    ensembles = [
        Ensemble("doorkey", engine.observation_shape, 2, torch.Generator().manual_seed(g)).eval() for g in (0, 1)
    ]
    images = np.random.default_rng(0).integers(256, size=(300, *engine.observation_shape), dtype=np.uint8)
    wanted = StackedMembers(ensembles).log_odds(engine.images(ids))
    running = learned_terminations(engine, ensembles, running_only=True).of_running(ids, options)
    many = ensembles[0].log_odds(images)
    with far_device(monkeypatch):
        for ensemble in ensembles:
            ensemble.to(FAR)
        np.testing.assert_array_equal(StackedMembers(ensembles).log_odds(engine.images(ids)), wanted)
        np.testing.assert_array_equal(
            learned_terminations(engine, ensembles, running_only=True).of_running(ids, options), running
        )
        np.testing.assert_allclose(ensembles[0].log_odds(images), many, rtol=1e-5)
