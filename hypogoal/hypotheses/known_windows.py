"""What convolutions make of windows of an image, kept: in a grid world few windows of a new state are new.

Each number behind a stack of convolutions and poolings depends on one square window of pixels. A state that differs
from known ones in a cell or two has one or two windows that no state had; of the others the numbers are looked up.

Libraries may round otherwise in batches of another size and at another place of a batch. So that a window has the same
numbers whenever it is computed, and after a break, all batches are of one size and its pixels say its place in them.
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

MOST_WINDOWS = 16_384  # windows kept; with 960 numbers each, 63 MB
BATCH = 4  # windows computed at once, always so many


def split_of(network: nn.Sequential) -> tuple[int, int, int] | None:
    """How many layers of a network there are up to its last convolution, and that one's windows: side, stride (pixels).

    None where there is no convolution, or a layer is of a kind that we do not know.
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
    """The numbers of windows, by their pixels.

    ``compute`` maps float32 (BATCH, C, side, side) in 0..1 to float32 (BATCH, F, 1, 1); ``side`` and ``stride`` are in
    pixels. Where there are more than ``most`` windows it begins anew.
    """

    def __init__(self, compute: Callable[[Tensor], Tensor], side: int, stride: int, most: int = MOST_WINDOWS):
        self.compute, self.side, self.stride, self.most = compute, side, stride, most
        self._rows: dict[bytes, int] = {}
        self._table = torch.empty(0)

    def of(self, images: NDArray[np.uint8]) -> Tensor:
        """Numbers float32 (N, F, h, w) of images uint8 (N, H, W, C)."""
        views = np.lib.stride_tricks.sliding_window_view(images, (self.side, self.side), axis=(1, 2))
        views = views[:, :: self.stride, :: self.stride].transpose(0, 1, 2, 4, 5, 3)
        count, height, width, *shape = views.shape
        pixels = np.ascontiguousarray(views).reshape(count * height * width, -1)
        whole: list[bytes] = pixels.view(f"V{pixels.shape[1]}").ravel().tolist()
        if len(self._rows) + len(whole) > self.most:  # so many may be new
            new = len({*whole}.difference(self._rows))
            if len(self._rows) + new > self.most:
                self._rows.clear()
        begun = len(self._rows)
        rows = [self._rows.setdefault(window, len(self._rows)) for window in whole]
        if len(self._rows) > begun:
            self._learn([*self._rows][begun:], begun, shape)
        found = self._table.index_select(0, torch.tensor(rows))
        return found.view(count, height, width, -1).permute(0, 3, 1, 2)

    def _learn(self, windows: Sequence[bytes], first: int, shape: Sequence[int]) -> None:
        end = first + len(windows)
        left = {first + index: zlib.crc32(window) % BATCH for index, window in enumerate(windows)}
        while left:
            rows = {place: row for row, place in left.items()}  # one for each place
            pixels = np.zeros((BATCH, *shape), dtype=np.uint8)
            for place, row in rows.items():
                pixels[place] = np.frombuffer(windows[row - first], dtype=np.uint8).reshape(shape)
                del left[row]
            numbers = self.compute(as_input(torch.from_numpy(pixels))).flatten(1)
            if end > len(self._table):
                more = torch.empty((max(end, 2 * len(self._table), 1024) - len(self._table), numbers.shape[1]))
                self._table = torch.cat([self._table.view(-1, numbers.shape[1]), more])
            self._table[[*rows.values()]] = numbers[[*rows]]
