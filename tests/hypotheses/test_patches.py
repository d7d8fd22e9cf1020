"""Working on distinct patches is the plain network: values, gradients and running statistics (Spec C5)."""

import copy
import dataclasses

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import nn

from hypogoal.hypotheses import patches
from hypogoal.hypotheses.networks import NETWORKS, as_input, build_network


def grid_world(count: int, cells: int, seed: int = 0, channels: int = 3) -> NDArray[np.uint8]:
    """Images of 8x8 tiles, of which there are four."""
    rng = np.random.default_rng(seed)
    tiles = rng.integers(256, size=(4, 8, 8, channels), dtype=np.uint8)
    grid = rng.choice(4, size=(count, cells, cells), p=(0.85, 0.05, 0.05, 0.05))
    return tiles[grid].transpose(0, 1, 3, 2, 4, 5).reshape(count, cells * 8, cells * 8, channels)


@pytest.mark.parametrize("name", sorted({*NETWORKS} - {"mlp"}))
@pytest.mark.parametrize("training", [True, False])
def test_it_is_the_plain_network(name: str, training: bool) -> None:
    """Spec C5: in double precision the two agree to rounding, with a repeated image in the batch."""
    images = grid_world(40, 6 if name == "doorkey" else 5, channels=3)
    plain = build_network(name, images.shape[1:], torch.Generator().manual_seed(1)).double().train(training)
    tabled = copy.deepcopy(plain)
    chosen = np.array([3, 17, 3, 29, 0])
    inputs = as_input(torch.from_numpy(images[chosen]))
    expected, found = plain(inputs.double()), patches.forward(tabled, double_batch(images, plain, chosen))
    compare(plain, expected, tabled, found)


@pytest.mark.parametrize("name", sorted({*NETWORKS} - {"mlp"}))
@pytest.mark.parametrize("counted", [True, False])
def test_groups_pass_together_and_batchnorm_sees_them_apart(name: str, counted: bool) -> None:
    """Spec C5: labelled and unlabelled states at once are two passes of the plain network."""
    images = grid_world(40, 6 if name == "doorkey" else 5, channels=3)
    plain = build_network(name, images.shape[1:], torch.Generator().manual_seed(1)).double().train()
    tabled = copy.deepcopy(plain)
    groups = np.array([3, 17, 3, 29, 0]), np.array([31, 2, 8])
    found = patches.forward(tabled, double_batch(images, plain, *groups), counted)
    first, second = (
        plain_or_not(plain, images[group], counts) for group, counts in zip(groups, (True, counted), strict=True)
    )
    compare(plain, torch.cat([first, second]), tabled, found)


def double_batch(images: NDArray[np.uint8], network: nn.Sequential, *groups: NDArray[np.int64]) -> patches.PatchBatch:
    """A batch in double precision."""
    batch = patches.take(patches.tables_of(images, patches.windows_of(network) or []), *groups)
    shares = [[(share.double(), places) for share, places in level] for level in batch.shares]
    return dataclasses.replace(batch, colours=batch.colours.double(), shares=shares)


def plain_or_not(network: nn.Sequential, images: NDArray[np.uint8], counted: bool) -> torch.Tensor:
    """The plain network's logits; its running statistics do not move where the images are not to count."""
    norms = [layer for layer in network if isinstance(layer, nn.BatchNorm2d)]
    for norm in norms:
        norm.momentum = 0.1 if counted else 0.0
    logits: torch.Tensor = network(as_input(torch.from_numpy(images)).double())
    if not counted:
        for norm in norms:
            assert norm.num_batches_tracked is not None
            norm.num_batches_tracked -= 1
    return logits


def compare(plain: nn.Sequential, expected: torch.Tensor, tabled: nn.Sequential, found: torch.Tensor) -> None:
    """Logits, gradients and running statistics of two networks."""
    torch.testing.assert_close(found, expected, rtol=1e-5, atol=1e-7)  # shares were rounded to float32
    expected.square().sum().backward()
    found.square().sum().backward()
    for (key, weight), same in zip(plain.named_parameters(), tabled.parameters(), strict=True):
        assert weight.grad is not None
        assert same.grad is not None
        assert (weight.grad - same.grad).norm() <= 1e-4 * weight.grad.norm(), key
    for one, two in zip(plain.buffers(), tabled.buffers(), strict=True):
        torch.testing.assert_close(two, one, rtol=1e-5, atol=1e-7)


def test_only_what_repeats_is_tabled() -> None:
    """Noise and photographs take the plain way; so do layers that tables do not know."""
    network = build_network("doorkey", (48, 48, 3), torch.Generator())
    windows = patches.windows_of(network)
    assert windows == [(5, 2), (3, 2), (3, 2), (4, 2)]
    noise = np.random.default_rng(0).integers(256, size=(8, 48, 48, 3), dtype=np.uint8)
    assert patches.make_tables(network, noise) is None
    assert patches.make_tables(network, grid_world(80, 6)) is not None
    assert patches.make_tables(nn.Sequential(nn.Dropout()), grid_world(80, 6)) is None
    for layer in (
        nn.Conv2d(3, 4, 3, padding=1),
        nn.Conv2d(3, 3, 3, groups=3),
        nn.Conv2d(3, 3, (3, 1)),
        nn.Dropout(),
        nn.BatchNorm2d(3, momentum=None),
        nn.BatchNorm2d(3, affine=False),
        nn.BatchNorm2d(3, track_running_stats=False),
    ):
        assert patches.windows_of(nn.Sequential(nn.Conv2d(3, 3, 3), layer)) is None
