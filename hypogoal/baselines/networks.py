"""Feature networks of the baselines: RGB image in, vector out."""

import itertools
from collections.abc import Sequence
from functools import partial

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import Tensor, nn

from hypogoal.core.arrays import Bytes

FEATURES = 128
CELL = 8  # pixels; the first convolution's kernel and stride


class BlockConvolution(nn.Module):
    """A convolution whose stride is its kernel size, as one matrix product: ``nn.Conv2d(c, out, size, stride=size)``.

    On images as small as these that takes half the time of a convolution routine (a CPU thread). (N, H, W, channels)
    to (N, H / size, W / size, out); what is left over at the lower and the right edge is not looked at.
    """

    def __init__(self, channels: int, out: int, size: int):
        super().__init__()
        self.size = size
        self.linear = nn.Linear(size * size * channels, out)

    def forward(self, inputs: Tensor) -> Tensor:
        size = self.size
        count, height, width, channels = inputs.shape
        rows, columns = height // size, width // size
        inputs = inputs[:, : rows * size, : columns * size]
        blocks = inputs.reshape(count, rows, size, columns, size, channels)
        return self.linear(blocks.transpose(2, 3).reshape(count, rows, columns, -1))


class CellNetwork(BaseFeaturesExtractor):
    """Convolutions that each see a block at a time, the first one an 8 x 8 cell, then dense layers.

    ``channels`` are of the convolutions, those after the first with kernel 2; ``dense`` layers follow. Observations are
    float images (N, C, H, W) in 0..1 or, where the engine's images are made of ``tiles``, uint8 (codes, 8, 8, C), so
    many ``rows`` of them, the cells' codes (N, cells). Then the first convolution is computed once per tile and looked
    up: the same function of the image, up to rounding, several times faster.
    """

    tiles: Tensor | None

    def __init__(
        self,
        space: spaces.Box,
        channels: Sequence[int],
        dense: int,
        tiles: Bytes | None = None,
        rows: int = 0,
    ):
        super().__init__(space, FEATURES)
        self.rows = rows
        self.first = BlockConvolution(
            space.shape[0] if tiles is None else tiles.shape[3],
            channels[0],
            CELL,
        )
        pixels = None if tiles is None else torch.from_numpy(tiles.astype(np.float32) / 255.0)
        self.register_buffer("tiles", pixels, persistent=False)
        further = []
        for before, after in itertools.pairwise(channels):
            further += [BlockConvolution(before, after, 2), nn.ReLU()]
        self.further = nn.Sequential(*further, nn.Flatten())
        with torch.no_grad():
            width = self.further(self._cells(torch.zeros(1, *space.shape))).shape[1]
        layers = []
        for before, after in itertools.pairwise([width, *[FEATURES] * dense]):
            layers += [nn.Linear(before, after), nn.ReLU()]
        self.dense = nn.Sequential(*layers)

    def _cells(self, observations: Tensor) -> Tensor:
        """The first convolution and ReLU: (N, rows, columns, channels)."""
        if self.tiles is None:
            return torch.relu(self.first(observations.permute(0, 2, 3, 1)))
        table = torch.relu(self.first(self.tiles)).flatten(start_dim=1)
        seen = table.index_select(0, observations.flatten().long())
        return seen.view(
            len(observations),
            self.rows,
            -1,
            table.shape[1],
        )

    def forward(self, observations: Tensor) -> Tensor:
        return self.dense(self.further(self._cells(observations)))


# The paper's three convolutions with ReLU between and a dense layer shared by actor and critic, for which it gives no
# sizes (these are small), and the tuned one: one convolution over cells, two dense layers.
NETWORKS = {
    "three-conv": partial(CellNetwork, channels=(16, 32, 64), dense=1),
    "cells": partial(CellNetwork, channels=(8,), dense=2),
}
