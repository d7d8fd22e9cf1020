"""What a member looks at in a state: DeepLift attributions, and a check that they are complete (Spec F2, Figures 2, 9).

Members with layers for which DeepLift has no valid rules are explained by integrated gradients (Sundararajan et al.
2017): means over ``STEPS`` states between the baseline and the state, complete up to the error of so few steps.

Attributed are the log-odds, the difference of a member's two logits. Their sign is the prediction at a threshold of
0.5, so positive attributions speak for a positive prediction. A state's attributions, summed over pixels and frames,
must equal its log-odds minus the baseline's; the error is reported.
"""

from __future__ import annotations

import copy
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from math import prod
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from hypogoal.hypotheses.networks import as_input, as_tensor, at_once
from hypogoal.observations import NUMBERS, PICTURE, Observations, fields_of

DEEP_LIFT, INTEGRATED = "DeepLift", "integrated gradients"
STEPS, AT_ONCE = 32, 64  # gradients for a state's integral; images whose gradients are computed together
INSIDE = 64  # DeepLift's memory relative to a plain pass: both states, in double, with copies of pooled pixels
RULED = (nn.Conv2d, nn.Linear, nn.BatchNorm2d, nn.ReLU, nn.AvgPool2d, nn.AdaptiveAvgPool2d, nn.Flatten, nn.Dropout)

if TYPE_CHECKING:
    from hypogoal.hypotheses.ensemble import Ensemble


@dataclass(frozen=True)
class Attributions:
    """Attributions of every member on n states."""

    values: NDArray[np.float64]  # (n, K, H, W, C), or (n, K, *shape), of mixed ones (n, K, D), in log-odds
    log_odds: NDArray[np.float64]  # (n, K)
    baseline_log_odds: NDArray[np.float64]  # (K,)
    method: str = DEEP_LIFT

    def completeness_error(self) -> NDArray[np.float64]:
        """Spec F2: |sum of the attributions - (log-odds of the state - log-odds of the baseline)|, (n, K)."""
        return np.abs(self.sums() - (self.log_odds - self.baseline_log_odds))

    def sums(self) -> NDArray[np.float64]:
        """The sum for each state and member, (n, K)."""
        return np.asarray(self.values.reshape(*self.log_odds.shape, -1).sum(-1))


def mean_state(observations: Observations) -> Observations:
    """The baseline: the mean of viewed observations, (N, ...) -> (...); of pictures rounded, uint8 (H, W, C).

    Against a black image, which is a state of no domain, the things that all states share (walls, the floor) would get
    most of the attribution, and black things (a pit, an open door) none. Against the mean state, only differences from
    the usual get any.
    """
    if observations.dtype.names:
        states = np.zeros((), observations.dtype)
        for key in observations.dtype.names:
            states[key] = mean_state(observations[key])
        return states
    mean = observations.mean(axis=0, dtype=np.float64)
    return (mean.round() if observations.dtype == PICTURE else mean).astype(observations.dtype)


def by_key(values: NDArray[np.floating], dtype: np.dtype[Any]) -> NDArray[Any]:
    """Attributions (..., D) of mixed observations as float32 with a field for each key."""
    fields, place = fields_of((), dtype), 0
    parts = np.empty(values.shape[:-1], [(key, NUMBERS, shape) for key, (_, shape) in fields.items()])
    for key, (_, shape) in fields.items():
        sizes = as_input(torch.zeros(1, *shape)).shape[1:]
        part = torch.from_numpy(values[..., place : place + prod(shape)]).reshape(-1, *sizes)
        parts[key] = _as_observations(part).numpy().reshape(*values.shape[:-1], *shape)
        place += prod(shape)
    return parts


def explanation(attributions: Attributions, picked: Sequence[tuple[int, str]]) -> list[dict[str, Any]]:
    """Spec F2: the check by state and member, for n states ``picked`` as (index, kind)."""
    errors, sums = attributions.completeness_error(), attributions.sums()
    frames = np.abs(attributions.values).reshape(*sums.shape, -1, attributions.values.shape[-1]).sum(2)
    total = frames.sum(-1)
    share = np.divide(frames[..., -1], total, out=np.full_like(sums, np.nan), where=total > 0)
    columns = {
        "log_odds": attributions.log_odds,
        "baseline_log_odds": np.broadcast_to(attributions.baseline_log_odds, sums.shape),
        "attributed": sums,
        "completeness_error": errors,
        "last_frame": share,
    }
    members = [
        [
            {"member": member, **{name: float(values[state, member]) for name, values in columns.items()}}
            for member in range(sums.shape[1])
        ]
        for state in range(len(picked))
    ]
    method = attributions.method
    return [{"kind": kind, "method": method, "members": rows} for (_, kind), rows in zip(picked, members, strict=True)]


def method_of(member: nn.Module) -> str:
    """How a member is explained: by DeepLift if it is a chain of layers with valid rules, each used once."""
    layers, example = list(member.children()), torch.zeros(1, 1, 1, 1)
    ruled = all(type(layer) in RULED or _window_of(layer, example) is not None for layer in layers)
    return DEEP_LIFT if ruled and len(layers) == len(member._modules) else INTEGRATED


def attributed(ensemble: Ensemble, observations: Observations, baseline: Observations) -> Attributions:
    """Spec F2: every member's attributions, by the method valid for it.

    DeepLift has the rescale rule (Shrikumar et al. 2017), and computes in double, where rounding does not matter.
    ``observations`` are the members' view of a few states (n, ...), compared with ``baseline`` (...).
    """
    method = method_of(ensemble.members[0])
    inputs, reference = (as_input(as_tensor(some), some.dtype) for some in (observations, baseline[None]))
    parts = [(_deep_lift if method == DEEP_LIFT else _integrated)(each, inputs, reference) for each in ensemble.members]
    values, log_odds, baselines = (torch.stack(part, dim=1).double().numpy() for part in zip(*parts, strict=True))
    return Attributions(values, log_odds, baselines[0], method)


def _integrated(member: nn.Module, inputs: Tensor, reference: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Attributions (n, ...), log-odds (n,) and the baseline's (1,)."""
    from captum.attr import IntegratedGradients

    network, size = nn.Sequential(member, _LogOdds()), at_once(AT_ONCE, inputs.shape[1:])
    integrated = IntegratedGradients(network)
    values = integrated.attribute(inputs, reference, target=0, n_steps=STEPS, internal_batch_size=size)
    with torch.no_grad():
        return _as_observations(values), network(inputs)[:, 0], network(reference)[:, 0]


def _deep_lift(member: nn.Module, inputs: Tensor, reference: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """As :func:`_integrated`."""
    inputs, reference = inputs.double(), reference.double()
    network = attributable(copy.deepcopy(member).cpu().double().eval(), reference)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="IProgress not found")  # from tqdm, about a bar that is never drawn
        from captum.attr import DeepLift

        warnings.filterwarnings("ignore", message=r"\s*Setting forward, backward hooks", category=UserWarning)
        size = at_once(AT_ONCE, (INSIDE, *inputs.shape[1:]))
        parts = [part.detach().requires_grad_() for part in inputs.split(size)]
        values = torch.cat([DeepLift(network).attribute(part, reference, target=0).detach() for part in parts])
    with torch.no_grad():
        return _as_observations(values), network(inputs)[:, 0], network(reference)[:, 0]


def _as_observations(values: Tensor) -> Tensor:
    """Reorder axes from those of :func:`as_input` to those of observations."""
    return values.permute(0, 2, 3, 1) if values.ndim == 4 else values


def attributable(network: nn.Module, example: Tensor) -> nn.Sequential:
    """A member's log-odds (n, 1) on (n, C, H, W), as a chain of modules for which Captum's rules are valid.

    Its rule for max pooling credits a pixel for the last window that it is the maximum of, and loses its credit for the
    others; DoorKey's windows overlap. So each window gets a copy of its pixels, which is linear, and the maximum is
    taken over separate windows. ``example`` is an input, from which shapes follow.
    """
    layers: list[nn.Module] = []
    values = example
    with torch.no_grad():
        for layer in network.children():
            after = layer(values)
            window = _window_of(layer, values)
            if window is None:
                layers.append(layer)
            else:
                side, stride = window
                layers += [_Windows(side, stride), nn.MaxPool1d(side[0] * side[1])]
                layers += [nn.Flatten(), nn.Unflatten(1, after.shape[1:])]
            values = after
    return nn.Sequential(*layers, _LogOdds())


def _window_of(layer: nn.Module, values: Tensor) -> tuple[tuple[int, int], tuple[int, int]] | None:
    """The sides and strides of a pooling whose windows can be separated; None for any other module."""
    height, width = values.shape[-2:] if values.ndim == 4 else (0, 0)
    if isinstance(layer, nn.AdaptiveMaxPool2d) and layer.output_size in (1, (1, 1)):
        return (height, width), (1, 1)
    if isinstance(layer, nn.MaxPool2d) and not layer.ceil_mode and layer.padding == 0 and layer.dilation == 1:
        return _pair(layer.kernel_size), _pair(layer.stride)
    return None


def _pair(value: int | tuple[int, ...]) -> tuple[int, int]:
    return (value, value) if isinstance(value, int) else (value[0], value[1])


class _Windows(nn.Module):
    """(n, C, H, W) -> (n, C * windows, pixels of a window)."""

    def __init__(self, side: tuple[int, int], stride: tuple[int, int]):
        super().__init__()
        self.side, self.stride = side, stride

    def forward(self, values: Tensor) -> Tensor:
        """Copy the pixels, window by window."""
        windows = values.unfold(2, self.side[0], self.stride[0]).unfold(3, self.side[1], self.stride[1])
        return windows.reshape(len(values), -1, self.side[0] * self.side[1])


class _LogOdds(nn.Module):
    """Logits (n, 2) -> log-odds (n, 1)."""

    def forward(self, logits: Tensor) -> Tensor:
        """The difference of the logits."""
        return logits[:, 1:] - logits[:, :1]
