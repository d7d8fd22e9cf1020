r"""DoorKey: options distilled from the plans of 300 layouts, tried on 100 that nobody played; ten minutes of a core.

Double DQN learns values, of which neighbours differ by less than its error. Where an engine knows what follows on each
action, the best actions themselves are known: in each layout the members judge every state once, and breadth-first
search has each option's best actions there. One network learns these by heart, as a classifier, and so the rule behind
them. In a new layout its options need no model and no training:

    hypogoal collect doorkey --out runs/far/data.h5
    hypogoal train-ensemble runs/far/data.h5 --out runs/far/ensemble
    hypogoal train-options runs/far/ensemble --out runs/far/options \
        --set network=examples.distilled:Learner --set embedding=examples.distilled:Deep --set layouts=1000-1299 \
        --set environments=32 --set update_interval=32 --set steps=204800 --set option_learning_rate=2e-3
    hypogoal evaluate runs/far --layouts 6000-6099 --trust

Then `python -m examples.distilled` plays each option once in one more layout. An agent over them learns by

    hypogoal train-meta runs/far/ensemble --options runs/far/options --out runs/far/meta \
        --set network=examples.distilled:Learner --set embedding=examples.distilled:Deep

Agents that learn in many layouts need `--set meta_network=examples.distilled:Grid`, too, and permission for it. `Grid`
in place of `Deep` takes a third of the time and carries over less. Measured: docs/results/options.md and agents.md.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor, nn

import hypogoal
from hypogoal.core.arrays import Ints, tensor
from hypogoal.meta.config import PlayConfig
from hypogoal.options.config import OptionConfig, OwnLearnerConfig
from hypogoal.options.double_dqn import DoubleDQN, descend
from hypogoal.options.exploration import Exploration
from hypogoal.options.learner import Learner as AnyLearner
from hypogoal.options.learner import Transitions
from hypogoal.options.light import GRADIENT_NORM, LightLearner
from hypogoal.options.networks import apply_to_states
from hypogoal.options.planned import FAR, distances, places_of, plan_of

CELL = 8  # pixels
EPSILON = 0.3  # share of random actions in the play that states are taken from
UNIFORM = 0.3  # share of a batch from all planned states; the others were visited
LOWEST_RATE = 0.05  # of Adam's step size, at the end of its fall
AT_ONCE = 8  # layouts planned together
UNKNOWN, FINAL, PLANNED, VISITED = range(4)  # what a state is


class Grid(nn.Module):
    """Features of all cells: a convolution of a cell each, then residual ones of 3 x 3, the same rule in all places.

    No BatchNorm: a state's value must not depend on its batch.
    """

    CHANNELS, LAYERS = 16, 2

    def __init__(self, observation_shape: tuple[int, ...]):
        super().__init__()
        self.cells = nn.Conv2d(observation_shape[-1], self.CHANNELS, CELL, stride=CELL)
        self.layers = nn.ModuleList(nn.Conv2d(self.CHANNELS, self.CHANNELS, 3, padding=1) for _ in range(self.LAYERS))

    def forward(self, pictures: Tensor) -> Tensor:
        """float32 (N, C, H, W) in 0..1 -> float32 (N, F)."""
        return self.across(torch.relu(self.cells(pictures))).flatten(1)

    def across(self, grid: Tensor) -> Tensor:
        """The residual convolutions: float32 (N, channels, rows, columns), in and out."""
        for layer in self.layers:
            grid = grid + torch.relu(layer(grid))
        return grid


class Deep(Grid):
    """More of them, over cells with their places, and what ``HEADS`` queries read there, besides the mean cell.

    A query's weights over cells, a softmax, ask where something is.
    """

    CHANNELS, LAYERS, HEADS, CONTRAST = 24, 6, 4, 10.0

    def __init__(self, observation_shape: tuple[int, ...]):
        super().__init__(observation_shape)
        rows, columns = observation_shape[0] // CELL, observation_shape[1] // CELL
        self.place = nn.Parameter(torch.zeros(1, self.CHANNELS, rows, columns))
        self.query = nn.Linear(self.CHANNELS, self.HEADS)
        # With the usual small weights all cells look alike at first, and learning stands still for 200 updates.
        with torch.no_grad():
            self.cells.weight.mul_(self.CONTRAST)
            self.query.weight.normal_()

    def forward(self, pictures: Tensor) -> Tensor:
        """float32 (N, C, H, W) in 0..1 -> float32 (N, F)."""
        grid = self.across(torch.relu(self.cells(pictures)) + self.place)
        cells = grid.flatten(2).transpose(1, 2)
        weights = self.query(cells).softmax(1)
        read = weights.transpose(1, 2) @ cells
        return torch.cat([read.flatten(1), cells.mean(1)], 1)


class Learner(LightLearner):
    """A light network that learns the best actions of plans.

    While it learns, plans play, with random actions in between; a layout is planned when it is first played. Loaded
    options are played as they are. Adam's step size falls to a twentieth over the stage's ``steps``.

    Attributes:
        actions: those of the engine's actions that plans know, int64 (A,).
        best: uint (N, O), each option's best actions in each state, bit a for action a; 0 where no way leads to its
            sub-goal.
        kind: uint8 (N,), what each state is.

    Raises:
        UserError: nobody knows what follows in this engine, or options do not end at a single positive prediction.
    """

    CHANGING = (*AnyLearner.CHANGING, "networks", "best", "kind", "steps", "due")
    settings: OwnLearnerConfig

    def build(self, config: OptionConfig, seed: int) -> None:
        assert isinstance(config, PlayConfig)
        self.settings = settings = config.part(OwnLearnerConfig)
        self.last = config.steps
        self.actions = plan_of(self.engine, self.terminations, config, self.engine.ids[:1]).actions
        self.exploration = Exploration(settings, self.engine.count, len(self.actions), self.rng)
        self.networks = DoubleDQN(self.network(settings, seed), settings, GRADIENT_NORM)  # the target's is not used
        self.best = np.zeros((0, self.options), np.min_scalar_type(2**self.engine.n_actions - 1))
        self.kind = np.zeros(0, np.uint8)
        self.steps = self.due = 0
        self.loaded = False

    @staticmethod
    def reach(config: OptionConfig, options: int) -> int:
        return 0

    def act(self, ids: Ints, options: Ints, age: Ints, *, explore: bool = True) -> Ints:
        """While it learns, the plan's with random actions in between; afterwards the network's."""
        if self.loaded or not explore:
            return self.greedy(ids, options, age)
        self._plan(ids)
        best = self.best[ids, options].astype(np.int64)
        lowest_bit = np.maximum(best & -best, 1)
        first = np.searchsorted(self.actions, np.log2(lowest_bit).astype(np.int64))
        chosen = self.exploration.mix(first, np.full(len(ids), EPSILON), age)
        return self.actions[chosen]

    def observe(self, moved: Transitions) -> None:
        """Remember that these states were visited."""
        reached = self.terminations.of_running(moved.next_ids, moved.options)
        np.add.at(self.positives, moved.options[reached], 1)
        self.count(moved.options)
        if self.loaded:
            return
        self.kind[moved.ids] = VISITED
        self.steps += len(moved.ids)
        self.due += len(moved.ids)

    def learn(self) -> dict[str, float]:
        numbers: dict[str, float] = {}
        while self.due >= self.settings.update_interval:
            self.due -= self.settings.update_interval
            numbers = self._update()
        return numbers

    def load(self, state: Mapping[str, Tensor]) -> None:
        """From here on its options are played and learn no more."""
        super().load(state)
        self.loaded = True

    def _plan(self, ids: Ints) -> None:
        """Plan the layouts of those states that are in no plan yet."""
        self._grow()
        new = np.unique(ids[self.kind[ids] == UNKNOWN])
        for start in range(0, len(new), AT_ONCE):
            plan = plan_of(self.engine, self.terminations, self.config, new[start : start + AT_ONCE])
            after = places_of(plan, self.engine)[plan.following]
            ahead = distances(self.terminations.of(plan.ids), after, plan.final)[after]  # (n, A, O)
            nearest = ahead.min(axis=1, keepdims=True)
            is_best = (ahead == nearest) & (nearest < FAR)
            bits = 1 << self.actions[:, None]
            self._grow()
            self.best[plan.ids] = np.where(is_best, bits, 0).sum(axis=1)
            fresh = self.kind[plan.ids] == UNKNOWN
            self.kind[plan.ids[fresh]] = np.where(plan.final, FINAL, PLANNED)[fresh]

    def _grow(self) -> None:
        """Room for the engine's new states."""
        more = self.engine.n_states - len(self.kind)
        if more > 0:
            self.best = np.concatenate([self.best, np.zeros((more, self.options), self.best.dtype)])
            self.kind = np.concatenate([self.kind, np.full(more, UNKNOWN, np.uint8)])

    def _update(self) -> dict[str, float]:
        """A step down the loss: -log of the probability of all best actions together, the mean over options."""
        states = self._batch()
        best = (self.best[states][:, :, None] >> np.arange(self.engine.n_actions) & 1).astype(np.bool_)
        leads = best.any(axis=2)
        best[~leads] = True  # where no way leads to a sub-goal nothing is wrong
        networks = self.networks
        scores = apply_to_states(networks.online, self.engine, states, self.device).log_softmax(2)
        of_best = scores.masked_fill(tensor(~best, self.device), -torch.inf).logsumexp(2)
        loss = of_best.neg().sum() / max(1, int(leads.sum()))
        fallen = min(1.0, self.steps / self.last)
        networks.optimiser.lr = self.settings.option_learning_rate * (1 - (1 - LOWEST_RATE) * fallen)
        where = f"in the batch of update {networks.updates}, step {self.steps}"
        descend(loss, networks.optimiser, "the options", where, GRADIENT_NORM)
        networks.updates += 1
        planned = int((self.kind >= PLANNED).sum())
        return {"option_loss": float(loss.detach()), "planned_states": float(planned)}

    def _batch(self) -> Ints:
        """States int64 (n,), a share of them visited, the others out of all plans."""
        some = round(UNIFORM * self.settings.option_batch)
        visited, planned = np.flatnonzero(self.kind == VISITED), np.flatnonzero(self.kind >= PLANNED)
        of_play = visited[self.rng.integers(len(visited), size=self.settings.option_batch - some)]
        of_plans = planned[self.rng.integers(len(planned), size=some)]
        return np.concatenate([of_play, of_plans])


def play(layout_seed: int) -> list[str]:
    """Each option once, without an engine."""
    options = hypogoal.load_options("runs/far/options")
    env = hypogoal.OptionEnv(options.make_env(layout_seed=layout_seed), options)
    lines = []
    for option in range(options.count):
        env.reset(seed=0)
        info = env.step(option)[4]
        end = "its member is positive" if info["reached"] else "its time is up, or the episode over"
        lines.append(f"{info['option']}: after {info['duration']} steps {end}")
    return lines


if __name__ == "__main__":
    print("\n".join(play(6100)))
