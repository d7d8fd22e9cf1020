"""Trained agents play on, and nothing is learned: the first n episodes of every environment.

Episodes differ in length, and the failed ones are the longest. Of all episodes that end within a number of steps too
many are short, so every environment plays the same number of episodes, however long they take.
"""

from dataclasses import dataclass

import numpy as np

from hypogoal.core.arrays import Bools, Columns, Doubles, Ints
from hypogoal.core.seeding import rng_for
from hypogoal.evaluation.curves import scores
from hypogoal.options.choosers import Chooser, Offered, RandomChooser
from hypogoal.options.loop import NONE, OptionLoop

ENVIRONMENTS, EPISODES = 64, 8  # of an agent on its own layout: 512 episodes,
STEPS = 1_000  # or more, where so many steps of an environment hold more of the longest ones


@dataclass(frozen=True)
class Choices(Columns):
    """D decisions: the states int64 (D,), the options chosen int64 (D,), and those offered, bool (D, O)."""

    states: Ints
    options: Ints
    offered: Bools


@dataclass(frozen=True)
class Play:
    """The first n episodes of each of E environments: their steps int64 (E, n) and success bool (E, n), and choices."""

    length: Ints
    succeeded: Bools
    choices: Choices

    def scores(self, shortest: float | Doubles | None) -> dict[str, Doubles]:
        """See :func:`scores`; and the ``length``."""
        return scores(self.succeeded, self.length, shortest) | {"length": self.length.astype(float)}


class Always(Chooser):
    """Chooses one option, whatever is offered."""

    def __init__(self, option: int):
        self.option = option

    def choose(
        self,
        environments: Ints,
        ids: Ints,
        offered: Offered,
    ) -> Ints:
        return np.full(len(ids), self.option)


def play_both(
    loop: OptionLoop,
    seed: int,
    episodes: int = 0,
) -> tuple[Play, Play]:
    """The agent itself, and uniform-random choice among its options, see :func:`play`."""
    own = play(loop, loop.chooser, episodes)
    return own, play(loop, RandomChooser(rng_for(seed, "uniform-choice")), episodes)


def play(
    loop: OptionLoop,
    chooser: Chooser,
    episodes: int = 0,
) -> Play:
    """So many episodes in each environment, begun anew; options are greedy and choices are drawn as in training.

    By default as many as the cap alone decides: what comes of them must not.
    """
    engine = loop.engine
    episodes = episodes or max(EPISODES, STEPS // engine.max_steps)
    loop.begin_anew(chooser)
    ended = np.zeros(engine.count, int)
    length, succeeded = np.zeros((2, engine.count, episodes), int)
    decisions = []
    while ended.min() < episodes:
        free = np.flatnonzero((loop.option == NONE) & (ended < episodes))
        ids = engine.ids[free]
        offered = loop.offered(ids)
        moved = loop.advance(learning=False)
        decisions.append(Choices(ids, moved.options[free], offered))
        over = np.flatnonzero(engine.elapsed == 0)
        for place, episode in zip(over, loop.recorder.episodes.rows, strict=True):
            if ended[place] < episodes:
                length[place, ended[place]] = episode.length
                succeeded[place, ended[place]] = episode.succeeded
                ended[place] += 1
        loop.recorder.episodes.rows.clear()
    return Play(length, succeeded > 0, Choices.joined(decisions))
