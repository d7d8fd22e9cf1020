"""Encoders of any modules as members: trained, stored, asked and explained (Spec C5, D1, F2, G2)."""

import importlib
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from hypogoal.core.errors import NumericalError, UserError
from hypogoal.core.seeding import torch_generator
from hypogoal.domains.doorkey.engine import DoorKeyEngine
from hypogoal.hypotheses.config import EnsembleConfig
from hypogoal.hypotheses.deep_lift import INTEGRATED, attributed, mean_state, method_of
from hypogoal.hypotheses.ensemble import PATCHES_FROM, Ensemble, read_ensemble, write_ensemble
from hypogoal.hypotheses.load import built
from hypogoal.hypotheses.networks import NETWORKS, as_input, build_network
from hypogoal.hypotheses.stacked import StackedMembers
from hypogoal.hypotheses.training import train
from hypogoal.options.termination import learned_terminations
from hypogoal.tools.export import _layers

EXAMPLES = Path(__file__).parents[2] / "examples"
FEW = EnsembleConfig(members=2, steps=3, batch_size=4, diversity_weight=0.1, learning_rate=1e-3)


class Whole(nn.Module):
    """Layers as one module."""

    def __init__(self, *layers: nn.Module):
        super().__init__()
        self.layers = nn.Sequential(*layers)

    def forward(self, images: Tensor) -> Tensor:
        return self.layers(images)


@pytest.fixture(autouse=True)
def allowed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HYPOGOAL_TRUST", "1")
    monkeypatch.setattr(sys, "path", [*sys.path, str(EXAMPLES)])


def states(count: int, side: int = 16) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    rng = np.random.default_rng(0)
    return rng.integers(256, size=(count, side, side, 3), dtype=np.uint8), np.arange(count) % 2 == 0


def trained(network: str, config: EnsembleConfig = FEW, side: int = 16, **settings: object) -> Ensemble:
    images, labels = states(24, side)
    config = config.model_copy(update={"network": network, **settings})
    return train(images[:12], labels[:12], images[12:], config, 0)


def test_a_large_network_is_a_member(tmp_path: Path) -> None:
    """Spec C5, A8, D1, F2: a frozen transformer trains, is stored, loaded, ends options and is explained."""
    engine = DoorKeyEngine(100, 4)
    rng = np.random.default_rng(0)
    for _ in range(6):
        engine.step(rng.integers(engine.n_actions, size=4))
    ids = np.arange(min(engine.n_states, 12))
    images, labels = engine.images(ids), np.arange(len(ids)) % 2 == 0
    config = FEW.model_copy(update={"network": "frozen_backbone:vit"})
    half = len(ids) // 2
    ensemble = train(images[:half], labels[:half], images[half:], config, 0)
    write_ensemble(tmp_path, "goal", ensemble)
    about = {**config.model_dump(), "observation_shape": list(images.shape[1:]), "sub_goals": ["goal"]}
    about["observation_dtype"] = "uint8"
    back = read_ensemble(tmp_path, about, "goal")
    np.testing.assert_array_equal(back.logits(images), ensemble.logits(images))

    back.thresholds.copy_(torch.from_numpy(np.median(back.predict(images), axis=0) + np.float32(1e-3)))
    wanted = np.concatenate([back.predictions(images)] * 2, axis=1)
    for running_only in (False, True):
        ends = learned_terminations(engine, [back], running_only=running_only)
        options = np.arange(len(ids)) % 2
        for turn in (options, 1 - options):
            np.testing.assert_array_equal(ends.of_running(ids, turn), wanted[ids, turn])

    found = attributed(back, images[:1], mean_state(images))
    differences = np.abs(found.log_odds - found.baseline_log_odds)
    assert found.method == INTEGRATED and found.values.shape == (1, 2, *images.shape[1:])
    assert (found.completeness_error() < 0.1 * differences + 1e-6).all()
    assert (np.abs(found.values).sum((0, 2, 3, 4)) > 1e-4).all()


def flat(channels: int) -> tuple[list[nn.Module], tuple[int, ...]]:
    return [nn.Conv2d(channels, 4, 4, 4), nn.BatchNorm2d(4), nn.ReLU()], (6,)


def whole(channels: int) -> tuple[list[nn.Module], tuple[int, ...]]:
    layers, widths = flat(channels)
    return [Whole(*layers)], widths


@pytest.mark.parametrize("unlabelled_bn", [True, False])
@pytest.mark.parametrize("diversity", ["dbat", "none"])
def test_batchnorm_inside_an_encoder_is_as_outside(unlabelled_bn: bool, diversity: str) -> None:
    """Spec C5, C6: groups of states apart, and counted where they are to be: the same training, whoever holds it."""
    settings = {"unlabelled_bn": unlabelled_bn, "diversity": diversity}
    outside, inside = (
        trained("test_encoders:flat", **settings).state_dict(),
        trained("test_encoders:whole", **settings).state_dict(),
    )
    assert len(outside) == len(inside)
    for one, other in zip(outside.values(), inside.values(), strict=True):
        torch.testing.assert_close(one, other, atol=1e-5, rtol=1e-4)
    counted = inside["members.0.0.layers.1.num_batches_tracked"].item()
    assert counted == (6 if unlabelled_bn else 3)


def still(channels: int) -> tuple[list[nn.Module], tuple[int, ...]]:
    """BatchNorm and Dropout in a frozen backbone."""
    frozen = importlib.import_module("frozen_backbone").Frozen
    return [frozen(Whole(*flat(channels)[0], nn.Dropout(0.5)))], (4,)


@pytest.mark.parametrize("diversity", ["dbat", "none"])
def test_a_frozen_backbone_stays_as_it_is(diversity: str) -> None:
    """Spec C2, C6: Adam's weight decay leaves its weights alone, BatchNorm its statistics; what is behind it learns."""
    ensemble = trained("test_encoders:still", diversity=diversity, l2_weight=0.1)
    fresh = Ensemble("test_encoders:still", (16, 16, 3), 2, torch_generator(0, "weights")).state_dict()
    for name, value in ensemble.state_dict().items():
        if name != "thresholds":
            assert torch.equal(value, fresh[name]) == (".backbone." in name), name
    images = torch.rand(5, 3, 16, 16)
    backbone = ensemble.members[0][0]
    expected = backbone(images)
    ensemble.train()
    torch.testing.assert_close(backbone(images), expected, rtol=0, atol=0)


class Looped(nn.Module):
    """It uses a layer twice, and ties the weights of two others."""

    def __init__(self, channels: int):
        super().__init__()
        self.first, self.shared = nn.Conv2d(channels, 4, 4, 4), nn.Conv2d(4, 4, 1)
        self.twice = nn.ModuleList([self.shared, self.shared])
        self.tied = nn.Conv2d(4, 4, 1)
        self.tied.weight = self.shared.weight

    def forward(self, images: Tensor) -> Tensor:
        values = self.first(images)
        for layer in (*self.twice, self.tied):
            values = layer(values).relu()
        return values.flatten(1)


def repeated(channels: int) -> tuple[list[nn.Module], tuple[int, ...]]:
    relu, same = nn.ReLU(), nn.Conv2d(4, 4, 1)
    return [nn.Conv2d(channels, 4, 4, 4), relu, same, relu, same, relu], (6,)


@pytest.mark.parametrize("network", ["test_encoders:Looped", "test_encoders:repeated"])
def test_layers_that_share_weights_are_stored_and_exported(network: str, tmp_path: Path) -> None:
    """Spec A8, G2: each name has its copy in the file, and what is loaded predicts the same."""
    ensemble = trained(network)
    write_ensemble(tmp_path, "goal", ensemble)
    about = {**FEW.model_dump(), "network": network, "observation_shape": [16, 16, 3], "sub_goals": ["goal"]}
    back = read_ensemble(tmp_path, about | {"observation_dtype": "uint8"}, "goal")
    images, _ = states(5)
    np.testing.assert_array_equal(back.predict(images), ensemble.predict(images))
    if network.endswith("repeated"):
        member = ensemble.members[0]
        rebuilt = built(_layers(member, tmp_path)).eval()
        rebuilt.load_state_dict(member.state_dict())
        inputs = as_input(torch.from_numpy(images))
        torch.testing.assert_close(rebuilt(inputs), member(inputs))


class Masked(nn.Module):
    def __init__(self, value: Tensor):
        super().__init__()
        self.register_buffer("mask", value)

    def forward(self, images: Tensor) -> Tensor:
        return images.flatten(1)


def endless(channels: int) -> nn.Module:
    return Masked(torch.tensor([0.0, -torch.inf]))


def test_what_cannot_be_stored_is_refused_before_training() -> None:
    """Spec G2, G3: not when all is trained."""
    with pytest.raises(NumericalError, match=r"members.0.0.mask of the network .* persistent=False"):
        trained("test_encoders:endless")


def broken(observation_shape: tuple[int, ...]) -> nn.Module:
    return Whole(nn.Linear(observation_shape[0], 3), nn.Flatten(0))


def test_an_encoder_that_makes_no_features_of_each_state_is_one_clear_line(monkeypatch: pytest.MonkeyPatch) -> None:
    """Spec G2."""
    monkeypatch.setenv("HYPOGOAL_TRUST", "1")
    with pytest.raises(UserError, match="the network makes torch"):
        build_network("test_encoders:broken", (16, 16, 3), torch.Generator())


def test_layers_of_other_classes_take_no_short_cut(monkeypatch: pytest.MonkeyPatch) -> None:
    """Spec C5: a convolution that computes something else is no convolution to fold, stack, look up or explain by."""

    class Halved(nn.Conv2d):
        def forward(self, input: Tensor) -> Tensor:
            return super().forward(input) / 2

    def halved(channels: int) -> tuple[list[nn.Module], tuple[int, ...]]:
        return [Halved(channels, 4, 8, 8), nn.BatchNorm2d(4), nn.ReLU()], (5,)

    monkeypatch.setitem(NETWORKS, "halved", halved)
    ensemble = Ensemble("halved", (16, 16, 3), 2, torch.Generator()).eval()
    images = np.repeat(states(4)[0], PATCHES_FROM, axis=0)
    with torch.no_grad():
        plain = torch.stack([member(as_input(torch.from_numpy(images))) for member in ensemble.members], 1).numpy()
    np.testing.assert_allclose(ensemble.logits(images), plain, atol=1e-6)
    assert not StackedMembers([ensemble]).joined and method_of(ensemble.members[0]) == INTEGRATED
