"""Options distilled from plans: one network learns the shortest ways in many layouts, and needs no engine afterwards.

Double DQN learns values, of which neighbours differ by less than its error. Where an engine knows what follows on each
action, the best actions themselves are known: in each layout the members judge every state once, and breadth-first
search has each option's best actions there. The network learns these by heart, as a classifier, and so the rule behind
them. It learns in ``train-options`` alone; from then on its options are played as they are.

Measured: docs/results/distilled.md.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from hypogoal.core.seeding import seed_for
from hypogoal.learners.double_dqn import descend
from hypogoal.options.choosers import Ids
from hypogoal.options.config import OptionConfig
from hypogoal.options.exploration import Exploration
from hypogoal.options.learner import Learner, Transitions
from hypogoal.options.light import GRADIENT_NORM, LightLearner
from hypogoal.options.networks import LightQNetwork, apply_to_states
from hypogoal.options.planned import FAR, distances, places_of, plan_of

EPSILON = 0.3  # share of random actions in the play that states are taken from
UNIFORM = 0.3  # share of a batch from all planned states; the others were visited
LOWEST_RATE = 0.05  # of Adam's step size, at the end of its fall
AT_ONCE = 8  # layouts planned together
UNKNOWN, FINAL, PLANNED, VISITED = range(4)  # what a state is


class DistilledLearner(LightLearner):
    """A light network that learns the best actions of plans; arguments as of :class:`Learner`.

    While it learns, planned options play, with random actions in between. A layout is planned when it is first played.

    Attributes:
        actions: those of the engine's actions that plans know, int64 (A,).
        best: uint (N, O), each option's best actions in each state, bit a for action a; 0 where no way leads to its
            sub-goal.
        kind: uint8 (N,), what each state is.

    Raises:
        UserError: nobody knows what follows in this engine, or options do not end at a single positive prediction.
    """

    ONCE = True
    NEEDS: ClassVar[Mapping[str, Any]] = {}
    CHANGING = (*Learner.CHANGING, "online", "optimiser", "best", "kind", "steps", "updates", "_due")

    def build(self, config: OptionConfig, seed: int) -> None:
        self.actions = plan_of(self.engine, self.terminations, config, self.engine.ids[:1]).actions
        self.exploration = Exploration(config, self.engine.count, len(self.actions), self.rng)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed_for(seed, "option-weights"))
            shape, standard = self.engine.observation_shape, self.engine.standard
            network = LightQNetwork(shape, self.options, self.engine.n_actions, standard, config.embedding)
        self.online = self.target = network.to(self.device)  # best actions are known: no target moves
        self.optimiser = torch.optim.Adam(self.online.parameters(), lr=config.option_learning_rate, fused=True)
        self.best = np.zeros((0, self.options), np.min_scalar_type(2**self.engine.n_actions - 1))
        self.kind = np.zeros(0, np.uint8)
        self.steps = self.updates = self._due = 0
        self.loaded = False

    @staticmethod
    def reach(config: OptionConfig, options: int) -> int:
        return 0

    def act(self, ids: Ids, options: Ids, age: Ids, *, explore: bool = True) -> Ids:
        """While it learns, the plan's with random actions in between; afterwards the network's."""
        if self.loaded or not explore:
            return self.greedy(ids, options, age)
        self._plan(ids)
        best = self.best[ids, options]
        first = np.log2(np.maximum(best & -best.astype(np.int64), 1)).astype(np.int64)  # the lowest bit
        chosen = self.exploration.mix(np.searchsorted(self.actions, first), np.full(len(ids), EPSILON), age)
        return self.actions[chosen]

    def observe(self, moved: Transitions) -> None:
        """Remember that these states were visited."""
        reached = self.terminations.of_running(moved.next_ids, moved.options)
        np.add.at(self.positives, moved.options[reached], 1)
        self.count(moved.options)
        if not self.loaded:
            self.kind[moved.ids] = VISITED
            self.steps += len(moved.ids)
            self._due += len(moved.ids)

    def learn(self) -> dict[str, float]:
        numbers: dict[str, float] = {}
        while self._due >= self.config.update_interval:
            self._due -= self.config.update_interval
            numbers = self._update()
        return numbers

    def _plan(self, ids: Ids) -> None:
        """Plan the layouts of those states that are in no plan yet."""
        self._grow()
        new = np.unique(ids[self.kind[ids] == UNKNOWN])
        for start in range(0, len(new), AT_ONCE):
            plan = plan_of(self.engine, self.terminations, self.config, new[start : start + AT_ONCE])
            after = places_of(plan, self.engine)[plan.following]
            ahead = distances(self.terminations.of(plan.ids), after, plan.final)[after]  # (n, A, O)
            nearest = ahead.min(axis=1, keepdims=True)
            bits = 1 << self.actions[:, None]
            self._grow()
            self.best[plan.ids] = np.where((ahead == nearest) & (nearest < FAR), bits, 0).sum(axis=1)
            fresh = self.kind[plan.ids] == UNKNOWN
            self.kind[plan.ids[fresh]] = np.where(plan.final, FINAL, PLANNED)[fresh]

    def _grow(self) -> None:
        more = self.engine.n_states - len(self.kind)
        if more > 0:
            self.best = np.concatenate([self.best, np.zeros((more, self.options), self.best.dtype)])
            self.kind = np.concatenate([self.kind, np.full(more, UNKNOWN, np.uint8)])

    def _update(self) -> dict[str, float]:
        """A step down the loss: -log of the probability of all best actions together, the mean over options."""
        some = round(UNIFORM * self.config.option_batch)
        visited, planned = np.flatnonzero(self.kind == VISITED), np.flatnonzero(self.kind >= PLANNED)
        states = np.concatenate(
            [
                visited[self.rng.integers(len(visited), size=self.config.option_batch - some)],
                planned[self.rng.integers(len(planned), size=some)],
            ]
        )
        best = (self.best[states][:, :, None] >> np.arange(self.engine.n_actions) & 1).astype(np.bool_)
        leads = best.any(axis=2)
        best[~leads] = True  # where no way leads to a sub-goal nothing is wrong
        scores = apply_to_states(self.online, self.engine, states).log_softmax(2)
        wrong = scores.masked_fill(self.tensor(~best), -torch.inf).logsumexp(2).neg()
        loss = wrong.sum() / max(1, int(leads.sum()))
        fallen = min(1.0, self.steps / self.config.rate_steps) if self.config.rate_steps else 0.0
        for group in self.optimiser.param_groups:
            group["lr"] = self.config.option_learning_rate * (1 - (1 - LOWEST_RATE) * fallen)
        where = f"in the batch of update {self.updates}, step {self.steps}"
        descend(loss, self.online, self.optimiser, "the options", where, GRADIENT_NORM)
        self.updates += 1
        return {"option_loss": float(loss.detach()), "planned_states": float(len(planned))}

    def load(self, state: Mapping[str, Tensor]) -> None:
        """From here on its options are played and learn no more."""
        super().load(state)
        self.loaded = True
