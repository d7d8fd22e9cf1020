"""Feature networks of the baselines: RGB image in, vector out."""

from __future__ import annotations

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import Tensor, nn

FEATURES = 128
CELL = 8  # pixels; the first convolution's kernel and stride


class CellNetwork(BaseFeaturesExtractor):
    """A convolution that sees one 8 x 8 cell at a time, further layers, then dense layers.

    Where the engine's images are made of tiles, observations are the cells' tile codes (N, cells) and the first
    convolution is computed once per tile and looked up: the same function of the image, up to rounding, several times
    faster. Otherwise observations are float images (N, C, H, W) in 0..1.

    Args:
        space: the observation space.
        channels: of the first convolution.
        further: layers from (N, channels, rows, columns) to (N, width).
        dense: how many dense layers follow.
        tiles: uint8 (codes, 8, 8, C), what each code looks like; None where observations are images.
        rows: of cells in an image, where ``tiles`` is given.
    """

    tiles: Tensor | None

    def __init__(
        self,
        space: spaces.Box,
        channels: int,
        further: nn.Sequential,
        dense: int,
        tiles: NDArray[np.uint8] | None = None,
        rows: int = 0,
    ):
        super().__init__(space, FEATURES)
        self.rows = rows
        self.first = nn.Conv2d(space.shape[0] if tiles is None else tiles.shape[3], channels, CELL, stride=CELL)
        self.further = further
        flat = None
        if tiles is not None:
            flat = torch.from_numpy(tiles.astype(np.float32) / 255.0).permute(0, 3, 1, 2).flatten(start_dim=1)
        self.register_buffer("tiles", flat, persistent=False)
        with torch.no_grad():
            width = self.further(torch.relu(self._cells(torch.zeros(1, *space.shape)))).shape[1]
        layers: list[nn.Module] = [nn.Linear(width, FEATURES), nn.ReLU()]
        for _ in range(dense - 1):
            layers += [nn.Linear(FEATURES, FEATURES), nn.ReLU()]
        self.dense = nn.Sequential(*layers)

    def _cells(self, observations: Tensor) -> Tensor:
        """The first convolution: (N, channels, rows, columns)."""
        if self.tiles is None:
            return self.first(observations)
        table = nn.functional.linear(self.tiles, self.first.weight.flatten(start_dim=1), self.first.bias)
        seen = table.index_select(0, observations.flatten().long())
        return seen.view(len(observations), self.rows, -1, table.shape[1]).permute(0, 3, 1, 2)

    def forward(self, observations: Tensor) -> Tensor:
        return self.dense(self.further(torch.relu(self._cells(observations))))


class ThreeConv(CellNetwork):
    """The paper's network: three convolutions with ReLU between, and a dense layer shared by actor and critic.

    The paper gives no sizes; these are small.
    """

    def __init__(self, space: spaces.Box, tiles: NDArray[np.uint8] | None = None, rows: int = 0):
        further = nn.Sequential(
            nn.Conv2d(16, 32, 2, stride=2), nn.ReLU(), nn.Conv2d(32, 32, 2), nn.ReLU(), nn.Flatten()
        )
        super().__init__(space, 16, further, 1, tiles, rows)


class Cells(CellNetwork):
    """The tuned network: one convolution over cells, two dense layers."""

    def __init__(self, space: spaces.Box, tiles: NDArray[np.uint8] | None = None, rows: int = 0):
        super().__init__(space, 8, nn.Sequential(nn.Flatten()), 2, tiles, rows)


NETWORKS: dict[str, type[ThreeConv] | type[Cells]] = {"three-conv": ThreeConv, "cells": Cells}
