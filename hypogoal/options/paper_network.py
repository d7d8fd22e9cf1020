"""The paper's Q-network of one member (Spec D2), and a fast way to pass a batch of images through it.

Images of a grid world differ in few places. Convolutions look at each distinct patch once
(:mod:`hypogoal.hypotheses.patches`), and what the GRU's gates get from an image is a sum over its places: the product
of a patch and its place's weights, of which a batch has few distinct pairs.
"""

from __future__ import annotations

from math import prod
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from hypogoal.core.arrays import tensor
from hypogoal.hypotheses import patches

SAVED = "gru.weight_ih_l0"  # the state dict's name for ``rows``, which are there as nn.GRU has them


class PaperQNetwork(nn.Module):
    """Two of (conv, BatchNorm, ReLU, MaxPool), a GRU, two dense layers.

    The paper gives no sizes. Channels 16 and 32 with kernel 3 and GRU 512 are those of the authors' public code
    (AnitadeMelloKoch/portable_options, ``cnn_q_function.py``). ReLU stands after MaxPool: the same function, cheaper.
    With ``remembers=False`` each image is a sequence of its own, as the authors run it (DEV-16).
    """

    HIDDEN = 512

    def __init__(self, observation_shape: tuple[int, ...], actions: int, remembers: bool = True):
        super().__init__()
        self.remembers = remembers
        height, width, depth = observation_shape
        self.features = nn.Sequential(
            nn.Conv2d(depth, 16, 3), nn.BatchNorm2d(16), nn.MaxPool2d(2), nn.ReLU(),
            nn.Conv2d(16, 32, 3), nn.BatchNorm2d(32), nn.MaxPool2d(2), nn.ReLU(),
        )  # fmt: skip
        with torch.no_grad():
            channels, *sides = self.features.eval()(torch.zeros(1, depth, height, width)).shape[1:]
        self.features.train()
        gru = nn.GRU(channels * prod(sides), self.HIDDEN)
        # What the gates multiply an image with, by row of places: h of (w, channels, 3 * 512). In nn.GRU's order each
        # update would have to rearrange it; gradients of more than 32 MB get new memory from the system every time.
        # Both take longer than the arithmetic.
        self.gru = nn.ParameterDict(gru.named_parameters())
        self.rows = nn.ParameterList(_by_row(self.gru.pop("weight_ih_l0").detach(), channels, *sides))
        self.values = nn.Sequential(nn.Linear(self.HIDDEN, 128), nn.ReLU(), nn.Linear(128, actions))
        self.register_state_dict_post_hook(_as_gru)
        self.register_load_state_dict_pre_hook(_as_rows)

    def embed(self, images: Tensor | Patches, times: Tensor | None = None) -> Tensor:
        """uint8 (N, H, W, C), or their patches -> float32 (N, 3 * 512): what the GRU's gates get from an image alone.

        Nearly all of the arithmetic is in here, so that an image of several executions is computed once. In training
        mode BatchNorm counts image n ``times[n]`` times, once where None.
        """
        gates: Tensor = self.gru["bias_ih_l0"]
        if isinstance(images, Patches):
            contents = patches.forward(self.features, images.batch).index_select(0, images.contents)
            weights = (weight for row in self.rows for weight in row.unbind(0))
            products = [patch @ weight for patch, weight in zip(contents.split(images.counts), weights, strict=True)]
            return torch.addmm(gates, images.pairs, torch.cat(products))
        seen = images.permute(0, 3, 1, 2).float() / 255.0
        for layer in self.features:
            if isinstance(layer, nn.BatchNorm2d) and layer.training and times is not None:
                seen = _counted(layer, seen, times)
            else:
                seen = layer(seen)
        for row, weight in zip(seen.permute(2, 0, 3, 1).flatten(2), self.rows, strict=True):
            gates = torch.addmm(gates, row, weight.flatten(0, 1))
        return gates

    def forward(self, embedded: Tensor, hidden: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Unroll the GRU over an option's own steps, float32 (N, T, 3 * 512), from :meth:`embed`.

        Returns values float32 (N, T, actions) and the last state (1, N, 512), ``hidden`` of the next call.
        The equations are those of ``nn.GRU``, which would embed an image anew for every execution it is in.
        """
        new = embedded.new_zeros(len(embedded), self.HIDDEN)
        state = new if hidden is None else hidden[0]
        states = []
        for step in embedded.unbind(1):
            state = self._next(step, state if self.remembers else new)
            states.append(state)
        return self.values(torch.stack(states, dim=1)), state[None]

    def _next(self, step: Tensor, state: Tensor) -> Tensor:
        """The GRU's state (N, 512) after the one before."""
        recurrent = nn.functional.linear(state, self.gru["weight_hh_l0"], self.gru["bias_hh_l0"])
        both = (step + recurrent)[:, : 2 * self.HIDDEN].sigmoid()
        reset, update = both.chunk(2, dim=1)
        new = (step[:, 2 * self.HIDDEN :] + reset * recurrent[:, 2 * self.HIDDEN :]).tanh()
        return torch.lerp(new, state, update)


class Patches:
    """Images uint8 (N, H, W, C) as distinct patches for :meth:`PaperQNetwork.embed`; image n counts ``times[n]`` times.

    Attributes:
        batch: the patches.
        contents: int64 (U,), of each distinct pair of a place and a patch the patch, in the order of places.
        counts: how many of the pairs are at each place.
        pairs: float32 (N, U), 1 where an image has a pair, else 0.
    """

    def __init__(self, tables: patches.Tables, times: NDArray[np.int64]):
        self.batch = patches.take(tables, np.arange(len(times)), times=times)
        last = self.batch.last.numpy()
        (images, places), distinct = last.shape, int(last.max()) + 1
        pairs, ranks = np.unique(last + np.arange(places) * distinct, return_inverse=True)
        self.contents = torch.from_numpy(pairs % distinct)
        self.counts: list[int] = np.bincount(pairs // distinct, minlength=places).tolist()
        self.pairs = torch.zeros(images, len(pairs)).scatter_(1, torch.from_numpy(ranks.reshape(images, places)), 1.0)


def looked_at(
    images: NDArray[np.uint8], times: NDArray[np.int64], network: PaperQNetwork, device: torch.device
) -> tuple[Any, ...]:
    """Arguments of :meth:`PaperQNetwork.embed` for images and how often each counts: patches where that is faster."""
    tables = patches.make_tables([images], network.features) if device.type == "cpu" else None
    return (tensor(images, device), tensor(times, device)) if tables is None else (Patches(tables, times),)


def _counted(layer: nn.BatchNorm2d, seen: Tensor, times: Tensor) -> Tensor:
    """BatchNorm in training mode of (N, C, H, W), image n ``times[n]`` times."""
    rows = seen.permute(0, 2, 3, 1).flatten(1, 2)
    shares = (times / times.sum()).to(rows.dtype)[None]

    def average(values: Tensor) -> Tensor:
        return shares @ values.view(rows.shape).mean(1)  # more exact than of all places at once

    normed = patches.normed(layer, rows.flatten(0, 1), average, int(times.sum()) * rows.shape[1])
    return normed.view(len(rows), *seen.shape[2:], -1).permute(0, 3, 1, 2)


def _by_row(weight: Tensor, channels: int, height: int, width: int) -> list[Tensor]:
    """Of nn.GRU's weights (3 * 512, channels * h * w) those of each row of places, h of (w, channels, 3 * 512)."""
    by_row = weight.view(len(weight), channels, height, width).permute(2, 3, 1, 0)
    return [row.contiguous() for row in by_row]


def _as_gru(network: nn.Module, state: dict[str, Any], prefix: str, _: Any) -> None:
    """Save rows of weights as nn.GRU has them."""
    assert isinstance(network, PaperQNetwork)
    rows = [state.pop(f"{prefix}rows.{row}") for row in range(len(network.rows))]
    state[prefix + SAVED] = torch.stack(rows).permute(3, 2, 0, 1).flatten(1)


def _as_rows(network: nn.Module, state: dict[str, Any], prefix: str, *_: Any) -> None:
    """The other way round; what does not fit is left for the loading to refuse."""
    assert isinstance(network, PaperQNetwork)
    width, channels, gates = network.rows[0].shape
    weight, height = state.get(prefix + SAVED), len(network.rows)
    if weight is not None and weight.shape == (gates, channels * height * width):
        rows = _by_row(state.pop(prefix + SAVED), channels, height, width)
        state.update({f"{prefix}rows.{row}": values for row, values in enumerate(rows)})
