"""Many member networks as one, for a few states at a time: calling each member would cost more than its arithmetic."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from hypogoal.core.arrays import Floats, tensor
from hypogoal.hypotheses.ensemble import IMAGES_AT_ONCE, Ensemble, predicting
from hypogoal.hypotheses.networks import (
    as_input,
    at_once,
    folded,
)
from hypogoal.hypotheses.views import FullView
from hypogoal.observations import Observations

WITHOUT_WEIGHTS = (nn.ReLU, nn.MaxPool2d, nn.AvgPool2d, nn.Dropout)  # act on all members at once


class StackedMembers:
    """All members of several ensembles with the same network, for prediction only.

    The first convolution's filters are concatenated, later ones grouped; dense layers are batched products. Up to
    rounding, the result is each ensemble's ``log_odds`` (a test asserts it). Networks with other layers are not
    ``joined``: each ensemble predicts by itself.

    The G ensembles have K members each, one network and observation shape, views of one shape, and one device.
    """

    def __init__(self, ensembles: Sequence[Ensemble]):
        self.ensembles = tuple(ensembles)
        self.device = ensembles[0].thresholds.device
        self._one_view = all(type(each.view) is FullView and each.view.standard is None for each in ensembles)
        networks: list[nn.Sequential] = []
        for ensemble in ensembles:
            networks += map(folded, ensemble.eval().networks)
        self.count = len(networks)
        self.joined = _can_be_joined(networks[0])
        self._layers: list[tuple[nn.Module, dict[str, Tensor]]] = []
        if self.joined:
            for layers in zip(*networks, strict=True):
                self._layers.append((layers[0], _stack(layers)))

    def log_odds(self, observations: Observations) -> Floats:
        """Every member's log-odds, float32 (N, G*K), ensemble by ensemble; as :meth:`Ensemble.log_odds`."""
        if not self.joined:
            return np.concatenate(
                [ensemble.log_odds(observations) for ensemble in self.ensembles],
                axis=1,
            )
        seen = self._see(observations)
        rows = [np.empty((0, self.count), dtype=np.float32)]
        size = at_once(IMAGES_AT_ONCE, seen.shape[1:])
        with predicting(self.device):
            for start in range(0, len(seen), size):
                logits = self._logits(seen[start : start + size])
                gaps = logits[..., 1] - logits[..., 0]
                rows.append(gaps.T.cpu().numpy())
        return np.concatenate(rows)

    def _see(self, observations: Observations) -> Any:
        """The ensembles' view, uint8 (N, h, w, C), or (N, h, w, G*C) if their views differ.

        For non-image observations, float32 (N, G*n, ...).
        """
        if self._one_view:
            return self.ensembles[0].see(observations)
        seen = [ensemble.see(observations) for ensemble in self.ensembles]
        return np.concatenate(seen, axis=-1 if observations.ndim == 4 else 1)

    def _logits(self, seen: Any) -> Tensor:
        """What :meth:`_see` returns -> logits (members, N, 2)."""
        x = as_input(tensor(seen, self.device))
        groups = 1 if self._one_view else len(self.ensembles)
        for layer, weights in self._layers:
            if isinstance(layer, nn.Conv2d):
                bias = weights.get("bias")
                x = functional.conv2d(x, weights["weight"], bias, layer.stride, layer.padding, layer.dilation, groups)
                groups = self.count
            elif isinstance(layer, nn.Flatten):
                x = x.reshape(len(x), groups, -1).transpose(0, 1)
                x = x.repeat_interleave(
                    self.count // groups,
                    dim=0,
                )  # where all layers before were shared
            elif isinstance(layer, nn.Linear):
                x = torch.baddbmm(weights["bias"], x, weights["weight"])
            else:
                x = layer(x)
        return x


def _can_be_joined(network: nn.Sequential) -> bool:
    """Whether it is convolutions, one Flatten and dense layers, with what has no weights between them."""
    flat = False
    layer: Any
    for layer in network:
        kind = type(layer)
        if kind is nn.Flatten and not flat:
            flat = (layer.start_dim, layer.end_dim) == (1, -1)
            fits = flat
        elif kind is nn.Conv2d:
            fits = not flat and layer.groups == 1 and layer.padding_mode == "zeros"
        elif kind is nn.Linear:
            fits = flat and layer.bias is not None
        else:
            fits = kind in WITHOUT_WEIGHTS
        if not fits:
            return False
    return flat


def _stack(layers: Sequence[nn.Module]) -> dict[str, Tensor]:
    """The weights of one layer of every member, joined as :meth:`StackedMembers._logits` needs them."""
    weights = {}
    for name in layers[0].state_dict():
        each = [layer.state_dict()[name] for layer in layers]
        if isinstance(layers[0], nn.Conv2d):
            weights[name] = torch.cat(each)
        elif name == "weight":
            weights[name] = torch.stack([weight.T for weight in each]).contiguous()
        else:
            weights[name] = torch.stack(each)[:, None]
    return weights
