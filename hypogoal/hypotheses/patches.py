"""Convolutions over images made of few distinct patches: each distinct patch is computed once.

A grid world's image repeats a few tiles. So of the thousands of patches that a convolution or pooling sees in a batch
of images, only few differ. The layers in this module work on a table of the distinct patches, and BatchNorm weights
each patch by its frequency. Up to rounding, values, gradients and running statistics are those of the plain network. On
a CPU, the computation is several times faster.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import prod
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from hypogoal.core.arrays import Array, Bytes, Ints
from hypogoal.hypotheses.distinct import Ids, distinct_items, join, positions, rank
from hypogoal.observations import spread_rows

# If distinct patches need more than this share of the plain network's work in convolutions, gathering patches costs
# more than it saves.
WORTHWHILE = 0.5
SAMPLE = 64  # the number of images of each part from which the share of work is estimated
SAMPLE_PIXELS = 2**19  # the images of a sample have at most this number of pixels, because each takes some 250 bytes


@dataclass(frozen=True)
class Level:
    """The patches that one convolution or pooling sees in N images, by id."""

    parts: Ids  # (U, k * k), each distinct patch as patch ids of the level below (of colours at the first level)
    rows: Ids  # (R, W), distinct rows of places, with the patch id at each place
    lines: Ids  # (N, H), each image as indices of rows


@dataclass(frozen=True)
class Tables:
    """The distinct patches of N images: colours float32 (U, C) in 0..1, and a level for each convolution or pooling."""

    colours: Tensor
    levels: tuple[Level, ...]


@dataclass(frozen=True)
class PatchBatch:
    """The patches of several groups of images, one group after another.

    BatchNorm sees each group on its own. All other layers see all groups at once.
    """

    colours: Tensor  # float32 (colours, C)
    parts: list[Tensor]  # for each level int64 (U, k * k), indices of the level below, or of colours at the first level
    # For each level and group: each patch's share of the group's places, float32 (1, U), which sums to 1, and the
    # number of places.
    shares: list[list[tuple[Tensor, int]]]
    last: Tensor  # int64 (B, H * W), the last level's patch at each place of all images


def windows_of(network: nn.Sequential) -> list[tuple[int, int]] | None:
    """Return (kernel size, stride) of each convolution and pooling, or None if a layer is not supported."""
    windows = []
    for layer in network:
        kind = type(layer)  # not isinstance, because a subclass may compute something else
        if kind in (nn.Conv2d, nn.MaxPool2d):
            if not _plain(layer):
                return None
            windows.append((_side(layer.kernel_size), _side(layer.stride)))
        elif kind is nn.BatchNorm2d:
            if not (layer.affine and layer.track_running_stats and layer.momentum):
                return None
        elif kind not in (nn.ReLU, nn.Flatten, nn.Linear):
            return None
    return windows or None


def _plain(layer: Any) -> bool:
    """Say whether a convolution or pooling has square windows that lie inside the image and see all channels."""
    square = _side(layer.kernel_size) > 0 and _side(layer.stride) > 0
    inside = _side(layer.padding) == 0 and _side(layer.dilation) == 1
    if isinstance(layer, nn.Conv2d):
        return square and inside and layer.groups == 1
    return square and inside and not layer.ceil_mode


def _side(size: Any) -> Any:
    """Return the side of a square window, or -1 if the window is not square."""
    height, width = np.broadcast_to(size, 2).tolist()
    return height if height == width else -1


def make_tables(network: nn.Sequential, *parts: Array) -> Tables | None:
    """Return the distinct patches that ``network`` sees in images, uint8 (N, H, W, C), of one part after another.

    Returns None if too few patches repeat to be worthwhile, or if the network has unsupported layers.
    """
    windows = windows_of(network)
    if windows is None or parts[0].dtype != np.uint8:
        return None
    pixels = prod(parts[0].shape[1:3])
    count = max(1, min(SAMPLE, SAMPLE_PIXELS // pixels))
    some = [part[spread_rows(len(part), count)] for part in parts]
    sample = tables_of(np.concatenate(some), windows)
    if not _worthwhile(sample, network):
        return None
    return tables_of(np.concatenate(parts), windows)


def _worthwhile(sample: Tables, network: nn.Sequential) -> bool:
    """Say whether computing a sample's distinct patches takes less than ``WORTHWHILE`` of the work of a plain pass.

    Work is the number of multiplications and comparisons.
    """
    tabled = plain = 0
    layers = [layer for layer in network if isinstance(layer, nn.Conv2d | nn.MaxPool2d)]
    for level, layer in zip(sample.levels, layers, strict=True):
        work = level.parts.shape[1]  # operations at one place
        if isinstance(layer, nn.Conv2d):
            work = layer.weight.numel()
        tabled += len(level.parts) * work
        plain += level.rows.shape[1] * level.lines.size * work
    return tabled < WORTHWHILE * plain


def tables_of(
    observations: Bytes,
    windows: Sequence[tuple[int, int]],
) -> Tables:
    """Return the distinct patches of images, uint8 (N, H, W, C), in ``windows_of`` a network, level by level.

    It does not matter whether many patches repeat. At each level, the steps find strips of distinct rows, then bands
    of rows, then strips in bands.
    """
    count, height, width, channels = observations.shape
    lines, pixel_rows = distinct_items(
        observations.reshape(
            count * height,
            width * channels,
        )
    )
    lines = lines.reshape(count, height)
    rows, colours = distinct_items(pixel_rows.reshape(-1, channels))
    rows = rows.reshape(-1, width)
    distinct = len(colours)
    levels = []
    for kernel, stride in windows:
        strip_rows, strips = join(_strided(rows, kernel, stride), distinct)
        lines, bands = join(_strided(lines, kernel, stride), len(rows))
        in_bands = [strip_rows[bands[:, row]] for row in range(kernel)]
        rows, stacks = join(in_bands, len(strips))
        parts = strips[stacks].reshape(len(stacks), -1)
        levels.append(Level(parts, rows, lines))
        distinct = len(parts)
    return Tables(
        torch.from_numpy(colours.astype(np.float32)).div_(255.0),
        tuple(levels),
    )


def _strided(values: Ids, kernel: int, stride: int) -> list[Ids]:
    """Return ``kernel`` arrays (..., number of windows).

    For each offset in a window, the array has the values (..., W) at that offset.
    """
    after = values.shape[-1] - kernel + 1
    return [values[..., offset : after + offset : stride] for offset in range(kernel)]


def take(tables: Tables, *groups: Ints) -> PatchBatch:
    """Return the patches of groups of images, given by index (B,).

    Images that occur several times count several times.
    """
    parts: list[list[Ints]] = [[] for _ in tables.levels]
    shares: list[list[tuple[Tensor, int]]] = [[] for _ in tables.levels]
    before = [0] * len(parts)  # at each level, the number of patches of earlier groups
    last = []
    for images in groups:
        used = np.arange(len(tables.colours))  # ids of the level below: at first of colours, all of which count as used
        offset = 0
        for number, level in enumerate(tables.levels):
            rows = level.lines[images]
            ids = level.rows[rows]
            ranks, occurring = rank(ids, len(level.parts))
            counts = np.bincount(ranks.ravel())
            share = counts / ids.size
            of_group = torch.from_numpy(share.astype(np.float32))
            shares[number].append((of_group[None], ids.size))
            below = positions(level.parts[occurring], used)
            parts[number].append(below + offset)
            used, offset = occurring, before[number]
            before[number] += len(occurring)
        places = ranks.reshape(len(images), -1)
        last.append(places.astype(int) + offset)
    return PatchBatch(
        tables.colours,
        [torch.from_numpy(np.concatenate(of_groups)) for of_groups in parts],
        shares,
        torch.from_numpy(np.concatenate(last)),
    )


def forward(
    network: nn.Sequential,
    batch: PatchBatch,
    counted: bool = True,
) -> Tensor:
    """Return the logits (B, 2) of ``network`` for the images of ``batch``, in training or evaluation mode.

    ``windows_of`` must support the network's layers. If the network has no dense layers, the result is the last level's
    patches (U, C), which ``batch.last`` places in the images. In training mode, BatchNorm's running statistics include
    the first group, and include the other groups if they are ``counted``.
    """
    rows, level = batch.colours, -1
    for layer in network:
        if isinstance(layer, nn.Conv2d | nn.MaxPool2d):
            level += 1
            parts = batch.parts[level]
            windows = rows.index_select(0, parts.flatten()).view(*parts.shape, -1)
            if isinstance(layer, nn.Conv2d):
                rows = _convolved(layer, windows)
            elif torch.is_grad_enabled():
                rows = windows.max(dim=1).values  # the gradient goes to the first of equal maxima
            else:
                rows = windows.amax(dim=1)  # the same values in a third of the time
        elif isinstance(layer, nn.BatchNorm2d):
            rows = _batch_norm(layer, rows, batch.shares[level], counted)
        elif isinstance(layer, nn.Flatten):
            images, places = batch.last.shape
            placed = rows.index_select(0, batch.last.flatten())
            grid = placed.view(images, places, -1)
            rows = grid.transpose(1, 2).flatten(start_dim=1)
        else:
            rows = layer(rows)
    return rows


def _convolved(layer: nn.Conv2d, windows: Tensor) -> Tensor:
    """Convolve windows (U, k * k, C) to features (U, features)."""
    ordered = layer.weight.permute(2, 3, 1, 0)
    weight = ordered.reshape(-1, layer.out_channels)
    return functional.linear(windows.flatten(1), weight.T, layer.bias)


def _batch_norm(
    layer: Any,
    rows: Tensor,
    shares: Sequence[tuple[Tensor, int]],
    counted: bool,
) -> Tensor:
    """Apply BatchNorm to rows (U, C), group after group.

    Each row is weighted by its share of its group's places.
    """
    if not layer.training:
        scale = layer.weight * torch.rsqrt(layer.running_var + layer.eps)
        return torch.addcmul(layer.bias - layer.running_mean * scale, rows, scale)
    sizes = [share.shape[1] for share, _ in shares]
    normed = []
    groups = rows.split(sizes)
    for number, group in enumerate(groups):
        share, places = shares[number]
        mean = share @ group
        centred = group - mean
        variance = share @ centred.square()
        if counted or number == 0:
            with torch.no_grad():
                layer.running_mean.lerp_(mean[0], layer.momentum)
                layer.running_var.lerp_(
                    variance[0] * (places / max(places - 1, 1)),
                    layer.momentum,
                )
                layer.num_batches_tracked.add_(1)
        normed.append(
            torch.addcmul(
                layer.bias,
                centred,
                layer.weight * torch.rsqrt(variance + layer.eps),
            )
        )
    return torch.cat(normed)
