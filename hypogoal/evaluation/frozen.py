"""Trained agents play on, and nothing is learned: the first n episodes of every environment (Spec H2, H6, F5).

Episodes differ in length, and the failed ones are the longest. Of all episodes that end within a number of steps too
many are short, so every environment plays the same number of episodes, however long they take.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hypogoal.evaluation.curves import scores
from hypogoal.options.choosers import Chooser, Offered, Outcome
from hypogoal.options.loop import NONE, OptionLoop
from hypogoal.options.parts import Ids
from hypogoal.options.recording import Recorder

ENVIRONMENTS, EPISODES = 64, 8  # of an agent on its own layout: 512 episodes,
STEPS = 1_000  # or more, where so many steps of an environment hold more of the longest ones


@dataclass(frozen=True)
class Choices:
    """D decisions: the states int64 (D,), the options chosen int64 (D,), and those offered, bool (D, O)."""

    states: NDArray[np.int64]
    options: NDArray[np.int64]
    offered: NDArray[np.bool_]


@dataclass(frozen=True)
class Play:
    """The first n episodes of each of E environments: their steps int64 (E, n) and success bool (E, n), and choices."""

    length: NDArray[np.int64]
    succeeded: NDArray[np.bool_]
    choices: Choices

    def scores(self, shortest: float | NDArray[np.float64] | None) -> dict[str, NDArray[np.float64]]:
        """See :func:`scores`."""
        return scores(self.succeeded, self.length, shortest)


class _Listener(Chooser):
    """Passes a chooser's decisions on and keeps them, with the environments they were made in."""

    def __init__(self, chooser: Chooser):
        self.chooser = chooser
        self.decisions: list[tuple[Ids, Ids, Ids, Offered]] = []

    def choose(self, environments: Ids, ids: Ids, offered: Offered) -> Ids:
        chosen = self.chooser.choose(environments, ids, offered)
        self.decisions.append((environments.copy(), ids.copy(), chosen.copy(), offered.copy()))
        return chosen

    def record(self, outcome: Outcome) -> None:
        self.chooser.record(outcome)

    def begin_anew(self) -> None:
        self.chooser.begin_anew()


class Always(Chooser):
    """Chooses one option, whatever is offered."""

    def __init__(self, option: int):
        self.option = option

    def choose(self, environments: Ids, ids: Ids, offered: Offered) -> Ids:
        return np.full(len(ids), self.option)


def play(loop: OptionLoop, chooser: Chooser, episodes: int = 0) -> Play:
    """So many episodes in each environment, begun anew; options are greedy and choices are drawn as in training.

    By default as many as the cap alone decides: what comes of them must not.
    """
    episodes = episodes or max(EPISODES, STEPS // loop.engine.max_steps)
    listener = _Listener(chooser)
    begin_anew(loop, listener)
    try:
        return _first_episodes(loop, listener, episodes)
    finally:
        loop.chooser = chooser


def _first_episodes(loop: OptionLoop, listener: _Listener, episodes: int) -> Play:
    environments = loop.engine.count
    ended = np.zeros(environments, dtype=np.int64)
    length, succeeded = np.zeros((2, environments, episodes), dtype=np.int64)
    decisions: list[tuple[Ids, Ids, Offered]] = []
    while ended.min() < episodes:
        loop.advance(learning=False)
        for places, states, options, offered in listener.decisions:
            counts = ended[places] < episodes
            decisions.append((states[counts], options[counts], offered[counts]))
        listener.decisions.clear()
        over = np.flatnonzero(loop.engine.elapsed == 0)
        for place, (_, steps, _, _, success) in zip(over, loop.recorder.episodes, strict=True):
            if ended[place] < episodes:
                length[place, ended[place]], succeeded[place, ended[place]] = steps, success
                ended[place] += 1
        loop.recorder.episodes.clear()
    choices = Choices(*(np.concatenate(column) for column in zip(*decisions, strict=True)))
    return Play(length, succeeded > 0, choices)


def begin_anew(loop: OptionLoop, chooser: Chooser) -> None:
    """Every environment at the beginning of an episode; of earlier episodes, options and choosers nothing is left."""
    chooser.begin_anew()
    loop.chooser, loop.recorder = chooser, Recorder(loop.recorder.options, loop.engine, loop.recorder.window)
    loop.option[:] = NONE
    loop.engine.reset()
