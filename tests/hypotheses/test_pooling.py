"""Lean max-pooling: PyTorch's values and gradients, with less kept for them."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor, nn
from torch.autograd.graph import saved_tensors_hooks

from hypogoal.hypotheses.pooling import LeanMaxPool2d, lean

WINDOWS = [
    {"kernel_size": 3, "stride": 2},
    {"kernel_size": 2, "ceil_mode": True},
    {"kernel_size": 3, "padding": 1, "dilation": 2},
]


@pytest.mark.parametrize("windows", WINDOWS)
@pytest.mark.parametrize("memory", [torch.contiguous_format, torch.channels_last])
def test_values_and_gradients_are_pytorchs(windows: dict[str, int], memory: torch.memory_format) -> None:
    """Spec C5: to the byte, in both orders of memory; gradients of gradients too."""
    values = torch.randn(3, 4, 11, 13, generator=torch.Generator().manual_seed(0)).to(memory_format=memory)
    results = []
    for layer in (nn.MaxPool2d(**windows), lean(nn.MaxPool2d(**windows))):
        inputs = values.clone().requires_grad_()
        pooled = layer(inputs)
        (first,) = torch.autograd.grad(pooled.square().sum(), inputs, create_graph=True)
        (second,) = torch.autograd.grad(first.pow(3).sum(), inputs)
        results.append((pooled, layer(values), first, second))
    assert all(map(torch.equal, *results))


def test_only_places_are_kept() -> None:
    """Of 64 inputs a pool of 2x2 keeps 16 places and no input."""
    kept: list[Tensor] = []

    def keep(tensor: Tensor) -> Tensor:
        kept.append(tensor)
        return tensor

    inputs = torch.rand(1, 1, 8, 8, requires_grad=True)
    with saved_tensors_hooks(keep, lambda tensor: tensor):
        lean(nn.MaxPool2d(2))(inputs)
    assert [(tensor.dtype, tensor.numel()) for tensor in kept] == [(torch.int64, 16)]


def test_other_layers_stay_as_they_are() -> None:
    """A subclass may compute something else; places as a second output are PyTorch's."""

    class Own(nn.MaxPool2d):
        pass

    layers = [nn.ReLU(), Own(2), nn.MaxPool2d(2, return_indices=True)]
    assert all(lean(layer) is layer for layer in layers)
    assert type(lean(nn.MaxPool2d(2))) is LeanMaxPool2d
