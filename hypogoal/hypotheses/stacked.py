"""Many member networks as one network, for predicting a few states at a time.

With few states, calling each member separately would cost more than the arithmetic of the members.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from hypogoal.core.arrays import Bytes, Floats, tensor
from hypogoal.hypotheses.ensemble import IMAGES_AT_ONCE, Ensemble, predicting, together
from hypogoal.hypotheses.networks import as_input, at_once, folded
from hypogoal.observations import Observations

MANY = 256  # from this number of states on, an ensemble is faster alone, because it computes distinct patches once
WITHOUT_WEIGHTS = (nn.ReLU, nn.MaxPool2d, nn.AvgPool2d, nn.Dropout)  # layers that can act on all members at once


class StackedMembers:
    """All members of several ensembles, joined into one network for prediction only.

    The G ensembles have K members each, one kind of network, one observation shape, and one device. The filters of the
    first convolution are concatenated, later convolutions are grouped, and dense layers are batched products. Up to
    rounding, the result is each ensemble's ``log_odds`` (a test asserts it).

    Networks with other layers, and ensembles that do not see whole pictures, are not ``joined``: they predict as
    ensembles do. For many states, all ensembles predict as ensembles do.
    """

    def __init__(self, ensembles: Sequence[Ensemble]):
        self.ensembles = tuple(ensembles)
        self.every = together(ensembles)
        self.device = ensembles[0].thresholds.device
        self.networks: list[nn.Sequential] = []
        for ensemble in ensembles:
            self.networks += map(folded, ensemble.eval().networks)
        self.count = len(self.networks)
        self.joined = self.every is not None and _can_be_joined(self.networks[0])
        self._layers = []
        if self.joined:
            self._layers = [(layers[0], _stack(layers)) for layers in zip(*self.networks, strict=True)]

    def log_odds(self, observations: Observations) -> Floats:
        """Return every member's log-odds, float32 (N, G*K), ensemble by ensemble, as :meth:`Ensemble.log_odds` does."""
        if self.every is None:
            each = [ensemble.log_odds(observations) for ensemble in self.ensembles]
            return np.concatenate(each, axis=1)
        if not self.joined or len(observations) >= MANY:
            return self.every.log_odds(observations)
        seen = self.every.see(observations)
        rows = []
        size = at_once(IMAGES_AT_ONCE, seen.shape[1:])
        with predicting(self.device):
            for start in range(0, len(seen), size):
                logits = self._logits(seen[start : start + size])
                gaps = logits[..., 1] - logits[..., 0]
                rows.append(gaps.T.cpu().numpy())
        return np.concatenate(rows)

    def _logits(self, pictures: Bytes) -> Tensor:
        """Return logits (members, N, 2) of pictures (N, H, W, C)."""
        x = as_input(tensor(pictures, self.device))
        groups = 1  # members share the pictures, but have channels of their own behind the first convolution
        for layer, weights in self._layers:
            if isinstance(layer, nn.Conv2d):
                bias = weights.get("bias")
                x = functional.conv2d(
                    x,
                    weights["weight"],
                    bias,
                    layer.stride,
                    layer.padding,
                    layer.dilation,
                    groups,
                )
                groups = self.count
            elif isinstance(layer, nn.Flatten):
                x = x.reshape(len(x), groups, -1).transpose(0, 1)
                x = x.expand(self.count, -1, -1)  # without a convolution, members share the pictures until here
            elif isinstance(layer, nn.Linear):
                x = torch.baddbmm(weights["bias"], x, weights["weight"])
            else:
                x = layer(x)
        return x


def _can_be_joined(network: nn.Sequential) -> bool:
    """Say whether a network can be joined with others.

    Such a network has convolutions, one Flatten and dense layers, with only layers without weights between them.
    """
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
    """Return the weights of one layer of all members, joined as :meth:`StackedMembers._logits` needs them."""
    weights = {}
    for name in layers[0].state_dict():
        each = [layer.state_dict()[name] for layer in layers]
        if isinstance(layers[0], nn.Conv2d):
            weights[name] = torch.cat(each)
            if name == "weight":  # in the memory order of pictures, because otherwise each call would copy the weights
                weights[name] = weights[name].contiguous(memory_format=torch.channels_last)
        elif name == "weight":
            weights[name] = torch.stack([weight.T for weight in each]).contiguous()
        else:
            weights[name] = torch.stack(each)[:, None]
    return weights
