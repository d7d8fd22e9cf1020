"""Many member networks as one, for a few states at a time: calling each member would cost more than its arithmetic."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from hypogoal.core.arrays import tensor
from hypogoal.hypotheses.ensemble import IMAGES_AT_ONCE, Ensemble
from hypogoal.hypotheses.networks import as_input, at_once, folded
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
        plain = [isinstance(ensemble.view, FullView) and ensemble.view.standard is None for ensemble in ensembles]
        self._one_view = all(plain)
        networks = [folded(network) for ensemble in ensembles for network in ensemble.eval().networks]
        self.count = len(networks)
        self.joined = _can_be_joined(networks[0])
        self._steps: list[tuple[nn.Module, list[Tensor]]] = []
        if self.joined:
            self._steps = [(layers[0], _stack(list(layers))) for layers in zip(*networks, strict=True)]

    def log_odds(self, observations: Observations) -> NDArray[np.float32]:
        """Every member's log-odds, float32 (N, G*K), ensemble by ensemble; as :meth:`Ensemble.log_odds`."""
        if not self.joined:
            return np.concatenate([ensemble.log_odds(observations) for ensemble in self.ensembles], axis=1)
        seen = self._see(observations)
        rows = [np.empty((0, self.count), dtype=np.float32)]
        with torch.inference_mode():
            chunk = at_once(IMAGES_AT_ONCE, seen.shape[1:])
            for start in range(0, len(seen), chunk):
                logits = self._logits(seen[start : start + chunk])
                rows.append((logits[..., 1] - logits[..., 0]).T.cpu().numpy())
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
        for layer, weights in self._steps:
            if isinstance(layer, nn.Conv2d):
                bias = weights[1] if len(weights) > 1 else None
                x = functional.conv2d(x, weights[0], bias, layer.stride, layer.padding, layer.dilation, groups)
                groups = self.count
            elif isinstance(layer, nn.Flatten):
                x = x.reshape(len(x), groups, -1).transpose(0, 1)
                if groups < self.count:  # all layers before were shared
                    x = x.repeat_interleave(self.count // groups, dim=0)
            elif isinstance(layer, nn.Linear):
                x = torch.baddbmm(weights[1], x, weights[0])
            else:
                x = layer(x)
        return x


def _can_be_joined(network: nn.Sequential) -> bool:
    flat = False
    for layer in network:
        if type(layer) is nn.Flatten:
            fits, flat = (layer.start_dim, layer.end_dim) == (1, -1) and not flat, True
        elif type(layer) is nn.Conv2d:
            fits = not flat and layer.groups == 1 and layer.padding_mode == "zeros"
        else:
            fits = (type(layer) is nn.Linear and flat) or type(layer) in WITHOUT_WEIGHTS
        if not fits:
            return False
    return flat


def _stack(layers: list[nn.Module]) -> list[Tensor]:
    """Join the weights of one layer of every member as :meth:`StackedMembers._logits` needs them."""
    first = layers[0]
    state = [layer.state_dict() for layer in layers]

    def joined(name: str) -> Tensor:
        return torch.cat([values[name] for values in state]).clone()

    if isinstance(first, nn.Conv2d):
        return [joined(name) for name in ("weight", "bias") if name in state[0]]
    if isinstance(first, nn.Linear):
        weight = torch.stack([values["weight"].T for values in state]).contiguous()
        return [weight, torch.stack([values["bias"] for values in state])[:, None]]
    return []
