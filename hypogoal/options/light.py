"""Light option learning: one trunk, a head per member, every step a lesson for every member (Spec D1, D2, D8).

Double DQN with prioritised replay over state ids. With ``experience=shared`` every member learns from each transition,
with its own reward, unless the transition starts inside its sub-goal. With ``experience=own`` (the paper) only the
member whose option was running learns, and a transition may reach several steps ahead within its execution.
"""

import copy
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hypogoal.core.drawing import DrawsFrom
from hypogoal.core.errors import UserError
from hypogoal.core.seeding import torch_generator
from hypogoal.core.tensors import below, load_fitting, load_into
from hypogoal.domains.base import Engine
from hypogoal.hypotheses.networks import AUTO, NETWORKS
from hypogoal.learners.double_dqn import descend, double_q_targets, follow, target_rate
from hypogoal.learners.replay import PrioritisedReplay, Steps, StepsAhead
from hypogoal.observations import Observations
from hypogoal.options.choosers import Ids
from hypogoal.options.config import STACK, LightConfig
from hypogoal.options.learner import Learner, Policies, SavedOptions, Transitions
from hypogoal.options.networks import (
    LightQNetwork,
    PictureEmbedding,
    Pixels,
    apply_all_to_states,
    apply_to_states,
    standard_in,
)

POSITIVES_KEPT = 512  # per member
POSITIVE_SHARE = 0.25  # of a batch: steps that reached a sub-goal
GRADIENT_NORM = 10.0


@dataclass(frozen=True)
class Lessons(Steps):
    """Transitions to learn from, arrays (n,)."""

    option: NDArray[np.int16]  # that was running
    terminated: NDArray[np.bool_]  # the task is over
    timed_out: NDArray[np.bool_]  # the option's time was up


class LightLearner(Learner):
    """The intra-option policies of all O options, acting and learning together; arguments as of :class:`Learner`."""

    CHANGING = (
        *Learner.CHANGING,
        *("online", "target", "optimiser", "replay", "ahead", "positive", "steps", "updates", "_due"),
    )

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
        self.ahead = StepsAhead(self.engine.count, config.n_step)
        with DrawsFrom(torch_generator(seed, "option-weights")):
            shape, standard = self.engine.observation_shape, self.engine.standard
            network = LightQNetwork(shape, self.options, self.engine.n_actions, standard, config.embedding)
            self.online = network.to(self.device)
        self.target = copy.deepcopy(self.online).requires_grad_(False)
        pictures = isinstance(self.online.cells, PictureEmbedding)
        self.pixels = Pixels(self.engine, 2 * config.option_batch, self.device) if pictures else None
        self.optimiser = torch.optim.Adam(self.online.parameters(), lr=config.option_learning_rate, fused=True)
        self.replay = PrioritisedReplay(config.replay, Lessons)
        self.positive = Lessons.zeros(self.options, POSITIVES_KEPT)
        self.steps = self.updates = self._due = 0

    @staticmethod
    def reach(config: LightConfig, options: int) -> int:
        """A transition waits n steps, and its turn in the ring n more."""
        return config.replay + (2 * config.n_step + STACK) * config.environments

    @torch.no_grad()
    def greedy(self, ids: Ids, options: Ids, age: Ids) -> Ids:
        values = apply_to_states(self.online, self.engine, ids).cpu().numpy()
        return values[np.arange(len(ids)), options].argmax(1)

    def observe(self, moved: Transitions) -> None:
        ones = np.ones(len(moved.ids), np.int64)
        outcome = moved.options, moved.terminated, moved.timed_out
        rows = self.ahead.add(Lessons.cast(moved.ids, moved.actions, moved.next_ids, ones, *outcome), moved.ended)
        self.replay.add(rows)
        inside, reached = self._judged(rows)
        for row, option in zip(*np.nonzero(reached & ~inside), strict=True):
            self.positive.put((option, self.positives[option] % POSITIVES_KEPT), rows.at(row))
            self.positives[option] += 1
        self.count(moved.options)
        self.steps += len(moved.ids)
        self._due += len(moved.ids)

    def _judged(self, rows: Lessons) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Which options' sub-goals hold in ``state`` and in ``next_state`` of transitions, bool (m, O) each.

        With own experience, False for all options but the one that was running.
        """
        states, next_states = rows.state.astype(np.int64), rows.next_state.astype(np.int64)
        if not self.running_only:
            return self.terminations.of(states), self.terminations.of(next_states)
        option = rows.option.astype(np.int64)
        owner = option[:, None] == np.arange(self.options)
        inside = self.terminations.of_running(states, option)
        reached = self.terminations.of_running(next_states, option)
        return owner & inside[:, None], owner & reached[:, None]

    def learn(self) -> dict[str, float]:
        if self.steps < self.config.warm_up or not self.replay.size:  # n-step transitions wait before they are in it
            self._due = 0
        numbers: dict[str, float] = {}
        while self._due >= self.config.update_interval:
            self._due -= self.config.update_interval
            numbers = self._update()
        return numbers

    def _batch(self) -> tuple[Lessons, NDArray[np.int64], NDArray[np.float32]]:
        """Transitions, the first of them drawn from the replay at indices int64 (m,), and weights float32 (n,)."""
        kept = np.arange(POSITIVES_KEPT) < self.positives[:, None]
        if self.engine.memory is not None:
            kept &= self.engine.remembers(self.positive.state) & self.engine.remembers(self.positive.next_state)
        counts = kept.sum(1)
        have = np.flatnonzero(counts)
        extra = round(self.config.option_batch * POSITIVE_SHARE) if len(have) else 0
        extra = min(extra, self.config.option_batch - 1)  # priorities need one drawn by them
        indices, weights = self.replay.sample(self.config.option_batch - extra, self.rng)
        batch = self.replay.data.at(indices)
        if extra:
            options = have[self.rng.integers(len(have), size=extra)]
            slots = (self.rng.random(extra) * counts[options]).astype(np.int64)
            if self.engine.memory is not None:  # of those that it remembers
                slots = (np.cumsum(kept, axis=1)[options] <= slots[:, None]).sum(1)
            batch = Lessons.joined([batch, self.positive.at((options, slots))])
            weights = np.concatenate([weights, np.ones(extra, np.float32)])
        return batch, indices, weights

    def _update(self) -> dict[str, float]:
        batch, indices, weights = self._batch()
        inside, reached = self._judged(batch)
        owner = batch.option[:, None] == np.arange(self.options)
        terminal = reached | batch.terminated[:, None]
        learns = ~inside & owner if self.running_only else ~inside
        ahead = self.tensor(batch.steps).float()[:, None]

        states, next_states = batch.state.astype(np.int64), batch.next_state.astype(np.int64)
        values, next_online, next_target = self._values(states, next_states)
        with torch.no_grad():
            goal = double_q_targets(
                self.tensor(reached) * self.config.option_gamma ** (ahead - 1),
                self.tensor(terminal),
                next_online,
                next_target,
                self.config.option_gamma**ahead,
                bounded=self.config.bounded_values,
            )
        actions = self.tensor(batch.action.astype(np.int64))[:, None, None].expand(-1, self.options, 1)
        error = values.gather(2, actions).squeeze(2) - goal
        error = error * self.tensor(learns)
        huber = torch.nn.functional.huber_loss(error, torch.zeros_like(error), reduction="none")
        loss = (huber.sum(1) * self.tensor(weights)).mean()
        self._step(loss, huber.detach())
        largest = error.detach().abs().amax(1).cpu().numpy()
        self.replay.set_priorities(indices, largest[: len(indices)])
        return {"option_loss": float(loss.detach())}

    def _values(self, states: NDArray[np.int64], next_states: NDArray[np.int64]) -> tuple[Tensor, Tensor, Tensor]:
        """The online network in states (with gradients) and in next states, the target in these; (n, O, A) each."""
        if self.pixels:
            now, later = self.pixels.of(np.concatenate([states, next_states])).split(len(states))
            with torch.no_grad():
                next_values = self.online(later), self.target(later)
            return self.online(now), *next_values
        # A batch has few distinct states, late in training 40 of 256: the networks see each once.
        distinct, places = np.unique(np.concatenate([states, next_states]), return_inverse=True)
        now, later = self.tensor(places).split(len(states))
        values, target = apply_all_to_states((self.online, self.target), self.engine, distinct)
        # index_select, not indexing, whose gradient takes several times as long.
        next_online, next_target = (outputs.detach().index_select(0, later) for outputs in (values, target))
        return values.index_select(0, now), next_online, next_target

    def _step(self, loss: Tensor, errors: Tensor) -> None:
        """Follow the loss's gradient; ``errors`` (n, O) tell the options where it is NaN or Inf."""
        finite = bool(torch.isfinite(loss))
        owner = "the options" if finite else f"options {(~errors.isfinite()).any(0).nonzero().flatten().tolist()}"
        where = f"in the batch of update {self.updates}, step {self.steps}"
        descend(loss, self.online, self.optimiser, owner, where, GRADIENT_NORM)
        self.updates += 1
        if rate := target_rate(self.updates, self.config.target_interval):
            follow(self.target.parameters(), self.online.parameters(), rate)

    def weights(self) -> dict[str, Tensor]:
        return {f"online.{name}": value for name, value in self.online.state_dict().items()}

    def load_weights(self, weights: Mapping[str, Tensor]) -> None:
        weights = below("online.", weights)
        load_into(self.online, weights, "options.safetensors")
        self.target.load_state_dict(weights)


class LightPolicies:
    """Greedy policies of saved options that share one network (Spec D8)."""

    def __init__(self, saved: SavedOptions):
        config, weights = saved.config, below("online.", saved.weights)
        actions = saved.actions("online.heads.weight", saved.count)
        embedding = config["embedding"]
        standard = standard_in(weights, saved.shape)
        make = partial(LightQNetwork, saved.shape, saved.count, actions, standard, embedding)
        custom = embedding not in (AUTO, *NETWORKS)
        self.network = load_fitting(make, weights, "options.safetensors", custom=custom)

    def __call__(self, option: int) -> Callable[[Observations], int]:
        """Start an execution."""
        return partial(self._act, option)

    @torch.no_grad()
    def _act(self, option: int, observation: Observations) -> int:
        values = self.network(torch.from_numpy(np.ascontiguousarray(observation[None])))[0, option]
        return int(values.argmax())
