"""Light option learning: one trunk, a head per member, every step a lesson for every member (Spec D1, D2, D8).

Double DQN with prioritised replay over state ids. With ``experience=shared`` every member learns from each transition,
with its own reward, unless the transition starts inside its sub-goal. With ``experience=own`` (the paper) only the
member whose option was running learns, and a transition may reach several steps ahead within its execution.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hypogoal.core.errors import UserError
from hypogoal.core.seeding import drawing_from, torch_generator
from hypogoal.core.tensors import below, load_fitting
from hypogoal.domains.base import Engine
from hypogoal.learners.double_dqn import Batch, DoubleDQN
from hypogoal.learners.replay import PrioritisedReplay, Steps, StepsAhead
from hypogoal.observations import Observations, standard_of
from hypogoal.options.config import STACK, LightConfig
from hypogoal.options.learner import (
    FILE,
    Learner,
    Policies,
    SavedOptions,
    Transitions,
)
from hypogoal.options.networks import (
    LightQNetwork,
    PictureEmbedding,
    apply_all_to_states,
    apply_to_states,
)
from hypogoal.options.parts import Flags, Ids

POSITIVES_KEPT = 512  # per member
POSITIVE_SHARE = 0.25  # of a batch: steps that reached a sub-goal
GRADIENT_NORM = 10.0


@dataclass(frozen=True)
class Lessons(Steps):
    """Transitions to learn from, arrays (n,)."""

    option: NDArray[np.int16]  # that was running
    terminated: NDArray[np.bool_]  # the task is over


class LightLearner(Learner):
    """The intra-option policies of all O options, acting and learning together; arguments as of :class:`Learner`."""

    CHANGING = (*Learner.CHANGING, "networks", "replay", "ahead", "positive", "steps", "due")

    @classmethod
    def refuse(cls, config: LightConfig, engine: Engine) -> None:
        """Other members' sub-goals may lie between the first and the last of several steps."""
        if config.n_step > 1 and config.experience != "own":
            fault = "several steps at once are for an option's own member: others' sub-goals may lie among them"
            setting = f"n_step={config.n_step}, experience={config.experience}"
            raise UserError(fault, setting, "Give --set experience=own or --set n_step=1.")

    @classmethod
    def policies(cls, saved: SavedOptions) -> Policies:
        return LightPolicies(saved)

    def build(self, config: LightConfig, seed: int) -> None:
        self.running_only = config.experience == "own"
        self.networks = DoubleDQN(self.network(config, seed), config, GRADIENT_NORM)
        self.ahead = StepsAhead(self.engine.count, config.n_step)
        self.replay = PrioritisedReplay(Lessons.zeros(config.replay))
        self.positive = Lessons.zeros(self.options, POSITIVES_KEPT)
        self.steps = self.due = 0

    def network(self, config: LightConfig, seed: int) -> LightQNetwork:
        """One with fresh weights."""
        engine = self.engine
        with drawing_from(torch_generator(seed, "option-weights")):
            shape, embedding = engine.observation_shape, config.embedding
            network = LightQNetwork(
                shape,
                self.options,
                engine.n_actions,
                engine.standard,
                embedding,
            )
        return network.to(self.device)

    @staticmethod
    def reach(config: LightConfig, options: int) -> int:
        """A transition waits n steps, and its turn in the ring n more."""
        return config.replay + (2 * config.n_step + STACK) * config.environments

    @torch.no_grad()
    def greedy(
        self,
        ids: Ids,
        options: Ids,
        age: Ids,
    ) -> Ids:
        values = apply_to_states(self.networks.online, self.engine, ids).cpu().numpy()
        return values[np.arange(len(ids)), options].argmax(1)

    def observe(self, moved: Transitions) -> None:
        one = np.ones(len(moved.ids), np.int64)
        steps = Lessons.cast(
            moved.ids,
            moved.actions,
            moved.next_ids,
            one,
            moved.options,
            moved.terminated,
        )
        rows = self.ahead.add(steps, moved.ended)
        self.replay.add(rows)
        inside, reached = self._judged(rows)
        for row, option in zip(*np.nonzero(reached & ~inside), strict=True):
            self.positive.put((option, self.positives[option] % POSITIVES_KEPT), rows.at(row))
            self.positives[option] += 1
        self.count(moved.options)
        self.steps += len(moved.ids)
        self.due += len(moved.ids)

    def _judged(self, rows: Lessons) -> tuple[Flags, Flags]:
        """Which options' sub-goals hold in ``state`` and in ``next_state`` of transitions, bool (m, O) each.

        With own experience, False for all options but the one that was running.
        """
        states = rows.state.astype(np.int64)
        next_states = rows.next_state.astype(np.int64)
        if not self.running_only:
            return self.terminations.of(states), self.terminations.of(next_states)
        option = rows.option.astype(np.int64)
        owner = option[:, None] == np.arange(self.options)
        inside = self.terminations.of_running(states, option)
        reached = self.terminations.of_running(next_states, option)
        return owner & inside[:, None], owner & reached[:, None]

    def learn(self) -> dict[str, float]:
        if self.steps < self.config.warm_up or not self.replay.size:  # n-step transitions wait before they are in it
            self.due = 0
        numbers: dict[str, float] = {}
        while self.due >= self.config.update_interval:
            self.due -= self.config.update_interval
            numbers = {"option_loss": self._update()}
        return numbers

    def _update(self) -> float:
        """One update of all policies; returns the loss."""
        lessons, indices, weights = self._batch()
        inside, reached = self._judged(lessons)
        learns = ~inside
        if self.running_only:
            learns &= lessons.option[:, None] == np.arange(self.options)
        ahead = self.tensor(lessons.steps).float()[:, None]
        gamma = self.config.option_gamma
        rewards = self.tensor(reached).float()  # Spec D1: 1 where the option's own classifier is positive, else 0
        batch = Batch(
            actions=self.tensor(lessons.action.astype(np.int64)),
            rewards=rewards * gamma ** (ahead - 1),
            terminal=self.tensor(reached | lessons.terminated[:, None]),
            discounts=gamma**ahead,
            weights=self.tensor(weights),
            learns=self.tensor(learns),
        )
        states = lessons.state.astype(np.int64)
        next_states = lessons.next_state.astype(np.int64)
        values = self._values(states, next_states)
        loss, errors = self.networks.update(*values, batch, range(self.options), self.steps)
        self.replay.set_priorities(indices, errors[: len(indices)])
        return loss

    def _batch(self) -> tuple[Lessons, Ids, NDArray[np.float32]]:
        """Transitions, the first of them drawn from the replay at indices int64 (m,), and weights float32 (n,)."""
        kept = np.arange(POSITIVES_KEPT) < self.positives[:, None]
        if self.engine.memory is not None:
            kept &= self.engine.remembers(self.positive.state)
            kept &= self.engine.remembers(self.positive.next_state)
        counts = kept.sum(1)
        have = np.flatnonzero(counts)
        extra = round(self.config.option_batch * POSITIVE_SHARE) if len(have) else 0
        extra = min(extra, self.config.option_batch - 1)  # priorities need one drawn by them
        indices, weights = self.replay.sample(self.config.option_batch - extra, self.rng)
        batch = self.replay.data.at(indices)
        if extra:
            options = have[self.rng.integers(len(have), size=extra)]
            ranks = (self.rng.random(extra) * counts[options]).astype(np.int64)
            slots = (kept[options].cumsum(axis=1) <= ranks[:, None]).sum(axis=1)
            batch = Lessons.joined([batch, self.positive.at((options, slots))])
            weights = np.concatenate([weights, np.ones(extra, np.float32)])
        return batch, indices, weights

    def _values(self, states: Ids, next_states: Ids) -> tuple[Tensor, Tensor, Tensor]:
        """The online network in states (with gradients) and in next states, the target in these; (n, O, A) each."""
        online = self.networks.online
        target = self.networks.target
        if isinstance(online.cells, PictureEmbedding):  # whose states hardly ever occur twice
            images = self.tensor(self.engine.images(np.concatenate([states, next_states])))
            now, later = images.float().split(len(states))
            with torch.no_grad():
                following = online(later), target(later)
            return online(now), *following
        # A batch has few distinct states, late in training 40 of 256: the networks see each once.
        distinct, places = np.unique(np.concatenate([states, next_states]), return_inverse=True)
        here, after = self.tensor(places).split(len(states))
        values, others = apply_all_to_states((online, target), self.engine, distinct)
        # index_select, not indexing, whose gradient takes several times as long.
        now = values.index_select(0, here)
        next_online = values.detach().index_select(0, after)
        next_target = others.index_select(0, after)
        return now, next_online, next_target

    def weights(self) -> dict[str, Tensor]:
        return {f"online.{name}": value for name, value in self.networks.online.state_dict().items()}

    def load_weights(self, weights: Mapping[str, Tensor]) -> None:
        self.networks.load(below("online.", weights), FILE)


class LightPolicies:
    """Greedy policies of saved options that share one network (Spec D8)."""

    def __init__(self, saved: SavedOptions):
        weights = below("online.", saved.weights)
        embedding = saved.config["embedding"]
        actions = saved.actions("online.heads.weight", saved.count)
        standard = standard_of(saved.shape) if "cells.mean" in weights else None  # the weights' own replaces it
        make = partial(
            LightQNetwork,
            saved.shape,
            saved.count,
            actions,
            standard,
            embedding,
        )
        self.network = load_fitting(make, weights, FILE)

    def __call__(self, option: int) -> Callable[[Observations], int]:
        """Start an execution."""
        return partial(self._act, option)

    @torch.no_grad()
    def _act(self, option: int, observation: Observations) -> int:
        values = self.network(torch.from_numpy(np.ascontiguousarray(observation[None])))[0, option]
        return int(values.argmax())
