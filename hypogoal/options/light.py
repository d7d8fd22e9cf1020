"""Light option learning: one trunk, a head per member, every step a lesson for every member.

The method is Double DQN with prioritised replay over state ids. With ``experience=shared``, every member learns from
each transition, with its own reward, unless the transition starts inside its sub-goal. With ``experience=own`` (the
paper), only the member whose option was running learns, and a transition may reach several steps ahead within its
execution.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from hypogoal.core.arrays import Bools, Floats, Ints
from hypogoal.core.drawing import DrawsFrom
from hypogoal.core.errors import UserError
from hypogoal.core.seeding import torch_generator
from hypogoal.core.tensors import below
from hypogoal.domains.base import Engine
from hypogoal.options import double_dqn, networks, saved
from hypogoal.options.config import STACK, LightConfig, OptionConfig
from hypogoal.options.learner import Learner, Transitions
from hypogoal.options.replay import PrioritisedReplay, Steps, StepsAhead

POSITIVES_KEPT = 512  # the number of steps kept that reached a member's sub-goal
POSITIVE_SHARE = 0.25  # the share of a batch that is drawn from the steps that reached a sub-goal
GRADIENT_NORM = 10.0


@dataclass(frozen=True)
class Lessons(Steps):
    """Transitions to learn from, as arrays (n,)."""

    option: Ints  # the option that was running
    terminated: Bools  # whether the task is over


class LightLearner(Learner):
    """A learner of O options whose policies share a network. The arguments are those of :class:`Learner`."""

    policies = saved.LightPolicies
    settings: LightConfig
    CHANGING = (*Learner.CHANGING, "networks", "replay", "ahead", "positive", "steps", "due")

    @classmethod
    def refuse(cls, config: OptionConfig, engine: Engine) -> None:
        """Raise ``UserError`` if ``n_step`` is above 1 and ``experience`` is not ``own``.

        Other members' sub-goals may lie between the first and the last of several steps.
        """
        steps = config.part(LightConfig).n_step
        if steps > 1 and config.experience != "own":
            raise UserError(
                "several steps at once are for an option's own member: others' sub-goals may lie among them",
                f"n_step={steps}, experience={config.experience}",
                "Give --set experience=own or --set n_step=1.",
            )

    def build(self, config: OptionConfig, seed: int) -> None:
        self.settings = settings = config.part(LightConfig)
        self.running_only = config.experience == "own"
        self.networks = double_dqn.DoubleDQN(self.network(settings, seed), settings, GRADIENT_NORM)
        self.ahead = StepsAhead(self.engine.count, settings.n_step)
        self.replay = PrioritisedReplay(Lessons.zeros(settings.replay))
        self.positive = Lessons.zeros(self.options, POSITIVES_KEPT)
        self.steps = self.due = 0

    def network(self, settings: LightConfig, seed: int) -> networks.LightQNetwork:
        """Return a network with fresh weights."""
        engine = self.engine
        with DrawsFrom(torch_generator(seed, "option-weights")):
            network = networks.LightQNetwork(
                engine.observation_shape,
                self.options,
                engine.n_actions,
                engine.standard,
                settings.embedding,
            )
        return network.to(self.device)

    @staticmethod
    def reach(config: OptionConfig, options: int) -> int:
        """Return how many states back the learner looks.

        A transition waits n steps to be complete, and up to n more for its turn in the ring.
        """
        settings = config.part(LightConfig)
        return settings.replay + (2 * settings.n_step + STACK) * config.environments

    @torch.no_grad()
    def greedy(
        self,
        ids: Ints,
        options: Ints,
        age: Ints,
    ) -> Ints:
        values = networks.apply_to_states(self.networks.online, self.engine, ids, self.device).cpu().numpy()
        return values[np.arange(len(ids)), options].argmax(1)

    def observe(self, moved: Transitions) -> None:
        count = len(moved.ids)
        ones = np.ones(count, int)
        steps = Lessons.cast(
            moved.ids,
            moved.actions,
            moved.next_ids,
            ones,
            moved.options,
            moved.terminated,
        )
        rows = self.ahead.add(steps, moved.ended)
        self.replay.add(rows)
        learns, reached = self._judged(rows)
        for row, option in zip(*np.nonzero(learns & reached), strict=True):
            self.positive.put((option, self.positives[option] % POSITIVES_KEPT), rows.at(row))
            self.positives[option] += 1
        self.count(moved.options)
        self.steps += count
        self.due += count

    def _judged(self, rows: Lessons) -> tuple[Bools, Bools]:
        """Return which options learn from each transition and which sub-goals hold in its next state, bool (m, O) each.

        No option learns from a state inside its sub-goal. With ``experience=own``, both arrays are False for options
        that were not running.
        """
        if not self.running_only:
            return ~self.terminations.of(rows.state), self.terminations.of(rows.next_state)
        owner = rows.option[:, None] == np.arange(self.options)
        inside = self.terminations.of_running(rows.state, rows.option)
        reached = self.terminations.of_running(rows.next_state, rows.option)
        return owner & ~inside[:, None], owner & reached[:, None]

    def learn(self) -> dict[str, float]:
        if self.steps < self.settings.warm_up or not self.replay.size:  # n-step transitions enter the replay late
            self.due = 0
        last = None
        while self.due >= self.settings.update_interval:
            self.due -= self.settings.update_interval
            last = self._update()
        return self.health(last, self.replay.size) if last else {}

    def _update(self) -> double_dqn.Updated:
        """Update all policies once."""
        lessons, indices, weights = self._batch()
        learns, reached = self._judged(lessons)
        batch = double_dqn.ReplayBatch(
            lessons.action,
            lessons.steps,
            reached,
            lessons.terminated,
            learns,
            weights,
        )
        values = networks.values_of(
            self.networks.online,
            self.networks.target,
            self.engine,
            lessons.state,
            lessons.next_state,
            self.device,
        )
        updated = self.networks.update(
            *values,
            batch,
            range(self.options),
            self.steps,
        )
        self.replay.set_priorities(indices, updated.errors[: len(indices)])
        return updated

    def _batch(self) -> tuple[Lessons, Ints, Floats]:
        """Draw n transitions. Return the transitions, indices, int64 (m,), and weights, float32 (n,).

        The first m transitions are drawn from the replay, at the indices.
        """
        kept = np.arange(POSITIVES_KEPT) < self.positives[:, None]
        if self.engine.memory is not None:
            kept &= self.engine.remembers(self.positive.state)
            kept &= self.engine.remembers(self.positive.next_state)
        counts = kept.sum(1)
        have = np.flatnonzero(counts)
        size = self.settings.option_batch
        extra = round(size * POSITIVE_SHARE) if len(have) else 0
        extra = min(extra, size - 1)  # at least one transition is drawn by priority
        indices, weights = self.replay.sample(size - extra, self.rng)
        batch = self.replay.data.at(indices)
        if extra:
            options = have[self.rng.integers(len(have), size=extra)]
            ranks = (self.rng.random(extra) * counts[options]).astype(int)
            _options, kept_slots = np.nonzero(kept)
            firsts = counts.cumsum() - counts  # the index of each option's first kept slot
            slots = kept_slots[firsts[options] + ranks]
            batch = Lessons.joined([batch, self.positive.at((options, slots))])
            weights = np.concatenate([weights, np.ones(extra, np.float32)])
        return batch, indices, weights

    def weights(self) -> dict[str, Tensor]:
        return {f"online.{name}": value for name, value in self.networks.online.state_dict().items()}

    def load_weights(self, weights: Mapping[str, Tensor]) -> None:
        self.networks.load(below("online.", weights), saved.FILE)
