"""What a member looks at in a state: DeepLift attributions, and a check that they are complete (Figures 2, 9).

Some members have layers for which DeepLift has no valid rules. Such members are explained by integrated gradients
(Sundararajan et al. 2017): means over ``STEPS`` states between the baseline and the state. Integrated gradients are
complete up to the error of using only ``STEPS`` states.

Attributions explain the log-odds, which are the difference of a member's two logits. The sign of the log-odds is the
prediction at a threshold of 0.5, so positive attributions speak for a positive prediction. A state's attributions,
summed over pixels and frames, must equal the state's log-odds minus the baseline's log-odds. The error of this equation
is reported.
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
STEPS, AT_ONCE = 32, 64  # the number of gradients in a state's integral, and of images in one backward pass
# DeepLift needs about this many times the memory of a plain pass, because it keeps the state and the baseline in
# float64, with copies of pooled pixels.
INSIDE = 64
RULED = (nn.Conv2d, nn.Linear, nn.BatchNorm2d, nn.ReLU, nn.AvgPool2d, nn.AdaptiveAvgPool2d, nn.Flatten, nn.Dropout)

if TYPE_CHECKING:
    from hypogoal.hypotheses.ensemble import Ensemble


@dataclass(frozen=True)
class Attributions:
    """The attributions of every member for n states.

    Attributes:
        values: float64 (n, K, H, W, C) for pictures, (n, K, *shape) for numbers, (n, K, D) for mixed observations, in
            log-odds.
        log_odds: float64 (n, K), the members' log-odds of the states.
        baseline_log_odds: float64 (K,), the members' log-odds of the baseline.
        method: the name of the method, ``DeepLift`` or ``integrated gradients``.
    """

    values: Doubles
    log_odds: Doubles
    baseline_log_odds: Doubles
    method: str

    def completeness_error(self) -> Doubles:
        """Return |sum of attributions - (log-odds of the state - log-odds of the baseline)|, float64 (n, K)."""
        sums = self.values.reshape(*self.log_odds.shape, -1).sum(-1)
        return np.abs(sums - (self.log_odds - self.baseline_log_odds))


def mean_state(observations: Observations) -> Observations:
    """Return the mean (...) of viewed observations (N, ...), which is the baseline.

    For pictures the mean is rounded, uint8 (H, W, C). A black image would be a bad baseline, because it is a state of
    no domain. Things that all states share (walls, the floor) would get most of the attribution, and black things (a
    pit, an open door) would get none. With the mean state as the baseline, only differences from the usual get
    attribution.
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
    """Return attributions (..., D) of mixed observations as a float32 array with one field for each key."""
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
    """Return the name of the method that explains a member.

    The method is DeepLift if the member is a chain of layers with valid rules, each used once. Otherwise it is
    integrated gradients.
    """
    layers = list(member.children())
    ruled = all(type(layer) in RULED or _separable(layer) for layer in layers)
    return DEEP_LIFT if ruled and len(layers) == len(member) else INTEGRATED


def attributed(
    ensemble: Ensemble,
    observations: Observations,
    baseline: Observations,
) -> Attributions:
    """Compute every member's attributions, by the method that is valid for the members.

    DeepLift uses the rescale rule (Shrikumar et al. 2017) and computes in float64, where rounding does not matter.

    Args:
        ensemble: the ensemble of K members.
        observations: the members' view of a few states (n, ...).
        baseline: the members' view of the baseline (...), with which the states are compared.

    Returns:
        The attributions of n states by K members.
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
    """Attribute by integrated gradients.

    Returns a network that gives log-odds (n, 1), and the attributions (n, ...) to its inputs.
    """
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
    """Return what :func:`_integrated` returns, by DeepLift and in float64."""
    inputs, reference = inputs.double(), reference.double()
    network = attributable(copy.deepcopy(member).cpu().double().eval(), reference)
    parts = []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Captum warns of tqdm's bar, which is never drawn, and of hooks
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
    """Return a network that gives the log-odds (n, 1) of inputs (n, C, H, W), built so that Captum's rules are valid.

    Captum's rule for max pooling credits a pixel only for the last window of which the pixel is the maximum. So credit
    for the other windows is lost, and DoorKey's windows overlap. To mend that, each window gets a copy of its pixels,
    which is linear, and the maximum is taken over separate windows. ``example`` is an input, from which shapes follow.
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
    """Say whether ``layer`` is a max pooling whose windows can be separated."""
    return isinstance(layer, nn.MaxPool2d) and not layer.ceil_mode and layer.padding == 0 and layer.dilation == 1


class _LogOdds(nn.Module):
    """A layer from logits (n, 2) to log-odds (n, 1)."""

    def forward(self, logits: Tensor) -> Tensor:
        """Return the positive logit minus the negative logit."""
        return logits[:, 1:] - logits[:, :1]
