"""An ensemble predicts what its members say, stacked or not, and refuses what is not its own (Spec C5, D1, A8, G2)."""

import copy
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from safetensors.torch import save_file
from torch import nn

from hypogoal.core.errors import UserError
from hypogoal.core.seeding import torch_generator
from hypogoal.hypotheses.ensemble import PATCHES_FROM, Ensemble, read_ensemble
from hypogoal.hypotheses.networks import NETWORKS, as_input
from hypogoal.hypotheses.stacked import StackedMembers
from hypogoal.hypotheses.views import FullView
from hypogoal.observations import NUMBERS, packed

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


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("number", [1e300, -np.inf, np.nan])
def test_numbers_that_are_not_finite_are_one_clear_line(number: float) -> None:
    """Spec G2: in float32, alone or beside pictures."""
    said = "numbers that are not finite in float32: state 1"
    numbers = np.array([[0.0, 1.0], [number, 1.0]])
    parts = {"at": numbers, "eye": np.zeros((2, *SHAPE), np.uint8)}
    mixed = packed({**parts, "at": np.zeros((2, 2))}).dtype
    generator = torch_generator(1, "weights")
    for observations, shape, dtype in ((numbers, (2,), NUMBERS), (parts, (), mixed)):
        ensemble = Ensemble("auto", shape, 1, generator, FullView(shape, dtype))
        with pytest.raises(UserError, match=said):
            ensemble.predict(observations)


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


@pytest.mark.parametrize(("network", "shape"), [("doorkey", (64, 64, 3)), ("montezuma", (84, 84, 4))])
def test_stacked_members_equal_each_ensemble(network: str, shape: tuple[int, ...]) -> None:
    """Two ensembles of two members, with running statistics that are not the initial ones."""
    generator = torch.Generator().manual_seed(0)
    rng = np.random.default_rng(0)
    ensembles = [Ensemble(network, shape, 2, generator) for _ in range(2)]
    states = rng.integers(0, 256, size=(70, *shape), dtype=np.uint8)
    for ensemble in ensembles:
        ensemble.train()
        for member in ensemble.members:
            member(torch.from_numpy(states[:16]).permute(0, 3, 1, 2).float() / 255)
        ensemble.eval()
    plain = np.concatenate([ensemble.log_odds(states) for ensemble in ensembles], axis=1)
    stacked = StackedMembers(ensembles).log_odds(states)
    np.testing.assert_allclose(stacked, plain, atol=1e-5)
    assert np.ptp(plain) > 1e-3


OWN = {
    "BatchNorm after ReLU": [nn.Conv2d(3, 8, 3), nn.ReLU(), nn.BatchNorm2d(8), nn.MaxPool2d(2)],
    "GroupNorm": [nn.Conv2d(3, 8, 3), nn.GroupNorm(2, 8), nn.ReLU()],
    "groups": [nn.Conv2d(3, 8, 3), nn.ReLU(), nn.Conv2d(8, 8, 3, groups=2), nn.ReLU()],
    "a slope of its own": [nn.Conv2d(3, 8, 3), nn.PReLU(), nn.MaxPool2d(2)],
    "joined after all": [nn.Conv2d(3, 8, 3, padding=1), nn.BatchNorm2d(8), nn.ReLU(), nn.AvgPool2d(2), nn.Dropout()],
}


@pytest.mark.parametrize("name", OWN)
def test_own_networks_of_other_layers_predict_the_same(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Spec C5: what cannot be joined is predicted ensemble by ensemble."""

    def own(channels: int) -> tuple[list[nn.Module], tuple[int, ...]]:
        layers = copy.deepcopy(OWN[name])
        for layer in layers:
            for values in (*layer.parameters(), *layer.buffers()):
                if values.dtype == torch.float32:
                    nn.init.uniform_(values, 0.1, 0.4)
        return layers, (16,)

    monkeypatch.setitem(NETWORKS, "own", own)
    generator = torch.Generator().manual_seed(0)
    ensembles = [Ensemble("own", (16, 16, 3), 2, generator).eval() for _ in range(2)]
    states = np.random.default_rng(0).integers(0, 256, size=(10, 16, 16, 3), dtype=np.uint8)
    stacked = StackedMembers(ensembles)
    assert stacked.joined == (name == "joined after all")
    plain = np.concatenate([ensemble.log_odds(states) for ensemble in ensembles], axis=1)
    np.testing.assert_allclose(stacked.log_odds(states), plain, atol=1e-5)
    assert stacked.log_odds(states).shape == (10, 4)
    assert np.ptp(plain) > 1e-4
