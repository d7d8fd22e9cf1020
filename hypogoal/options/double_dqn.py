"""Double Q-learning (Van Hasselt, Guez and Silver 2016): targets, one update, the target network, exploration."""

import copy
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import huber_loss
from torch.nn.utils import clip_grads_with_norm_, get_total_norm

from hypogoal.core.adam import Adam
from hypogoal.core.arrays import Bools, Doubles, Floats, Ints, tensor
from hypogoal.core.checkpoints import Resumable
from hypogoal.core.errors import NumericalError
from hypogoal.core.tensors import load_into
from hypogoal.options.config import LearnerConfig

SOFT = 0.01  # the share by which a target network follows at each update, if ``target_interval`` is 0


def double_q_targets(
    rewards: Tensor,
    terminal: Tensor,
    next_online: Tensor,
    next_target: Tensor,
    gamma: float | Tensor,
    *,
    bounded: bool = False,
) -> Tensor:
    """Return r + gamma (1 - terminal) Q_target(s', argmax_a Q_online(s', a)).

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
    targets = rewards + gamma * following * ~terminal
    return targets.clamp(0.0, 1.0) if bounded else targets


@dataclass(frozen=True)
class ReplayBatch:
    """Transitions that the policies of O options learn from."""

    actions: Ints  # (n,)
    steps: Ints  # (n,), the number of steps from the state to the next state
    reached: Bools  # (n, O), whether the option's sub-goal holds in the next state
    terminated: Bools  # (n,), whether the task is over in the next state
    learns: Bools  # (n, O), which policies learn from which transitions
    weights: Floats  # (n,), the importance weights


class Updated(NamedTuple):
    """The numbers of one update."""

    loss: float
    q: float  # the mean value of the actions taken
    errors: Floats  # (n,), each transition's largest absolute TD error


class DoubleDQN(Resumable):
    """An online network of values (n, O, A), its optimiser, and the target network that follows it.

    Gradients are cut to the norm ``largest``.
    """

    CHANGING: ClassVar[tuple[str, ...]] = ("online", "target", "optimiser", "updates")

    def __init__(self, online: nn.Module, config: LearnerConfig, largest: float = math.inf):
        self.online, self.config, self.largest = online, config, largest
        self.target = copy.deepcopy(online).requires_grad_(False).eval()
        self.optimiser = Adam(online.parameters(), config.option_learning_rate)
        self.updates = 0
        # The pairs of tensors are gathered once, because gathering takes as long as updating in place.
        self._followed = [*zip(self.target.state_dict().values(), online.state_dict().values(), strict=True)]

    def update(
        self,
        values: Tensor,
        next_online: Tensor,
        next_target: Tensor,
        batch: ReplayBatch,
        options: Sequence[int],
        step: int,
    ) -> Updated:
        """Take a step down the Huber loss of a batch, then let the target network follow.

        ``values`` are the online network's values in the states, with gradients. ``next_online`` and ``next_target``
        are the two networks' values in the next states. All are float (n, O, A). Error messages name ``options`` (O,)
        and ``step``.
        """
        actions, steps, reached, terminated, learns, weights = (
            tensor(array, values.device) for array in vars(batch).values()
        )
        gamma, bounded = self.config.option_gamma, self.config.bounded_values
        ahead = steps[:, None].float()
        rewards = reached.float() * gamma ** (ahead - 1)  # 1 where the option's own classifier is positive
        terminal = reached | terminated[:, None]
        targets = double_q_targets(rewards, terminal, next_online, next_target, gamma**ahead, bounded=bounded)
        taken = values.gather(2, actions[:, None, None].expand(-1, len(options), 1)).squeeze(2)
        errors = (taken - targets) * learns
        losses = huber_loss(errors, torch.zeros_like(errors), reduction="none")
        loss = (losses.sum(1) * weights).mean()
        if not loss.isfinite():
            finite = losses.isfinite().all(0).tolist()
            options = [option for option, fine in zip(options, finite, strict=True) if not fine]
        where = f"in the batch of update {self.updates}, step {step}"
        descend(loss, self.optimiser, f"options {list(options)}", where, self.largest)
        self.updates += 1
        self._follow()
        largest = errors.detach().abs().amax(1).cpu().numpy()
        return Updated(float(loss.detach()), float(taken.detach().mean()), largest)

    @torch.no_grad()
    def _follow(self) -> None:
        """Copy the online network every ``target_interval`` updates. If that is 0, move towards it each time."""
        interval = self.config.target_interval
        if interval and self.updates % interval:
            return
        for ours, theirs in self._followed:
            if interval or not ours.is_floating_point():
                ours.copy_(theirs)
            else:
                ours.lerp_(theirs, SOFT)

    def load(self, weights: Mapping[str, Tensor], where: str) -> None:
        """Go on with ``weights``. Raises ``UserError``, which names ``where``, if the weights do not fit."""
        load_into(self.online, weights, where)
        self.target.load_state_dict(weights)


def descend(
    loss: Tensor,
    optimiser: Adam,
    owner: str,
    where: str,
    largest: float = math.inf,
) -> None:
    """Take a step of ``optimiser`` down a loss, with gradients cut to the norm ``largest``.

    Raises ``NumericalError``, which names ``owner`` and ``where``, if the loss or a gradient is NaN or infinite. The
    weights stay as they were then.
    """
    if not torch.isfinite(loss):
        raise NumericalError(f"the loss of {owner} is {float(loss.detach())} {where}")
    optimiser.zero_grad()
    loss.backward()
    norm = get_total_norm([weight.grad for weight in optimiser.weights if weight.grad is not None])
    if not torch.isfinite(norm):
        raise NumericalError(f"a gradient of {owner} is {float(norm)} {where}")
    if norm > largest:
        clip_grads_with_norm_(optimiser.weights, largest, norm)
    optimiser.step()


def linear_epsilon(steps: int | Ints, over: int, final: float) -> Doubles:
    """Return the probability of exploration at ``steps``, which falls from 1 to ``final`` over ``over`` steps.

    Source: Tables 2 and 4.
    """
    return np.maximum(final, 1.0 - (1.0 - final) * np.asarray(steps) / over)
