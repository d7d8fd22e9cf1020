"""Double Q-learning targets (Van Hasselt, Guez and Silver 2016), target copies, exploration schedules, and steps."""

import math
from collections.abc import Iterable

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn.utils import clip_grad_norm_

from hypogoal.core.errors import NumericalError

SOFT = 0.01  # how far a target network follows at an update where it is not copied now and then


def double_q_targets(
    rewards: Tensor,
    terminal: Tensor,
    next_online: Tensor,
    next_target: Tensor,
    gamma: float | Tensor,
    *,
    bounded: bool = False,
) -> Tensor:
    """Spec D2: r + gamma (1 - terminal) Q_target(s', argmax_a Q_online(s', a)).

    Args:
        rewards: float (...,).
        terminal: bool (...,), True where nothing follows s'.
        next_online: float (..., A), the online network at s'.
        next_target: float (..., A), the target network at s'.
        gamma: discount of s', float or (...,): per step, or to the power n where s' is n steps on.
        bounded: clip the targets to 0..1, the range of an option's return: bootstrapped values that feed on themselves
            cannot grow beyond that.

    Returns:
        float (...,).

    Source: Van Hasselt, Guez and Silver 2016, the target of Double DQN.
    """
    best = next_online.argmax(-1, keepdim=True)
    following = next_target.gather(-1, best).squeeze(-1)
    targets = rewards + gamma * following * (~terminal)
    return targets.clamp(0.0, 1.0) if bounded else targets


@torch.no_grad()
def target_rate(updates: int, interval: int) -> float:
    """How far the target network follows after so many updates: all the way every ``interval``; 0: a little at each."""
    if interval == 0:
        return SOFT
    return 1.0 if updates % interval == 0 else 0.0


def follow(target: Iterable[Tensor], online: Iterable[Tensor], tau: float) -> None:
    """Move a target network's tensors towards the online network's by ``tau``; integers, and all at 1, are copied."""
    for ours, theirs in zip(target, online, strict=True):
        if tau < 1 and ours.is_floating_point():
            ours.lerp_(theirs, tau)
        else:
            ours.copy_(theirs)


def descend(
    loss: Tensor,
    network: nn.Module,
    optimiser: torch.optim.Optimizer,
    owner: str,
    where: str,
    largest: float = math.inf,
) -> None:
    """Spec G3: a step of ``optimiser`` down a loss, with the network's gradients cut to the norm ``largest``.

    A loss or gradient with NaN or Inf is a ``NumericalError`` that names ``owner`` and ``where``; the weights stay.
    """
    if not torch.isfinite(loss):
        raise NumericalError(f"the loss of {owner} is {float(loss.detach())} {where}")
    network.zero_grad()
    loss.backward()
    norm = clip_grad_norm_(network.parameters(), largest)
    if not torch.isfinite(norm):
        raise NumericalError(f"a gradient of {owner} is {float(norm)} {where}")
    optimiser.step()


def linear_epsilon(steps: NDArray[np.int64], over: int, final: float) -> NDArray[np.float64]:
    """Exploration falling from 1 to ``final`` over ``over`` steps (Tables 2 and 4), float (n,)."""
    return np.maximum(final, 1.0 - (1.0 - final) * np.asarray(steps) / over)
