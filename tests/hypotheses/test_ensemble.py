"""An ensemble predicts what its members say, and comes back from its state (Spec C5, A8, G2)."""

from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from safetensors.torch import save_file

from hypogoal.core.errors import UserError
from hypogoal.core.seeding import torch_generator
from hypogoal.hypotheses.ensemble import PATCHES_FROM, Ensemble, read_ensemble
from hypogoal.hypotheses.networks import as_input
from hypogoal.hypotheses.stacked import StackedMembers

SHAPE = (48, 48, 3)


def ensemble_of(members: int = 3) -> Ensemble:
    """Fresh members."""
    return Ensemble("doorkey", SHAPE, members, torch_generator(1, "weights"))


def images_of(kind: str, count: int) -> NDArray[np.uint8]:
    """Noise, or images of few distinct patches."""
    rng = np.random.default_rng(2)
    if kind == "noise":
        return rng.integers(256, size=(count, *SHAPE), dtype=np.uint8)
    cells = rng.choice([10, 90, 200], size=(count, 6, 6, 3), p=(0.9, 0.05, 0.05)).astype(np.uint8)
    return cells.repeat(8, axis=1).repeat(8, axis=2)


@pytest.mark.parametrize("kind", ["noise", "tiles"])
@pytest.mark.parametrize("count", [0, 1, 4, 70, PATCHES_FROM + 1])
def test_predict_is_what_each_member_says(kind: str, count: int) -> None:
    """Spec C1: float32 (N, K), the softmax of each member's plain forward pass, however it is computed."""
    ensemble = ensemble_of().train()
    observations = images_of(kind, count)
    found = ensemble.predict(observations)
    assert found.shape == (count, 3)
    assert found.dtype == np.float32
    assert ensemble.training, "predict leaves the mode as it was"
    ensemble.eval()
    with torch.no_grad():
        inputs = as_input(torch.from_numpy(observations))
        expected = [member(inputs).softmax(dim=-1)[:, 1].numpy() for member in ensemble.members]
    np.testing.assert_allclose(found, np.stack(expected, axis=1), rtol=0, atol=2e-6)


def test_autocast_around_changes_nothing() -> None:
    """Spec I6: in a program that computes in half precision."""
    ensemble, observations = ensemble_of().eval(), images_of("noise", 3)
    stacked = StackedMembers([ensemble])
    expected = ensemble.predict(observations), stacked.log_odds(observations)
    with torch.autocast("cpu", torch.bfloat16):
        np.testing.assert_array_equal(ensemble.predict(observations), expected[0])
        np.testing.assert_array_equal(stacked.log_odds(observations), expected[1])


def config_of(members: int = 3) -> dict[str, object]:
    """Of an artefact."""
    kind = {"network": "doorkey", "view": "full", "observation_shape": SHAPE, "observation_dtype": "uint8"}
    return {"sub_goals": ["goal"], "members": members, **kind}


def test_foreign_weights_are_one_clear_line(tmp_path: Path) -> None:
    """Spec G2: too few members, another size, a missing tensor."""
    state = ensemble_of().state_dict()
    name = "members.0.13.weight"
    cases = [
        (2, state),
        (4, state),
        (3, {key: value for key, value in state.items() if key != name}),
        (3, state | {name: state[name][:1]}),
        (3, state | {"extra": torch.zeros(1)}),
    ]
    for members, foreign in cases:
        save_file(foreign, tmp_path / "goal.safetensors")
        with pytest.raises(UserError, match="the weights do not fit the"):
            read_ensemble(tmp_path, config_of(members), "goal")


def test_foreign_observations_are_one_clear_line() -> None:
    """Spec G2."""
    with pytest.raises(UserError, match=r"float64 \(2, 48, 48, 3\)\. Give uint8 \(N, 48, 48, 3\)"):
        ensemble_of(1).predict(np.zeros((2, *SHAPE)))  # type: ignore[arg-type]
    with pytest.raises(UserError, match=r"uint8 \(48, 48, 3\)"):
        ensemble_of(1).predict(np.zeros(SHAPE, dtype=np.uint8))


def test_verdicts_are_above_each_members_threshold() -> None:
    """Spec D1: 0.5 where none was chosen; each member has its own."""
    ensemble = ensemble_of()
    observations = images_of("noise", 20)
    probabilities = ensemble.predict(observations)
    np.testing.assert_array_equal(ensemble.predictions(observations), probabilities > 0.5)
    chosen = np.median(probabilities, axis=0)
    ensemble.thresholds.copy_(torch.from_numpy(chosen))
    np.testing.assert_array_equal(ensemble.predictions(observations), probabilities > chosen)
    assert (ensemble.predictions(observations).sum(axis=0) == 10).all()
    stacked = StackedMembers([ensemble, ensemble_of(1)])
    expected = np.concatenate([probabilities > chosen, ensemble_of(1).predict(observations) > 0.5], axis=1)
    taus = np.concatenate([ensemble.thresholds_as_log_odds(), ensemble_of(1).thresholds_as_log_odds()])
    assert (taus[len(chosen) :] == 0).all()
    above = stacked.log_odds(observations) > taus
    assert (above == expected).mean() > 0.95  # up to rounding, at the median itself
