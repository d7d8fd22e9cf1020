"""Play of trained agents that learn nothing from it: the first n episodes of every environment.

Episodes differ in length, and failed episodes are the longest. Among the episodes that end within a number of steps,
too many are short. So every environment plays n episodes, however long they take.
"""

from dataclasses import dataclass

import numpy as np

from hypogoal.core.arrays import Bools, Columns, Doubles, Ints
from hypogoal.core.seeding import rng_for
from hypogoal.evaluation.curves import scores
from hypogoal.options.choosers import Chooser, Offered, RandomChooser
from hypogoal.options.loop import NONE, OptionLoop

ENVIRONMENTS, EPISODES = 64, 8  # of an agent on its own layout, 512 episodes in all,
STEPS = 1_000  # or more, if so many steps of one environment hold more of the longest episodes


@dataclass(frozen=True)
class Choices(Columns):
    """D decisions: the states, int64 (D,), the options chosen, int64 (D,), and the options offered, bool (D, O)."""

    states: Ints
    options: Ints
    offered: Bools


@dataclass(frozen=True)
class Play:
    """The first n episodes of each of E environments, and the decisions in them.

    ``length`` int64 (E, n) is in steps, ``succeeded`` is bool (E, n).
    """

    length: Ints
    succeeded: Bools
    choices: Choices

    def scores(self, shortest: float | Doubles | None) -> dict[str, Doubles]:
        """Return the scores of :func:`curves.scores`, and ``length``, each (E, n)."""
        return scores(self.succeeded, self.length, shortest) | {"length": self.length.astype(float)}


class Always(Chooser):
    """A chooser that chooses one option, whatever is offered."""

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
    """Play the agent itself, and uniform-random choice among its options. Return both, see :func:`play`."""
    own = play(loop, loop.chooser, episodes)
    return own, play(loop, RandomChooser(rng_for(seed, "uniform-choice")), episodes)


def play(
    loop: OptionLoop,
    chooser: Chooser,
    episodes: int = 0,
) -> Play:
    """Play ``episodes`` new episodes in each environment. Options are greedy, and choices are drawn as in training.

    The default number of episodes depends on the engine's cap alone, because a number that depends on the agent would
    favour some agents.
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
