"""An engine as stable-baselines3 sees it: a vectorised environment, and the networks that read its images."""

import itertools
import math
from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.vec_env import VecEnv
from torch import Tensor, nn

from hypogoal.core.arrays import Array, Bools, Bytes, Floats, Ints
from hypogoal.core.checkpoints import Resumable
from hypogoal.domains.base import Engine
from hypogoal.domains.episodes import EpisodeRecorder
from hypogoal.observations import PICTURE, Observations, standardised

FEATURES = 128
CELL = 8  # pixels, the kernel size and the stride of the first convolution


class EngineEnv(VecEnv, Resumable):
    """All environments of an engine as a vectorised environment, with the engine's primitive actions.

    Observations are the engine's images, uint8 (C, H, W), or its numbers, float32, standardised by the engine's
    ``standard`` if there is one. If images are made of tiles, observations are the tile codes of their cells, uint8
    (cells,), which say the same in 1/192 of the bytes (see :class:`CellNetwork`). An episode that is cut at its step
    limit is marked as truncated, because its last state is not terminal.

    Attributes:
        episodes: records the episodes that ended.
    """

    CHANGING = ("engine", "episodes")

    def __init__(self, engine: Engine):
        self.engine = engine
        self.tiles = engine.tiles
        first = self._observe(engine.ids[:1])
        low, high = -math.inf, math.inf
        if first.dtype == PICTURE:
            low, high = 0, 255
        space = spaces.Box(
            low,
            high,
            first.shape[1:],
            first.dtype.type,
        )
        actions = spaces.Discrete(engine.n_actions)
        super().__init__(
            engine.count,
            space,
            actions,
        )
        self.episodes = EpisodeRecorder(engine.count)
        self._actions = np.zeros(engine.count, int)

    def _observe(self, ids: Ints) -> Observations:
        if self.tiles is not None:
            return self.engine.codes(ids)
        images = self.engine.images(ids)
        if images.dtype == PICTURE:
            return images.transpose(0, 3, 1, 2)
        if self.engine.standard is None:
            return images
        return standardised(images, *self.engine.standard)

    def reset(self) -> Observations:
        """Begin an episode in every environment. Return the observations."""
        return self._observe(self.engine.reset())

    def step_async(self, actions: Array) -> None:
        """Keep the actions (count,) for the next step."""
        self._actions = np.asarray(actions, int)

    def step_wait(self) -> tuple[Observations, Floats, Bools, list[dict[str, Any]]]:
        """Step every environment. Where an episode ended, the observation shows the start of the next episode."""
        step = self.engine.step(self._actions)
        self.episodes.see(step)
        done = step.terminated | step.truncated
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for index in np.flatnonzero(done):
            [last] = self._observe(step.next_ids[index : index + 1])
            infos[index]["terminal_observation"] = last
            infos[index]["TimeLimit.truncated"] = bool(not step.terminated[index])
        observations = self._observe(self.engine.ids)
        return observations, step.rewards, done, infos

    def close(self) -> None:
        """Do nothing, because there is nothing to close."""

    def get_attr(self, *_: Any, **__: Any) -> list[Any]:
        """Return None for each environment. VecEnv asks for ``render_mode``, but an engine is never shown."""
        return [None] * self.num_envs

    def set_attr(self, *_: Any, **__: Any) -> None:
        """Raise ``NotImplementedError``, because an engine's attributes are fixed."""
        raise NotImplementedError

    def env_method(self, *_: Any, **__: Any) -> list[Any]:
        """Raise ``NotImplementedError``, because an engine has no methods of a single environment."""
        raise NotImplementedError

    def env_is_wrapped(self, *_: Any, **__: Any) -> list[bool]:
        """Return False for each environment, because an engine has no Gymnasium wrappers."""
        return [False] * self.num_envs


class BlockConvolution(nn.Module):
    """A convolution whose stride is its kernel size, computed as one matrix product.

    The layer is ``nn.Conv2d(channels, out, size, stride=size)``, but maps (N, H, W, channels) to
    (N, H // size, W // size, out). The pixels left over at the lower and the right edge are not used. On images as
    small as a grid world's, a matrix product takes half the time of a convolution routine (one CPU thread).
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
    """A network of convolutions over blocks that do not overlap, and of dense layers.

    Observations are float images (N, C, H, W) in 0..1, or with ``tiles`` the tile codes of cells (N, cells). With
    ``tiles`` the first convolution is computed once per tile and looked up. That is the same function of the image, up
    to rounding, but several times faster.

    Args:
        channels: the output channels of each convolution. The blocks of the first convolution are cells of 8 x 8
            pixels, and the blocks of the others are 2 x 2.
        dense: the number of dense layers, which follow the convolutions.
        tiles: uint8 (codes, 8, 8, C), the tiles of which the engine's images are made.
        rows: the number of rows of cells in an image, if there are ``tiles``.
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
        """Return the output of the first convolution after ReLU, (N, rows, columns, channels)."""
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


# ``three-conv`` is the paper's: three convolutions with ReLU between, and a dense layer that actor and critic share.
# The paper gives no sizes, and ours are small. ``cells`` is the tuned network.
NETWORKS = {
    "three-conv": partial(CellNetwork, channels=(16, 32, 64), dense=1),
    "cells": partial(CellNetwork, channels=(8,), dense=2),
}
