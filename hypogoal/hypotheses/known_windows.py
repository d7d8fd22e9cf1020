"""A cache of convolutions' outputs for windows of images: in a grid world few windows of a new state are new.

Each output of a stack of convolutions and poolings depends on one square window of pixels. A state that differs from
known ones in a cell or two has one or two new windows; the outputs for the others are looked up.

Rounding may depend on a batch's size and on the place in it. So that a window has the same outputs whenever they are
computed, also after a break, all batches have one size and a window's pixels determine its place.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from hypogoal.hypotheses.networks import as_input
from hypogoal.hypotheses.patches import windows_of

MOST_WINDOWS = 16_384  # windows kept; with 960 outputs each, 63 MB
BATCH = 4  # windows computed at once, always


def split_of(network: nn.Sequential) -> tuple[int, int, int] | None:
    """The number of layers up to a network's last convolution, and its windows' side and stride in pixels.

    None without a convolution, or if a layer is not supported.
    """
    windows = windows_of(network)
    places = [index for index, layer in enumerate(network) if isinstance(layer, nn.Conv2d)]
    if windows is None or not places:
        return None
    layers = places[-1] + 1
    spatial = sum(isinstance(layer, (nn.Conv2d, nn.MaxPool2d)) for layer in list(network)[:layers])
    side, stride = 1, 1
    for kernel, step in windows[:spatial]:
        side, stride = side + (kernel - 1) * stride, stride * step
    return layers, side, stride


class KnownWindows:
    """The outputs for windows, by the windows' pixels.

    ``compute`` maps float32 (BATCH, C, side, side) in 0..1 to float32 (BATCH, F, 1, 1); ``side`` and ``stride`` are in
    pixels. Beyond ``most`` windows the cache starts over.
    """

    def __init__(self, compute: Callable[[Tensor], Tensor], side: int, stride: int, most: int = MOST_WINDOWS):
        self.compute, self.side, self.stride, self.most = compute, side, stride, most
        self._rows: dict[bytes, int] = {}
        self._table = torch.empty(0)

    def of(self, images: NDArray[np.uint8]) -> Tensor:
        """The outputs float32 (N, F, h, w) for images uint8 (N, H, W, C)."""
        views = np.lib.stride_tricks.sliding_window_view(images, (self.side, self.side), axis=(1, 2))
        views = views[:, :: self.stride, :: self.stride].transpose(0, 1, 2, 4, 5, 3)
        count, height, width, *shape = views.shape
        pixels = np.ascontiguousarray(views).reshape(count * height * width, -1)
        whole: list[bytes] = pixels.view(f"V{pixels.shape[1]}").ravel().tolist()
        if len(self._rows) + len(whole) > self.most:  # at most so many are new
            new = len({*whole}.difference(self._rows))
            if len(self._rows) + new > self.most:
                self._rows.clear()
        before = len(self._rows)
        rows = [self._rows.setdefault(window, len(self._rows)) for window in whole]
        if len(self._rows) > before:
            self._compute([*self._rows][before:], before, shape)
        outputs = self._table.index_select(0, torch.tensor(rows))
        return outputs.view(count, height, width, -1).permute(0, 3, 1, 2)

    def _compute(self, windows: Sequence[bytes], first: int, shape: Sequence[int]) -> None:
        end = first + len(windows)
        left = {first + index: zlib.crc32(window) % BATCH for index, window in enumerate(windows)}
        while left:
            rows = {place: row for row, place in left.items()}  # one for each place
            pixels = np.zeros((BATCH, *shape), dtype=np.uint8)
            for place, row in rows.items():
                pixels[place] = np.frombuffer(windows[row - first], dtype=np.uint8).reshape(shape)
                del left[row]
            outputs = self.compute(as_input(torch.from_numpy(pixels))).flatten(1)
            if end > len(self._table):
                more = torch.empty((max(end, 2 * len(self._table), 1024) - len(self._table), outputs.shape[1]))
                self._table = torch.cat([self._table.view(-1, outputs.shape[1]), more])
            self._table[[*rows.values()]] = outputs[[*rows]]
