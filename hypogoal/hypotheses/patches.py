"""Convolutions over images made of few distinct patches: each distinct patch is computed once.

A grid world's image repeats a few tiles, so of the thousands of patches that a convolution or pooling sees in a batch
of images, few differ. Here a layer works on a table of the distinct patches, and BatchNorm weights each by its
frequency. Up to rounding, values, gradients and running statistics are those of the plain network, several times faster
on a CPU.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import prod
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from hypogoal.core.arrays import Array, Bytes, Ints
from hypogoal.observations import spread_rows

Ids = NDArray[np.int32]  # of patches, rows or colours
WORTHWHILE = 0.5  # of the plain network's work in convolutions; above, gathering patches costs more than it saves
SAMPLE = 64  # images of each part from which that is estimated,
SAMPLE_PIXELS = 2**19  # or fewer images, within this number of pixels: each takes some 250 bytes
LOOKUP_PER_VALUE = 4  # table entries per value to rank; beyond, sorting is faster


@dataclass(frozen=True)
class Level:
    """The patches that one convolution or pooling sees in N images, by id."""

    parts: Ids  # (U, k * k), each distinct patch as patch ids of the level below (colours for the first)
    rows: Ids  # (R, W), distinct rows of places: the patch at each place
    lines: Ids  # (N, H), each image as indices of rows


@dataclass(frozen=True)
class Tables:
    """Distinct patches of N images: colours float32 (U, C) in 0..1; a level per convolution or pooling."""

    colours: Tensor
    levels: tuple[Level, ...]


@dataclass(frozen=True)
class PatchBatch:
    """The patches in groups of images, group after group.

    BatchNorm sees each group on its own; all other layers see all groups at once.
    """

    colours: Tensor  # float32 (colours, C)
    parts: list[Tensor]  # for each level int64 (U, k * k), indices of the level below, at first of the colours
    # For each level and group float32 (1, U), each patch's share of the group's places, which sum to 1; their number.
    shares: list[list[tuple[Tensor, int]]]
    last: Tensor  # int64 (B, H * W), the last level's patch at each place of all images


def windows_of(network: nn.Sequential) -> list[tuple[int, int]] | None:
    """(kernel size, stride) of each convolution and pooling; None if a layer is not supported."""
    windows = []
    for layer in network:
        kind = type(layer)  # subclasses may compute otherwise
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
    """Whether a convolution or pooling has square windows inside the image, of all channels."""
    square = _side(layer.kernel_size) > 0 and _side(layer.stride) > 0
    inside = _side(layer.padding) == 0 and _side(layer.dilation) == 1
    if isinstance(layer, nn.Conv2d):
        return square and inside and layer.groups == 1
    return square and inside and not layer.ceil_mode


def _side(size: Any) -> Any:
    """The side of a square window; -1 if it is not square."""
    height, width = np.broadcast_to(size, 2).tolist()
    return height if height == width else -1


def make_tables(network: nn.Sequential, *parts: Array) -> Tables | None:
    """The distinct patches of images, uint8 (N, H, W, C), part after part, as ``network`` sees them.

    None if too few repeat to be worthwhile, or if the network has unsupported layers.
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
    """Whether the distinct patches of a sample leave little of a plain pass's multiplications and comparisons."""
    tabled = plain = 0
    layers = [layer for layer in network if isinstance(layer, nn.Conv2d | nn.MaxPool2d)]
    for level, layer in zip(sample.levels, layers, strict=True):
        work = level.parts.shape[1]  # at one place
        if isinstance(layer, nn.Conv2d):
            work = layer.weight.numel()
        tabled += len(level.parts) * work
        plain += level.rows.shape[1] * level.lines.size * work
    return tabled < WORTHWHILE * plain


def tables_of(
    observations: Bytes,
    windows: Sequence[tuple[int, int]],
) -> Tables:
    """The distinct patches of images, uint8 (N, H, W, C), in ``windows_of`` a network, whether or not many repeat.

    Level by level: strips of distinct rows, bands of rows, then strips in bands.
    """
    count, height, width, channels = observations.shape
    lines, pixel_rows = _distinct_items(
        observations.reshape(
            count * height,
            width * channels,
        )
    )
    lines = lines.reshape(count, height)
    rows, colours = _distinct_items(pixel_rows.reshape(-1, channels))
    rows = rows.reshape(-1, width)
    distinct = len(colours)
    levels = []
    for kernel, stride in windows:
        strip_rows, strips = _join(_strided(rows, kernel, stride), distinct)
        lines, bands = _join(_strided(lines, kernel, stride), len(rows))
        in_bands = [strip_rows[bands[:, row]] for row in range(kernel)]
        rows, stacks = _join(in_bands, len(strips))
        parts = strips[stacks].reshape(len(stacks), -1)
        levels.append(Level(parts, rows, lines))
        distinct = len(parts)
    return Tables(
        torch.from_numpy(colours.astype(np.float32)).div_(255.0),
        tuple(levels),
    )


def _strided(values: Ids, kernel: int, stride: int) -> list[Ids]:
    """For each offset in a window, the values (..., W) at that offset: ``kernel`` arrays (..., number of windows)."""
    after = values.shape[-1] - kernel + 1
    return [values[..., offset : after + offset : stride] for offset in range(kernel)]


def _join(pieces: Sequence[Ids], bound: int) -> tuple[Ids, Ids]:
    """Join pieces, of ids below ``bound``, place by place into tuples; the distinct tuples' ids, and the tuples."""
    ids = pieces[0]
    tuples = np.arange(bound, dtype=np.int32)[:, None]
    for piece in pieces[1:]:
        pairs = ids.astype(int) * bound + piece
        ids, distinct = _rank(pairs, len(tuples) * bound)
        before, last = np.divmod(distinct, bound)
        joined = last.astype(np.int32)
        tuples = np.column_stack([tuples[before], joined])
    return ids, tuples


def _rank(values: Ids | Ints, bound: int) -> tuple[Ids, Ints]:
    """Values in 0..bound-1 -> (their ranks among the distinct values, the distinct values in order)."""
    if bound > LOOKUP_PER_VALUE * values.size:
        ordered, inverse = np.unique(values, return_inverse=True)
        whole = inverse.reshape(values.shape)
        return whole.astype(np.int32), ordered.astype(int)
    occurs = np.zeros(bound, bool)
    occurs[values] = True
    ranks = np.cumsum(occurs, dtype=np.int32) - 1
    return ranks[values], np.flatnonzero(occurs)


def _distinct_items(items: Bytes) -> tuple[Ids, Bytes]:
    """Items (N, bytes) -> (indices of distinct items (N,), the distinct items in order of appearance)."""
    size = items.shape[1]
    together = np.ascontiguousarray(items).view(f"V{size}")
    whole = together.ravel().tolist()
    index_of = {item: index for index, item in enumerate(dict.fromkeys(whole))}
    index = np.fromiter(
        map(index_of.__getitem__, whole),
        np.int32,
        len(whole),
    )
    joined = b"".join(index_of)
    distinct = np.frombuffer(joined, np.uint8)
    return index, distinct.reshape(-1, size)


def take(tables: Tables, *groups: Ints) -> PatchBatch:
    """The patches in groups of images, by index (B,); repeated images count repeatedly."""
    parts: list[list[Ints]] = [[] for _ in tables.levels]
    shares: list[list[tuple[Tensor, int]]] = [[] for _ in tables.levels]
    before = [0] * len(parts)  # patches of the earlier groups, at each level
    last = []
    for images in groups:
        used = np.arange(len(tables.colours))  # ids of the level below; every group has all colours
        offset = 0
        for number, level in enumerate(tables.levels):
            rows = level.lines[images]
            ids = level.rows[rows]
            ranks, occurring = _rank(ids, len(level.parts))
            counts = np.bincount(ranks.ravel())
            share = counts / ids.size
            of_group = torch.from_numpy(share.astype(np.float32))
            shares[number].append((of_group[None], ids.size))
            below = _positions(level.parts[occurring], used)
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


def _positions(values: Ids, among: Ints) -> Ints:
    """The index of each value in the sorted ``among``, which has them all."""
    size = int(among[-1]) + 1
    position = np.empty(size, int)
    position[among] = np.arange(len(among))
    return position[values]


def forward(
    network: nn.Sequential,
    batch: PatchBatch,
    counted: bool = True,
) -> Tensor:
    """The logits (B, 2) of ``network`` for the images of ``batch``, in training or evaluation mode.

    Of a network without dense layers the last level's patches, (U, C), which ``batch.last`` places in the images.
    ``windows_of`` must support its layers. In training mode, BatchNorm's running statistics include the first group,
    and the others where they are ``counted``.
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
                rows = windows.max(dim=1).values  # of equals the gradient goes to the first
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
    """A convolution of windows (U, k * k, C) -> (U, features)."""
    ordered = layer.weight.permute(2, 3, 1, 0)
    weight = ordered.reshape(-1, layer.out_channels)
    return functional.linear(windows.flatten(1), weight.T, layer.bias)


def _batch_norm(
    layer: Any,
    rows: Tensor,
    shares: Sequence[tuple[Tensor, int]],
    counted: bool,
) -> Tensor:
    """BatchNorm of rows (U, C), group after group; each row is weighted by its share of its group's places."""
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
