"""Q-networks of the intra-option policies: a small network on cells, or on pictures."""

from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from hypogoal.core.arrays import Bytes, Ints, tensor
from hypogoal.core.errors import UserError
from hypogoal.domains.base import Engine
from hypogoal.hypotheses.networks import AUTO, as_input, build_network
from hypogoal.observations import Shape, Standard, standardised

CELL = 8  # pixels of a cell's side
WIDTH = 128  # the number of units of a dense layer
SMALLEST = 18  # the fewest pixels of a side that the convolutions of a PictureEmbedding need


class CellEmbedding(nn.Module):
    """A convolution whose kernel and stride are one cell (8 pixels), to ``CHANNELS`` features for each cell, then ReLU.

    If images are made of few distinct tiles, features are looked up: each tile is convolved once, and its features are
    gathered by tile code. Values and gradients do not differ from those of the convolution.
    """

    CHANNELS = 8

    def __init__(self, observation_shape: Shape):
        super().__init__()
        height, width, depth = observation_shape
        self.conv = nn.Conv2d(
            depth,
            self.CHANNELS,
            CELL,
            stride=CELL,
        )
        self.features = self.CHANNELS * (height // CELL) * (width // CELL)
        self._tiles: Bytes | None = None
        self._pixels = torch.empty(0)

    def forward(self, images: Tensor, tiles: Bytes | None = None) -> Tensor:
        """Return features, float32 (N, features), of images uint8 (N, H, W, C), cells row by row.

        If ``tiles``, uint8 (T, 8, 8, C), are given, ``images`` are the codes of cells instead, integers (N, cells).
        """
        if tiles is not None:
            return self._looked_up(images, tiles)
        features = torch.relu(self.conv(as_input(images)))
        return features.permute(0, 2, 3, 1).flatten(1)

    def _looked_up(self, codes: Tensor, tiles: Bytes) -> Tensor:
        if self._tiles is not tiles:
            self._tiles = tiles
            pixels = tensor(tiles.copy(), self.conv.weight.device)
            self._pixels = as_input(pixels).flatten(1)
        table = torch.relu(nn.functional.linear(self._pixels, self.conv.weight.flatten(1), self.conv.bias))
        # index_select gives what embedding gives, and its gradient takes a sixth of the time.
        return table.index_select(0, codes.flatten().long()).view(len(codes), -1)


class PictureEmbedding(nn.Module):
    """Two convolutions with ReLU, for pictures that are not made of cells.

    For (84, 84, 4), in one thread, an update with these kernels takes half the time of the usual kernels 8x8/4 and
    4x4/2. Where strides would not reach the last pixels, there is a margin of zeros, because that costs less than
    padding the pixels.
    """

    def __init__(self, observation_shape: Shape):
        super().__init__()
        height, width, depth = observation_shape
        self.first = nn.Conv2d(
            depth,
            16,
            6,
            6,
            padding=((-height % 6 + 1) // 2, (-width % 6 + 1) // 2),
        )
        self.second = nn.Conv2d(
            16,
            32,
            3,
            2,
            padding=(1 - -(-height // 6) % 2, 1 - -(-width // 6) % 2),
        )
        with torch.no_grad():
            blank = torch.zeros(1, depth, height, width)
            self.features = self.second(self.first(blank)).numel()

    def forward(self, images: Tensor) -> Tensor:
        """Return features, float32 (N, features), of images uint8 or float32 (N, H, W, C) in 0..255."""
        pixels = images.permute(0, 3, 1, 2).float()
        # The first weights are scaled instead of the pixels, because there are a thousand times fewer of them.
        layer = self.first
        first = nn.functional.conv2d(
            pixels,
            layer.weight / 255.0,
            layer.bias,
            layer.stride,
            layer.padding,
        )
        return torch.relu(self.second(torch.relu(first))).flatten(1)


class NumberEmbedding(nn.Module):
    """An embedding of observations that are no pictures: each number, standardised by a mean and a deviation."""

    mean: Tensor
    deviation: Tensor

    def __init__(self, standard: Standard):
        super().__init__()
        keep_standard(self, standard)
        self.features = self.mean.numel()

    def forward(self, observations: Tensor) -> Any:
        """Return features, float32 (N, features), of observations float32 (N, *shape)."""
        return standardised(observations, self.mean, self.deviation).flatten(1)


class OwnEmbedding(nn.Module):
    """A member network by name (see :mod:`hypogoal.hypotheses.networks`) up to its last hidden layer, or an encoder.

    The embedding stays in evaluation mode, so that what BatchNorm and Dropout make of a state depends on no other
    state.
    """

    mean: Tensor
    deviation: Tensor

    def __init__(
        self,
        name: str,
        observation_shape: Shape,
        standard: Standard | None,
    ):
        super().__init__()
        self.standardises = standard is not None
        if standard:
            keep_standard(self, standard)
        network = build_network(name, observation_shape, None)
        last = network[-1]
        assert isinstance(last, nn.Linear)
        self.encoder, self.features = network[:-1].eval(), last.in_features

    def forward(self, observations: Tensor) -> Any:
        """Return features, float32 (N, features).

        Observations are uint8 (N, H, W, C), or float32 (N, *shape) if there is a standard.
        """
        if self.standardises:
            observations = standardised(observations, self.mean, self.deviation)
        return self.encoder(as_input(observations))


def keep_standard(embedding: nn.Module, standard: Standard) -> None:
    """Keep the mean and deviation of numbers among an embedding's weights."""
    for name, values in zip(("mean", "deviation"), standard, strict=True):
        embedding.register_buffer(name, torch.from_numpy(values.copy()))


Embedding = CellEmbedding | PictureEmbedding | NumberEmbedding | OwnEmbedding


def embedding_for(observation_shape: Shape, standard: Standard | None, name: str) -> Embedding:
    """Return the embedding named ``name``. Raises ``UserError`` if it does not suit the observations.

    ``auto`` is an embedding of numbers if there is a ``standard``. Otherwise ``auto`` is an embedding of cells, or of
    convolutions if whole cells do not fill the image.
    """
    if name != AUTO:
        return OwnEmbedding(name, observation_shape, standard)
    if standard is not None:
        return NumberEmbedding(standard)
    height, width, _depth = observation_shape
    whole = height % CELL == 0 and width % CELL == 0
    if not whole and min(height, width) < SMALLEST:
        raise UserError(
            "images are too small for the light networks",
            f"{height} x {width}",
            f"Scale them up: {SMALLEST} x {SMALLEST} at least, or multiples of {CELL}; or bring an embedding.",
        )
    return CellEmbedding(observation_shape) if whole else PictureEmbedding(observation_shape)


class LightNetwork(nn.Module):
    """An embedding followed by two dense layers."""

    def __init__(self, cells: Embedding):
        super().__init__()
        self.cells = cells
        self.trunk = nn.Sequential(
            nn.Linear(cells.features, WIDTH),
            nn.ReLU(),
            nn.Linear(WIDTH, WIDTH),
            nn.ReLU(),
        )

    def forward(self, *seen: Any) -> Tensor:
        """Return what :meth:`head` gives for observations (N, *obs), or for tile codes and the tiles."""
        return self.head(self.trunk(self.cells(*seen)))

    def head(self, features: Tensor) -> Tensor:
        """Return the network's outputs, from features float32 (N, width)."""
        raise NotImplementedError


class LightQNetwork(LightNetwork):
    """A Q-network with one trunk, and one head for each member.

    Its outputs are the values of every member's policy, float32 (N, members, actions).
    """

    def __init__(
        self,
        observation_shape: Shape,
        members: int,
        actions: int,
        standard: Standard | None,
        embedding: str,
    ):
        super().__init__(embedding_for(observation_shape, standard, embedding))
        self.members, self.actions = members, actions
        self.heads = nn.Linear(WIDTH, members * actions)

    def head(self, features: Tensor) -> Tensor:
        """Return values, float32 (N, members, actions), from features float32 (N, width)."""
        return self.heads(features).view(-1, self.members, self.actions)


def apply_to_states(
    network: nn.Module,
    engine: Engine,
    ids: Ints,
    device: torch.device,
) -> Tensor:
    """Return the output of a network on ``device`` for states of an engine.

    The network reads tile codes if both the network and the engine know tiles, otherwise images.
    """
    tiles = engine.tiles
    if tiles is not None and isinstance(getattr(network, "cells", None), CellEmbedding):
        codes = tensor(engine.codes(ids).astype(int), device)
        return network(codes, tiles)
    return network(tensor(engine.images(ids), device))


def values_of(
    online: nn.Module,
    target: nn.Module,
    engine: Engine,
    states: Ints,
    next_states: Ints,
    device: torch.device,
) -> tuple[Tensor, Tensor, Tensor]:
    """Return three tensors of values, each float32 (n, O, A).

    The first tensor has the online network's values in ``states``, with gradients. The second and the third tensor have
    the online and the target network's values in ``next_states``.
    """
    both = np.concatenate([states, next_states])
    if isinstance(online.cells, PictureEmbedding):  # such states hardly ever occur twice
        now, later = tensor(engine.images(both), device).float().split(len(states))
        with torch.no_grad():
            next_online = online(later)
            next_target = target(later)
        return online(now), next_online, next_target
    # A batch has few distinct states, late in training 40 of 256. So the networks see each distinct state once.
    distinct, places = np.unique(both, return_inverse=True)
    before, after = tensor(places, device).split(len(states))
    values = apply_to_states(online, engine, distinct, device)
    others = apply_to_states(target, engine, distinct, device)
    # index_select is used because the gradient of indexing takes several times as long.
    now = values.index_select(0, before)
    next_online = values.detach().index_select(0, after)
    next_target = others.index_select(0, after)
    return now, next_online, next_target
