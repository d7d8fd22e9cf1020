"""What a member looks at in a state: DeepLift attributions, and a check that they are complete (Figures 2, 9).

Members with layers for which DeepLift has no valid rules are explained by integrated gradients (Sundararajan et al.
2017): means over ``STEPS`` states between the baseline and the state, complete up to the error of so few steps.

Attributed are the log-odds, the difference of a member's two logits. Their sign is the prediction at a threshold of
0.5, so positive attributions speak for a positive prediction. A state's attributions, summed over pixels and frames,
must equal its log-odds minus the baseline's; the error is reported.
"""

from __future__ import annotations

import copy
import warnings
from dataclasses import dataclass
from math import prod
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from hypogoal.core.arrays import Array, Doubles
from hypogoal.hypotheses.networks import at_once, inputs_of
from hypogoal.observations import (
    NUMBERS,
    PICTURE,
    DType,
    Observations,
    fields_of,
)

DEEP_LIFT, INTEGRATED = "DeepLift", "integrated gradients"
STEPS, AT_ONCE = 32, 64  # gradients for a state's integral; images whose gradients are computed together
INSIDE = 64  # DeepLift's memory relative to a plain pass: both states, in double, with copies of pooled pixels
RULED = (nn.Conv2d, nn.Linear, nn.BatchNorm2d, nn.ReLU, nn.AvgPool2d, nn.AdaptiveAvgPool2d, nn.Flatten, nn.Dropout)

if TYPE_CHECKING:
    from hypogoal.hypotheses.ensemble import Ensemble


@dataclass(frozen=True)
class Attributions:
    """Attributions of every member on n states."""

    values: Doubles  # (n, K, H, W, C), or (n, K, *shape), of mixed ones (n, K, D), in log-odds
    log_odds: Doubles  # (n, K)
    baseline_log_odds: Doubles  # (K,)
    method: str

    def completeness_error(self) -> Doubles:
        """|sum of the attributions - (log-odds of the state - log-odds of the baseline)|, (n, K)."""
        sums = self.values.reshape(*self.log_odds.shape, -1).sum(-1)
        return np.abs(sums - (self.log_odds - self.baseline_log_odds))


def mean_state(observations: Observations) -> Observations:
    """The baseline: the mean of viewed observations, (N, ...) -> (...); of pictures rounded, uint8 (H, W, C).

    Against a black image, which is a state of no domain, the things that all states share (walls, the floor) would get
    most of the attribution, and black things (a pit, an open door) none. Against the mean state, only differences from
    the usual get any.
    """
    dtype = observations.dtype
    if dtype.names:
        states = np.zeros((), dtype)
        for key in dtype.names:
            states[key] = mean_state(observations[key])
        return states
    mean = observations.mean(axis=0, dtype=float)
    if dtype == PICTURE:
        mean = mean.round()
    return mean.astype(dtype)


def by_key(values: NDArray[np.floating], dtype: DType) -> Array:
    """Attributions (..., D) of mixed observations as float32 with a field for each key."""
    fields = fields_of((), dtype)
    states = values.shape[:-1]
    parts = np.empty(states, [(key, NUMBERS, shape) for key, (_, shape) in fields.items()])
    start = 0
    for key, (_, shape) in fields.items():
        end = start + prod(shape)
        of_key, start = values[..., start:end], end
        if len(shape) == 3:  # channels are first in what networks take
            *sides, channels = shape
            of_key = np.moveaxis(of_key.reshape(*states, channels, *sides), -3, -1)
        parts[key] = of_key.reshape(*states, *shape)
    return parts


def method_of(member: Any) -> str:
    """How a member is explained: by DeepLift if it is a chain of layers with valid rules, each used once."""
    layers = list(member.children())
    ruled = all(type(layer) in RULED or _separable(layer) for layer in layers)
    return DEEP_LIFT if ruled and len(layers) == len(member) else INTEGRATED


def attributed(
    ensemble: Ensemble,
    observations: Observations,
    baseline: Observations,
) -> Attributions:
    """Every member's attributions, by the method valid for it.

    DeepLift has the rescale rule (Shrikumar et al. 2017), and computes in double, where rounding does not matter.
    ``observations`` are the members' view of a few states (n, ...), compared with ``baseline`` (...).
    """
    method = method_of(ensemble.members[0])
    explained = _deep_lift if method == DEEP_LIFT else _integrated
    inputs, reference = inputs_of(observations), inputs_of(baseline[None])
    values, log_odds, baselines = [], [], []
    for member in ensemble.members:
        network, of_member = explained(member, inputs, reference)
        if of_member.ndim == 4:  # back to the order of observations
            of_member = of_member.permute(0, 2, 3, 1)
        values.append(of_member)
        with torch.no_grad():
            precise = next(network.parameters()).dtype
            log_odds.append(network(inputs.to(precise))[:, 0])
            baselines.append(network(reference.to(precise))[:, 0])
    columns = [torch.stack(parts, dim=1).double().numpy() for parts in (values, log_odds, baselines)]
    return Attributions(columns[0], columns[1], columns[2][0], method)


def _integrated(
    member: nn.Module,
    inputs: Tensor,
    reference: Tensor,
) -> tuple[nn.Module, Tensor]:
    """A network of log-odds (n, 1), and the attributions (n, ...) to its inputs."""
    from captum.attr import IntegratedGradients

    network = nn.Sequential(member, _LogOdds())
    size = at_once(AT_ONCE, inputs.shape[1:])
    integrated = IntegratedGradients(network)
    values = integrated.attribute(
        inputs,
        reference,
        target=0,
        n_steps=STEPS,
        internal_batch_size=size,
    )
    return network, values.detach()


def _deep_lift(
    member: nn.Module,
    inputs: Tensor,
    reference: Tensor,
) -> tuple[nn.Module, Tensor]:
    """As :func:`_integrated`, in double."""
    inputs, reference = inputs.double(), reference.double()
    network = attributable(copy.deepcopy(member).cpu().double().eval(), reference)
    parts = []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about tqdm's bar, which is never drawn, and about hooks
        from captum.attr import DeepLift

        for part in inputs.split(at_once(AT_ONCE, (INSIDE, *inputs.shape[1:]))):
            values = DeepLift(network).attribute(
                part.detach().requires_grad_(),
                reference,
                target=0,
            )
            parts.append(values.detach())
    return network, torch.cat(parts)


def attributable(network: nn.Module, example: Tensor) -> nn.Sequential:
    """A member's log-odds (n, 1) on (n, C, H, W), as a chain of modules for which Captum's rules are valid.

    Its rule for max pooling credits a pixel for the last window that it is the maximum of, and loses its credit for the
    others; DoorKey's windows overlap. So each window gets a copy of its pixels, which is linear, and the maximum is
    taken over separate windows. ``example`` is an input, from which shapes follow.
    """
    layers = []
    values = example
    with torch.no_grad():
        for layer in network.children():
            before, values = values, layer(values)
            if not isinstance(layer, nn.MaxPool2d):
                layers.append(layer)
                continue
            channels = before.shape[1]
            windows = nn.Unfold(layer.kernel_size, stride=layer.stride)
            pixels = windows(before).shape[1] // channels
            layers += [windows, nn.Unflatten(1, (channels, pixels)), nn.MaxPool2d((pixels, 1))]
            layers += [nn.Flatten(), nn.Unflatten(1, values.shape[1:])]
    return nn.Sequential(*layers, _LogOdds())


def _separable(layer: nn.Module) -> bool:
    """Whether it is a pooling whose windows can be separated."""
    return isinstance(layer, nn.MaxPool2d) and not layer.ceil_mode and layer.padding == 0 and layer.dilation == 1


class _LogOdds(nn.Module):
    """Logits (n, 2) -> log-odds (n, 1)."""

    def forward(self, logits: Tensor) -> Tensor:
        """The difference of the logits."""
        return logits[:, 1:] - logits[:, :1]
