"""Practice that begins where options got: data for options that hardly ever see their sub-goal (ours).

A late sub-goal, behind a door behind a key, is out of reach of an execution of ten random steps from most states. So in
some environments every execution begins in a state in which the sub-goal of some option, by its own classifier, has
just been reached, and the option that runs is drawn by how rarely its own sub-goal has been. No true label enters, and
no reward: these environments are no part of the task, their episodes and choices count nowhere.
"""

import numpy as np
from numpy.typing import NDArray

from hypogoal.core.checkpoints import Resumable
from hypogoal.core.errors import UserError
from hypogoal.core.seeding import rng_for
from hypogoal.domains.base import Engine
from hypogoal.options.choosers import Ids, Offered
from hypogoal.options.config import OptionConfig
from hypogoal.options.termination import Terminations

KEPT = 512  # states in which an option's sub-goal was reached, the newest


class Practice(Resumable):
    """Where executions begin in the last ``share`` of E environments, bool (E,) ``where``, and which options run there.

    ``seed`` is of draws. A ``UserError`` where the engine cannot begin in any state.

    Attributes:
        seen: int64 (O,), how often each option's sub-goal was reached, whichever option ran.
    """

    CHANGING = ("rng", "states", "starts", "near", "seen", "next")

    def __init__(self, engine: Engine, terminations: Terminations, config: OptionConfig, seed: int):
        self.engine, self.terminations, self.config = engine, terminations, config
        self.where = np.arange(engine.count) >= engine.count - round(config.practice * engine.count)
        self.rng = rng_for(seed, "practice")
        self.states, self.near = np.zeros((2, terminations.options, KEPT), dtype=np.int64)
        self.seen, self.starts = np.zeros((2, terminations.options), dtype=np.int64)
        self.next = np.full(engine.count, -1, dtype=np.int64)

    def see(self, ids: Ids, next_ids: Ids, terminated: NDArray[np.bool_], began: Ids) -> None:
        """A step of every environment, (E,) each."""
        reached = self.terminations.of(next_ids) & ~self.terminations.of(ids)
        for row, option in zip(*reached.nonzero(), strict=True):
            self.near[option, self.seen[option] % KEPT] = began[row]
            self.seen[option] += 1
            if not terminated[row]:
                self.states[option, self.starts[option] % KEPT] = next_ids[row]
                self.starts[option] += 1

    def choose(self, numbers: Ids, offered: Offered) -> Ids:
        """An option for each of n executions, int64 (n,), among those offered, bool (n, O)."""
        planned = self.next[numbers]
        fine = (planned >= 0) & offered[np.arange(len(offered)), planned]
        return np.where(fine, planned, self._draw(offered))

    def _draw(self, offered: Offered) -> Ids:
        weights = (1.0 + self.seen) ** -self.config.practice_rare * offered
        sums = weights.cumsum(axis=1)
        drawn: Ids = (sums <= self.rng.random(len(offered))[:, None] * sums[:, -1:]).sum(axis=1)
        return drawn

    def begin(self, numbers: Ids) -> None:
        """Begin anew in these environments (n,)."""
        have = np.flatnonzero(self.starts)
        if not len(have) or not len(numbers):
            return
        n = len(numbers)
        option = self.next[numbers] = self._draw(np.ones((n, len(self.seen)), dtype=np.bool_))
        weights = (1.0 + self.seen[have]) ** -self.config.practice_begin
        others = have[self.rng.choice(len(have), n, p=weights / weights.sum())]
        places = (self.rng.random(n) * np.minimum(self.starts[others], KEPT)).astype(np.int64)
        back = (self.rng.random(n) * np.minimum(self.seen[option], KEPT)).astype(np.int64)
        again = (self.seen[option] > 0) & (self.rng.random(n) < self.config.practice_near)
        begin = np.where(again, self.near[option, back], self.states[others, places])
        self.engine.begin_in(numbers, begin)
