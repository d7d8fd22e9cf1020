"""Convolutions over images that are made of few distinct patches: each distinct patch is computed once.

A grid world's image repeats a few tiles, so of the thousands of places where a convolution or a pooling
looks in a batch of images, few differ. Here a layer works on a table of the distinct patches, and BatchNorm
weighs each by how often it occurs. Up to rounding this is the plain network, values, gradients and running
statistics alike, several times faster on a CPU.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

WORTHWHILE = 0.1  # distinct patches per place, above which the plain network is about as fast
SAMPLE = 64  # images from which that is judged
LOOKUP_PER_VALUE = 4  # size of a table that ranks values; where it would be larger, sorting them is faster


@dataclass(frozen=True)
class Level:
    """What one convolution or pooling looks at in N images, by patch ids.

    Attributes:
        parts: int64 (U, k * k), each distinct patch as patch ids of the level below (colours for the first).
        rows: int64 (R, W), distinct rows of places: the patch at each.
        lines: int64 (N, H), each image as indices of rows.
    """

    parts: NDArray[np.int64]
    rows: NDArray[np.int64]
    lines: NDArray[np.int64]


@dataclass(frozen=True)
class Tables:
    """Distinct patches of N images: colours float32 (U, C) in 0..1; a level per convolution or pooling."""

    colours: Tensor
    levels: tuple[Level, ...]


@dataclass(frozen=True)
class Batch:
    """The patches that occur in B images.

    Attributes:
        colours: float32 (U, C).
        parts: for each level int64 (U * k * k,), indices of the level below.
        shares: for each level float32 (1, U), the share of all places where each patch lies; sums to 1.
        places: for each level, how many places there are.
        last: int64 (B, H * W), the last level's patch at each place.
    """

    colours: Tensor
    parts: tuple[Tensor, ...]
    shares: tuple[Tensor, ...]
    places: tuple[int, ...]
    last: Tensor


def windows_of(network: nn.Sequential) -> list[tuple[int, int]] | None:
    """(kernel size, stride) of each convolution and pooling; None where a layer is of no supported kind."""
    windows = []
    for layer in network:
        if isinstance(layer, (nn.Conv2d, nn.MaxPool2d)):
            kernel, stride = _side(layer.kernel_size), _side(layer.stride)
            plain = min(kernel, stride) > 0 and _side(layer.padding) == 0 and _side(layer.dilation) == 1
            if not plain or getattr(layer, "groups", 1) != 1 or getattr(layer, "ceil_mode", False):
                return None
            windows.append((kernel, stride))
        elif not isinstance(layer, (nn.BatchNorm2d, nn.ReLU, nn.Flatten, nn.Linear)):
            return None
    return windows or None


def _side(size: object) -> int:
    """The side of a square window; -1 for one that is not square."""
    if isinstance(size, int):
        return size
    return size[0] if isinstance(size, tuple) and size[0] == size[1] else -1


def make_tables(observations: NDArray[np.uint8], windows: Sequence[tuple[int, int]] | None) -> Tables | None:
    """The distinct patches of images uint8 (N, H, W, C); None where too few repeat to be worthwhile."""
    if windows is None or len(observations) == 0:
        return None
    spread = np.linspace(0, len(observations) - 1, min(SAMPLE, len(observations))).astype(np.int64)
    sample = _tables(observations[spread], windows)
    distinct = sum(len(level.parts) for level in sample.levels)
    places = sum(level.rows.shape[1] * level.lines.size for level in sample.levels)
    return _tables(observations, windows) if distinct < WORTHWHILE * places else None


def _tables(observations: NDArray[np.uint8], windows: Sequence[tuple[int, int]]) -> Tables:
    count, height, width, channels = observations.shape
    lines, pixel_rows = _distinct_items(observations.reshape(count * height, width * channels))
    rows, colours = _distinct_items(pixel_rows.reshape(-1, channels))
    lines, rows = lines.reshape(count, height), rows.reshape(-1, width)
    levels: list[Level] = []
    for kernel, stride in windows:
        distinct = len(levels[-1].parts) if levels else len(colours)
        levels.append(_level(rows, lines, distinct, kernel, stride))
        rows, lines = levels[-1].rows, levels[-1].lines
    return Tables(torch.from_numpy(colours.astype(np.float32)).div_(255.0), tuple(levels))


def _level(rows: NDArray[np.int64], lines: NDArray[np.int64], distinct: int, kernel: int, stride: int) -> Level:
    """Distinct kernel x kernel windows: first bands of ``kernel`` rows, then windows in distinct bands."""
    lines, bands = _join(_strided(lines, kernel, stride), np.arange(len(rows))[:, None])
    high = rows[bands]  # (R, kernel, W)
    pieces = [piece for row in range(kernel) for piece in _strided(high[:, row], kernel, stride)]
    ids, parts = _join(pieces, np.arange(distinct)[:, None])
    return Level(parts, ids, lines)


def _strided(values: NDArray[np.int64], kernel: int, stride: int) -> Iterator[NDArray[np.int64]]:
    """For each offset in a window, the values (..., W) there: ``kernel`` arrays (..., number of windows)."""
    count = (values.shape[-1] - kernel) // stride + 1
    for offset in range(kernel):
        yield values[..., offset : offset + stride * (count - 1) + 1 : stride]


def _join(
    pieces: Iterator[NDArray[np.int64]] | list[NDArray[np.int64]], parts: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Ids of the distinct tuples that pieces (ids of ``parts``) form place by place, and the tuples."""
    first, *others = pieces
    ids, joined = first, parts
    for piece in others:
        ids, distinct = _rank(ids * len(parts) + piece, len(joined) * len(parts))
        joined = np.concatenate([joined[distinct // len(parts)], parts[distinct % len(parts)]], axis=1)
    return ids, joined


def _rank(values: NDArray[np.int64], bound: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Values in 0..bound-1 -> (each one's rank among the distinct ones, the distinct ones in order)."""
    if bound > LOOKUP_PER_VALUE * values.size:
        distinct, ranks = np.unique(values, return_inverse=True)
        return ranks.reshape(values.shape), distinct
    occurs = np.zeros(bound, dtype=np.bool_)
    occurs[values] = True
    return (np.cumsum(occurs) - 1)[values], np.flatnonzero(occurs)


def _distinct_items(items: NDArray[np.uint8]) -> tuple[NDArray[np.int64], NDArray[np.uint8]]:
    """Items (N, bytes) -> (index among the distinct ones (N,), the distinct ones in order of appearance)."""
    whole: list[bytes] = np.ascontiguousarray(items).view(f"V{items.shape[1]}").ravel().tolist()
    index_of = {item: index for index, item in enumerate(dict.fromkeys(whole))}
    index = np.fromiter(map(index_of.__getitem__, whole), np.int64, len(whole))
    return index, np.frombuffer(b"".join(index_of), np.uint8).reshape(-1, items.shape[1])


def take(tables: Tables, images: NDArray[np.int64]) -> Batch:
    """The patches that occur in the images with indices (B,); an image that is given twice counts twice."""
    parts, shares, places = [], [], []
    position = np.arange(len(tables.colours))  # of each patch of the level below among those that occur
    ids = np.zeros(0, dtype=np.int64)
    for level in tables.levels:
        ids = level.rows[level.lines[images]]
        occurrences = np.bincount(ids.ravel(), minlength=len(level.parts))
        used = np.flatnonzero(occurrences)
        parts.append(torch.from_numpy(position[level.parts[used]].ravel()))
        shares.append(torch.from_numpy((occurrences[used] / ids.size).astype(np.float32))[None])
        places.append(ids.size)
        position = np.zeros(len(level.parts), dtype=np.int64)
        position[used] = np.arange(len(used))
    last = torch.from_numpy(position[ids].reshape(len(images), -1))
    return Batch(tables.colours, tuple(parts), tuple(shares), tuple(places), last)


def forward(network: nn.Sequential, batch: Batch) -> Tensor:
    """Logits (B, 2) that ``network`` gives the images of ``batch``, in its training or evaluation mode."""
    rows, level = batch.colours, -1
    for layer in network:
        if isinstance(layer, nn.Conv2d):
            level += 1
            weight = layer.weight.permute(2, 3, 1, 0).reshape(-1, layer.out_channels)
            seen = rows.index_select(0, batch.parts[level]).view(-1, len(weight))
            rows = seen @ weight if layer.bias is None else torch.addmm(layer.bias, seen, weight)
        elif isinstance(layer, nn.MaxPool2d):
            level += 1
            window = _side(layer.kernel_size) ** 2
            rows = rows.index_select(0, batch.parts[level]).view(-1, window, rows.shape[1]).max(dim=1).values
        elif isinstance(layer, nn.BatchNorm2d):
            rows = _batch_norm(layer, rows, batch.shares[level], batch.places[level])
        elif isinstance(layer, nn.Flatten):
            images, places = batch.last.shape
            grid = rows.index_select(0, batch.last.flatten()).view(images, places, rows.shape[1])
            rows = grid.transpose(1, 2).flatten(start_dim=1)
        else:
            rows = layer(rows)
    return rows


def _batch_norm(layer: nn.BatchNorm2d, rows: Tensor, shares: Tensor, places: int) -> Tensor:
    """BatchNorm of rows (U, C), each of which stands for its share (1, U) of all places."""
    running_mean, running_var = layer.running_mean, layer.running_var
    assert running_mean is not None
    assert running_var is not None
    if not layer.training:
        scale = layer.weight * torch.rsqrt(running_var + layer.eps)
        return torch.addcmul(layer.bias - running_mean * scale, rows, scale)
    mean = shares @ rows
    centred = rows - mean
    variance = shares @ centred.square()
    with torch.no_grad():
        momentum = layer.momentum or 0.0
        running_mean.lerp_(mean[0], momentum)
        running_var.lerp_(variance[0] * (places / max(places - 1, 1)), momentum)
        if layer.num_batches_tracked is not None:
            layer.num_batches_tracked.add_(1)
    return torch.addcmul(layer.bias, centred, layer.weight * torch.rsqrt(variance + layer.eps))
