"""Member networks: shapes, sizes, sharing of weights, DeepLift (Spec C5)."""

import re
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn

from hypogoal.core.errors import UserError
from hypogoal.hypotheses.ensemble import Ensemble
from hypogoal.hypotheses.networks import NETWORKS, as_input, build_network, folded, network_for, reordered
from hypogoal.observations import NUMBERS, PICTURE

SHAPES = {"doorkey": (64, 64, 3), "montezuma": (84, 84, 4), "tiles": (48, 48, 3), "mlp": (6, 7, 3)}


def network_of(name: str, shape: tuple[int, ...] | None = None, seed: int = 0) -> nn.Sequential:
    """A fresh network with BatchNorm statistics that are not those of a fresh one."""
    generator = torch.Generator().manual_seed(seed)
    network = build_network(name, shape or SHAPES[name], generator)
    for layer in network:
        if isinstance(layer, nn.BatchNorm2d):
            for value in layer.state_dict().values():
                if value.is_floating_point():
                    nn.init.uniform_(value, 0.5, 1.5, generator=generator)
    return network


@pytest.mark.parametrize(
    ("name", "convolutions", "dense", "parameters"),
    [
        # 32x3x25 + 64 + 64x32x9 + 128, 64 x 2 x 2 = 256 features: 256x750 + 750 + 750x100 + 100 + 100x2 + 2
        ("doorkey", 2, 3, 2400 + 64 + 18432 + 128 + 192750 + 75100 + 202),
        # 32x4x64 + 64 + 64x32x16 + 128 + 64x64x9 + 128, 64 x 7 x 7 features: 3136x512 + 512 + 512x2 + 2
        ("montezuma", 3, 2, 8192 + 64 + 32768 + 128 + 36864 + 128 + 1606144 + 1026),
        # 16x3x64 + 32 + 16x16x9 + 32, 16 x 4 x 4 features: 256x64 + 64 + 64x2 + 2
        ("tiles", 2, 2, 3072 + 32 + 2304 + 32 + 16448 + 130),
        # 126x256 + 256 + 256x256 + 256 + 256x2 + 2
        ("mlp", 0, 3, 32512 + 65792 + 514),
    ],
)
def test_the_layers_are_the_papers(name: str, convolutions: int, dense: int, parameters: int) -> None:
    """Spec C5: the number of layers of each kind; the number of weights worked by hand."""
    layers = list(network_of(name))
    kinds = [type(layer) for layer in layers]
    assert kinds.count(nn.Conv2d) == kinds.count(nn.BatchNorm2d) == convolutions
    assert kinds.count(nn.Linear) == dense
    assert len({id(layer) for layer in layers}) == len(layers)
    assert sum(weight.numel() for layer in layers for weight in layer.parameters()) == parameters


@pytest.mark.parametrize(("name", "smallest"), [("doorkey", 41), ("montezuma", 36), ("tiles", 24)])
def test_any_large_enough_image_fits(name: str, smallest: int) -> None:
    """Spec C5, G2: dense layers take what the convolutions leave; too small an image is one clear line."""
    shape = (smallest, smallest + 9, 1)
    assert network_of(name, shape).eval()(torch.zeros(1, 1, smallest, smallest + 9)).shape == (1, 2)
    line = rf"'{name}' does not take these observations: observation shape \({smallest - 1},.*larger pictures"
    with pytest.raises(UserError, match=line):
        network_of(name, (smallest - 1, smallest, 1))
    page = (Path(__file__).parents[2] / "docs" / "own-domain.md").read_text(encoding="utf-8")
    assert re.search(rf"`{name}`,?\s+from {smallest}\b", page)


@pytest.mark.parametrize(
    ("shape", "name"),
    [((41, 99, 3), "doorkey"), ((40, 56, 3), "montezuma"), ((99, 35, 1), "tiles"), ((7, 7, 3), "mlp")],
)
def test_auto_is_a_network_that_takes_the_pictures(shape: tuple[int, ...], name: str) -> None:
    """Spec C5: the first of the four; numbers have the last."""
    assert network_for("auto", shape, PICTURE) == name
    ensemble = Ensemble("auto", shape, 2, torch.Generator()).eval()
    assert ensemble.network == name
    assert ensemble.predict(np.zeros((2, *shape), np.uint8)).shape == (2, 2)
    assert network_for("auto", (99, 99), NUMBERS) == "mlp"


def test_wrong_names_and_shapes_are_one_clear_line() -> None:
    """Spec G2."""
    with pytest.raises(UserError, match=r"unknown network: resnet\. Choose one of doorkey, mlp, montezuma"):
        network_of("resnet", (64, 64, 3))
    with pytest.raises(UserError, match=r"does not take these observations: observation shape \(8,\)"):
        network_of("doorkey", (8,))


def test_the_faster_order_is_the_same_function() -> None:
    """Spec C5: ReLU behind the pooling: same values, same gradients, same weights, ReLU really moved."""
    network = network_of("doorkey").double()
    faster = reordered(network)
    assert [type(layer) for layer in list(faster)[2:4]] == [nn.MaxPool2d, nn.ReLU]
    images = torch.rand(3, 3, 64, 64, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    gradients = []
    for one in (network, faster):
        network.zero_grad()
        logits = one(images)
        logits.square().sum().backward()
        gradients.append([logits.detach(), *(weight.grad.clone() for weight in network.parameters())])  # type: ignore[union-attr]
    torch.testing.assert_close(gradients[0], gradients[1])


@pytest.mark.parametrize("name", sorted(NETWORKS))
def test_batchnorm_folds_into_the_convolutions(name: str) -> None:
    """Spec C5: in evaluation mode the same function, without BatchNorm; the network itself stays as it was."""
    network = network_of(name).double().eval()
    before = {key: value.clone() for key, value in network.state_dict().items()}
    height, width, channels = SHAPES[name]
    images = torch.rand(3, channels, height, width, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    plain = folded(network)
    assert not any(isinstance(layer, nn.BatchNorm2d) for layer in plain)
    torch.testing.assert_close(plain(images), network(images))
    assert all(torch.equal(value, before[key]) for key, value in network.state_dict().items())


def test_as_input_scales_and_turns() -> None:
    """Spec B1: uint8 (N, H, W, C) -> float (N, C, H, W) in 0..1."""
    observations = torch.zeros(2, 4, 5, 3, dtype=torch.uint8)
    observations[1, 2, 3, 0] = 255
    inputs = as_input(observations)
    assert inputs.shape == (2, 3, 4, 5)
    assert inputs[1, 0, 2, 3] == 1.0
    assert inputs.sum() == 1.0


def shallow(channels: int) -> tuple[list[nn.Module], tuple[int, ...]]:
    """Features of 8x8 patches, without a hidden layer behind them."""
    return [nn.Conv2d(channels, 4, kernel_size=8, stride=8), nn.ReLU()], ()


def test_a_network_may_have_no_hidden_layer(trusted: None) -> None:
    """Spec C5: the last layer reads its features, 4 of 2x3 patches."""
    network = build_network(f"{__name__}:shallow", (16, 24, 3), torch.Generator().manual_seed(0))
    *_, flatten, last = network
    assert isinstance(flatten, nn.Flatten) and isinstance(last, nn.Linear)
    assert (last.in_features, last.out_features) == (24, 2)
