"""Convolutions over images made of few distinct patches: each distinct patch is computed once.

A grid world's image repeats a few tiles, so of the thousands of patches that a convolution or pooling sees in a batch
of images, few differ. Here a layer works on a table of the distinct patches, and BatchNorm weights each by its
frequency. Up to rounding, values, gradients and running statistics are those of the plain network, several times faster
on a CPU.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import prod
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

WORTHWHILE = 0.5  # of the plain network's work in convolutions; above, gathering patches costs more than it saves
SAMPLE = 64  # images from which that is estimated,
SAMPLE_PIXELS = 2**19  # or fewer images, within this number of pixels: each takes some 250 bytes
LOOKUP_PER_VALUE = 4  # table entries per value to rank; beyond, sorting is faster


@dataclass(frozen=True)
class Level:
    """The patches that one convolution or pooling sees in N images, by id."""

    parts: NDArray[np.int32]  # (U, k * k), each distinct patch as patch ids of the level below (colours for the first)
    rows: NDArray[np.int32]  # (R, W), distinct rows of places: the patch at each place
    lines: NDArray[np.int32]  # (N, H), each image as indices of rows


@dataclass(frozen=True)
class Tables:
    """Distinct patches of N images: colours float32 (U, C) in 0..1; a level per convolution or pooling."""

    colours: Tensor
    levels: tuple[Level, ...]


@dataclass(frozen=True)
class Batch:
    """The patches in groups of images, group after group.

    BatchNorm sees each group on its own; all other layers see all groups at once.
    """

    first: Tensor  # float32 (U, k * k, C), the patches of the first level
    parts: tuple[Tensor, ...]  # for each level above it int64 (U * k * k,), indices of the level below
    # For each level and group float32 (1, U), each patch's share of the group's places; they sum to 1.
    shares: tuple[tuple[Tensor, ...], ...]
    places: tuple[tuple[int, ...], ...]  # for each level and group, the number of places
    last: Tensor  # int64 (B, H * W), the last level's patch at each place of all images


def windows_of(network: nn.Sequential) -> list[tuple[int, int]] | None:
    """(kernel size, stride) of each convolution and pooling; None if a layer is not supported."""
    windows = []
    for layer in network:
        if type(layer) in (nn.Conv2d, nn.MaxPool2d):  # subclasses may compute otherwise
            kernel, stride = _side(layer.kernel_size), _side(layer.stride)
            plain = min(kernel, stride) > 0 and _side(layer.padding) == 0 and _side(layer.dilation) == 1
            if not plain or getattr(layer, "groups", 1) != 1 or getattr(layer, "ceil_mode", False):
                return None
            windows.append((kernel, stride))
        elif type(layer) is nn.BatchNorm2d:
            if not (layer.affine and layer.track_running_stats and layer.momentum):
                return None
        elif type(layer) not in (nn.ReLU, nn.Flatten, nn.Linear):
            return None
    return windows or None


def _side(size: object) -> int:
    """The side of a square window; -1 if it is not square."""
    if isinstance(size, int):
        return size
    return size[0] if isinstance(size, tuple) and size[0] == size[1] else -1


def make_tables(observations: Sequence[NDArray[Any]], network: nn.Sequential) -> Tables | None:
    """The distinct patches of images, arrays uint8 (N, H, W, C) one after another, as ``network`` sees them.

    None if too few repeat to be worthwhile, or if the network has unsupported layers.
    """
    windows, total = windows_of(network), sum(map(len, observations))
    if windows is None or total == 0 or observations[0].dtype != np.uint8:
        return None
    few = total <= 2 * SAMPLE  # of which all are looked at once
    count = total if few else SAMPLE
    count = max(1, min(count, SAMPLE_PIXELS // prod(observations[0].shape[1:3])))
    spread = np.linspace(0, total - 1, count).astype(np.int64)
    firsts = np.cumsum([0, *map(len, observations)])
    rows = [spread[(spread >= first) & (spread < end)] - first for first, end in pairwise(firsts)]
    sample = _tables(np.concatenate([some[which] for some, which in zip(observations, rows, strict=True)]), windows)
    spatial = [layer for layer in network if isinstance(layer, (nn.Conv2d, nn.MaxPool2d))]
    work = [  # multiplications, or comparisons, of each layer at one place
        layer.weight.numel() if isinstance(layer, nn.Conv2d) else kernel**2
        for layer, (kernel, _) in zip(spatial, windows, strict=True)
    ]
    tabled = sum(len(level.parts) * each for level, each in zip(sample.levels, work, strict=True))
    plain = sum(level.rows.shape[1] * level.lines.size * each for level, each in zip(sample.levels, work, strict=True))
    if tabled >= WORTHWHILE * plain:
        return None
    return sample if count == total else _tables(np.concatenate(observations), windows)


def _tables(observations: NDArray[np.uint8], windows: Sequence[tuple[int, int]]) -> Tables:
    count, height, width, channels = observations.shape
    lines, pixel_rows = _distinct_items(observations.reshape(count * height, width * channels))
    lines, pixel_rows = lines.reshape(count, height), pixel_rows.reshape(-1, width, channels)
    rows, colours = _distinct_items(pixel_rows.reshape(-1, pixel_rows.shape[2]))
    rows = rows.reshape(pixel_rows.shape[:2])
    levels: list[Level] = []
    for kernel, stride in windows:
        distinct = len(levels[-1].parts) if levels else len(colours)
        # Distinct kernel x kernel windows: strips of ``kernel`` in distinct rows, bands of rows, then strips in bands.
        strip_rows, strips = _join(_strided(rows, kernel, stride), distinct)
        lines, bands = _join(_strided(lines, kernel, stride), len(rows))
        rows, stacks = _join([strip_rows[bands[:, row]] for row in range(kernel)], len(strips))
        levels.append(Level(strips[stacks].reshape(len(stacks), -1), rows, lines))
    return Tables(torch.from_numpy(colours.astype(np.float32)).div_(255.0), tuple(levels))


def _strided(values: NDArray[np.int32], kernel: int, stride: int) -> list[NDArray[np.int32]]:
    """For each offset in a window, the values (..., W) at that offset: ``kernel`` arrays (..., number of windows)."""
    return [values[..., offset : values.shape[-1] - kernel + offset + 1 : stride] for offset in range(kernel)]


def _join(pieces: Sequence[NDArray[np.int32]], bound: int) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Join pieces, of ids below ``bound``, place by place into tuples; the distinct tuples' ids, and the tuples."""
    ids, tuples = pieces[0], np.arange(bound, dtype=np.int32)[:, None]
    for piece in pieces[1:]:
        ids, distinct = _rank(ids.astype(np.int64) * bound + piece, len(tuples) * bound)
        last = (distinct % bound).astype(np.int32)[:, None]
        tuples = np.concatenate([tuples[distinct // bound], last], axis=1)
    return ids, tuples


def _rank(values: NDArray[np.int64], bound: int) -> tuple[NDArray[np.int32], NDArray[np.int64]]:
    """Values in 0..bound-1 -> (their ranks among the distinct values, the distinct values in order)."""
    if bound > LOOKUP_PER_VALUE * values.size:
        distinct, ranks = np.unique(values, return_inverse=True)
        return ranks.reshape(values.shape).astype(np.int32), distinct
    occurs = np.zeros(bound, dtype=np.bool_)
    occurs[values] = True
    return (np.cumsum(occurs, dtype=np.int32) - 1)[values], np.flatnonzero(occurs)


def _distinct_items(items: NDArray[np.uint8]) -> tuple[NDArray[np.int32], NDArray[np.uint8]]:
    """Items (N, bytes) -> (indices of distinct items (N,), the distinct items in order of appearance)."""
    whole: list[bytes] = np.ascontiguousarray(items).view(f"V{items.shape[1]}").ravel().tolist()
    index_of = {item: index for index, item in enumerate(dict.fromkeys(whole))}
    index = np.fromiter(map(index_of.__getitem__, whole), np.int32, len(whole))
    return index, np.frombuffer(b"".join(index_of), np.uint8).reshape(-1, items.shape[1])


def take(tables: Tables, *groups: NDArray[np.int64], times: NDArray[np.int64] | None = None) -> Batch:
    """The patches in groups of images, by index (B,); repeated images count repeatedly.

    BatchNorm counts image n of each group ``times[n]`` times, once where None.
    """
    levels = len(tables.levels)
    parts: list[list[NDArray[np.int64]]] = [[] for _ in range(levels)]
    shares: list[list[Tensor]] = [[] for _ in range(levels)]
    places: list[list[int]] = [[] for _ in range(levels)]
    before = [0] * levels  # patches of the earlier groups, at each level
    last = []
    for images in groups:
        used = np.arange(len(tables.colours))  # ids of the level below; every group has all colours
        offset = 0
        for index, level in enumerate(tables.levels):
            ids = level.rows[level.lines[images]]
            ranks, occurring = _rank(ids.astype(np.int64), len(level.parts))
            each = ids[0].size
            weights = None if times is None else np.repeat(times, each)
            occurrences = np.bincount(ranks.ravel(), weights, minlength=len(occurring))
            counted = ids.size if times is None else int(times.sum()) * each
            parts[index].append(_positions(level.parts[occurring].ravel(), used) + offset)
            shares[index].append(torch.from_numpy((occurrences / counted).astype(np.float32))[None])
            places[index].append(counted)
            used, offset = occurring, before[index]
            before[index] += len(occurring)
        last.append(ranks.reshape(len(images), -1).astype(np.int64) + offset)
    colours, *above = (torch.from_numpy(np.concatenate(of_groups)) for of_groups in parts)
    channels = tables.colours.shape[1]
    return Batch(
        tables.colours.index_select(0, colours).view(-1, tables.levels[0].parts.shape[1], channels),
        tuple(above),
        tuple(map(tuple, shares)),
        tuple(map(tuple, places)),
        torch.from_numpy(np.concatenate(last)),
    )


def _positions(values: NDArray[np.int32], among: NDArray[np.int64]) -> NDArray[np.int64]:
    """The index of each value in the sorted ``among``, which has them all."""
    if among[-1] < LOOKUP_PER_VALUE * values.size:
        position = np.empty(int(among[-1]) + 1, dtype=np.int64)
        position[among] = np.arange(len(among))
        return position[values]
    return np.searchsorted(among, values)


def forward(network: nn.Sequential, batch: Batch, counted: bool = True) -> Tensor:
    """The logits (B, 2) of ``network`` for the images of ``batch``, in training or evaluation mode.

    Of a network without dense layers the last level's patches, (U, C), which ``batch.last`` places in the images.
    ``windows_of`` must support its layers. In training mode, BatchNorm's running statistics include the first group,
    and the others where they are ``counted``.
    """
    rows, level = batch.first, -1
    for layer in network:
        if isinstance(layer, (nn.Conv2d, nn.MaxPool2d)):
            level += 1
            window = _side(layer.kernel_size) ** 2
            windows = rows.index_select(0, batch.parts[level - 1]).view(-1, window, rows.shape[1]) if level else rows
            if isinstance(layer, nn.MaxPool2d):
                # Of equals the gradient goes to the first; where there is none, the values alone take a third.
                rows = windows.max(dim=1).values if torch.is_grad_enabled() else windows.amax(dim=1)
            else:
                weight = layer.weight.permute(2, 3, 1, 0).reshape(-1, layer.out_channels)
                flat = windows.view(-1, len(weight))
                rows = flat @ weight if layer.bias is None else torch.addmm(layer.bias, flat, weight)
        elif isinstance(layer, nn.BatchNorm2d):
            rows = _batch_norm(layer, rows, batch.shares[level], batch.places[level], counted)
        elif isinstance(layer, nn.Flatten):
            images, places = batch.last.shape
            grid = rows.index_select(0, batch.last.flatten()).view(images, places, rows.shape[1])
            rows = grid.transpose(1, 2).flatten(start_dim=1)
        else:
            rows = layer(rows)
    return rows


def _batch_norm(
    layer: nn.BatchNorm2d, rows: Tensor, shares: Sequence[Tensor], places: Sequence[int], counted: bool
) -> Tensor:
    """BatchNorm of rows (U, C), group after group; each row is weighted by its share of its group's places."""
    if not layer.training:
        running_mean, running_var = layer.running_mean, layer.running_var
        assert running_mean is not None
        assert running_var is not None
        scale = layer.weight * torch.rsqrt(running_var + layer.eps)
        return torch.addcmul(layer.bias - running_mean * scale, rows, scale)
    groups = zip(rows.split([share.shape[1] for share in shares]), shares, places, [True, counted], strict=False)
    of_groups = [normed(layer, part, share.matmul, count, counts) for part, share, count, counts in groups]
    return of_groups[0] if len(of_groups) == 1 else torch.cat(of_groups)


def normed(
    layer: nn.BatchNorm2d, rows: Tensor, average: Callable[[Tensor], Tensor], places: int, counted: bool = True
) -> Tensor:
    """BatchNorm in training mode of rows (U, C); ``average`` is over so many places.

    The layer's running statistics include them where they are ``counted``.
    """
    mean = average(rows)
    centred = rows - mean
    variance = average(centred.square())
    if counted:
        running_mean, running_var = layer.running_mean, layer.running_var
        assert running_mean is not None
        assert running_var is not None
        with torch.no_grad():
            momentum = layer.momentum
            assert momentum  # see ``windows_of``
            running_mean.lerp_(mean[0], momentum)
            running_var.lerp_(variance[0] * (places / max(places - 1, 1)), momentum)
            if layer.num_batches_tracked is not None:
                layer.num_batches_tracked.add_(1)
    return torch.addcmul(layer.bias, centred, layer.weight * torch.rsqrt(variance + layer.eps))
