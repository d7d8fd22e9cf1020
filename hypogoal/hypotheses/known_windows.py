"""A cache of convolutions' outputs for windows of images: in a grid world few windows of a new state are new.

Each output of a stack of convolutions and poolings depends on one square window of pixels. A state that differs from
known ones in a cell or two has one or two new windows; the outputs for the others are looked up.

A new window is computed by itself, so that its outputs are the same whenever that happens, also after a break: rounding
may depend on a batch's size and on the place in it. Its places are gathered for matrix products; for one window, what a
library prepares for a convolution takes several times as long as its arithmetic.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import islice

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from hypogoal.hypotheses.patches import windows_of

MOST_WINDOWS = 16_384  # windows kept; with 960 outputs each, 63 MB


def split_of(network: nn.Sequential) -> int | None:
    """The number of layers up to a network's last convolution; None without one, or if a layer is not supported."""
    places = [index for index, layer in enumerate(network) if isinstance(layer, nn.Conv2d)]
    return places[-1] + 1 if places and windows_of(network) is not None else None


class KnownWindows:
    """The outputs of convolutions for windows, by the windows' pixels.

    ``layers`` of the network and the weights of all ``members`` joined, as of :class:`~.stacked.StackedMembers`; the
    last is a convolution whose output for a window of ``side`` pixels has one place. Windows are ``stride`` pixels
    apart. Beyond ``most`` windows the cache starts over.
    """

    def __init__(self, layers: Sequence[tuple[nn.Module, Sequence[Tensor]]], members: int, most: int = MOST_WINDOWS):
        self.most = most
        self.side, self.stride = 1, 1
        for kernel, step in windows_of(nn.Sequential(*(layer for layer, _ in layers))) or []:
            self.side, self.stride = self.side + (kernel - 1) * self.stride, self.stride * step
        self._layers: list[_Gathered | None] = []
        side, groups = self.side, 1
        for layer, weights in layers:
            if isinstance(layer, nn.ReLU):
                self._layers.append(None)
            else:
                gathered = _Gathered(layer, weights, side, groups, members)
                self._layers.append(gathered)
                side, groups = gathered.side, members if weights else groups
        self._rows: dict[bytes, int] = {}
        self._table = torch.empty(0)

    def of(self, images: NDArray[np.uint8]) -> Tensor:
        """The outputs float32 (N, F, h, w) for images uint8 (N, H, W, C)."""
        views = np.lib.stride_tricks.sliding_window_view(images, (self.side, self.side), axis=(1, 2))
        views = views[:, :: self.stride, :: self.stride].transpose(0, 1, 2, 4, 5, 3)
        count, height, width, *shape = views.shape
        pixels = np.ascontiguousarray(views).reshape(count * height * width, -1)
        whole: list[bytes] = pixels.view(f"V{pixels.shape[1]}").ravel().tolist()
        room = self.most - len(self._rows)
        if len(whole) > room and len({*whole}.difference(self._rows)) > room:
            self._rows.clear()
        before = len(self._rows)
        rows = [self._rows.setdefault(window, len(self._rows)) for window in whole]
        if new := len(self._rows) - before:
            self._learn([*islice(reversed(self._rows), new)][::-1], before, shape[-1])
        outputs = self._table.index_select(0, torch.tensor(rows))
        return outputs.view(count, height, width, -1).permute(0, 3, 1, 2)

    def _learn(self, windows: Sequence[bytes], first: int, channels: int) -> None:
        for row, window in enumerate(windows, start=first):
            self._keep(row, self._outputs(window, channels))

    def _outputs(self, window: bytes, channels: int) -> Tensor:
        """Of a window's pixels: float32 (F,)."""
        pixels = np.frombuffer(window, dtype=np.uint8).astype(np.float32)
        rows = torch.from_numpy(pixels).div_(255.0).view(1, -1, channels)
        for layer in self._layers:
            rows = rows.relu() if layer is None else layer(rows)
        return rows.flatten()

    def _keep(self, row: int, outputs: Tensor) -> None:
        if row >= len(self._table):
            more = torch.empty((max(row + 1, 2 * len(self._table), 1024) - len(self._table), len(outputs)))
            self._table = torch.cat([self._table.view(-1, len(outputs)), more])
        self._table[row] = outputs


class _Gathered:
    """A convolution or pooling of one window: float32 (groups, places, channels) -> (members, places, channels)."""

    def __init__(self, layer: nn.Module, weights: Sequence[Tensor], side: int, groups: int, members: int):
        assert isinstance(layer, (nn.Conv2d, nn.MaxPool2d))
        ((kernel, stride),) = windows_of(nn.Sequential(layer)) or []
        self.side, self.window, self.members = (side - kernel) // stride + 1, kernel**2, members
        corner, offset = stride * np.arange(self.side), np.arange(kernel)
        line = (corner[:, None, None, None] + offset[:, None]) * side
        self.places = torch.from_numpy((line + corner[:, None, None] + offset).ravel())
        self.weight: Tensor | None = None
        if weights:
            of_groups = weights[0].unflatten(0, (groups, -1)).permute(0, 3, 4, 2, 1)
            self.weight = of_groups.reshape(groups, -1, of_groups.shape[-1])
            bias = weights[1] if len(weights) > 1 else torch.zeros(len(weights[0]))
            self.bias = bias.view(groups, 1, -1)

    def __call__(self, rows: Tensor) -> Tensor:
        gathered = rows.index_select(1, self.places)
        if self.weight is None:
            return gathered.unflatten(1, (-1, self.window)).amax(2)
        outputs = torch.baddbmm(self.bias, gathered.view(len(rows), self.side**2, -1), self.weight)
        if len(rows) == self.members:
            return outputs
        return outputs.view(self.side**2, self.members, -1).transpose(0, 1)
