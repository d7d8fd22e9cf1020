"""Spec H2: frozen play is measured without bias, on agents whose true success, lengths and choices are forced."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from corridor import Corridor
from numpy.typing import NDArray
from option_loops import Scripted, loop_of
from planted import harsh, planted
from scipy.stats import binom

from hypogoal.domains.doorkey.engine import DoorKeyEngine
from hypogoal.evaluation.frozen import play, play_both
from hypogoal.meta.config import GAMMA, TrainMetaConfig
from hypogoal.options.choosers import Chooser, RandomChooser
from hypogoal.options.loop import OptionLoop
from hypogoal.options.planned import PlannedLearner
from hypogoal.options.recording import Recorder
from hypogoal.options.termination import TerminationRule, Terminations, oracle_terminations

LAYOUT, DONE = 70010, 6  # 'done' does nothing


class Forgetful(PlannedLearner):
    """In a share of the episodes it plays 'done' until the cap; else it follows the plan."""

    failures, rng = 0.0, np.random.default_rng(0)
    failing: NDArray[np.bool_]

    def act(
        self, ids: NDArray[np.int64], options: NDArray[np.int64], age: NDArray[np.int64], *, explore: bool = True
    ) -> NDArray[np.int64]:
        begins = self.engine.elapsed == 0
        if begins.all():
            self.failing = np.zeros(len(ids), np.bool_)
        self.failing[begins] = self.rng.random(begins.sum()) < self.failures
        return np.where(self.failing, DONE, super().act(ids, options, age, explore=explore))


def forced_loop(failures: float, cap: int, environments: int) -> OptionLoop:
    """An agent with the true sub-goals that solves a forced share of its episodes, each in the fewest steps."""
    engine = DoorKeyEngine(LAYOUT, environments)
    engine.max_steps = cap
    config = TrainMetaConfig.of(network="planned", termination="oracle")
    terminations = oracle_terminations(engine, (4,))  # go-to-goal alone: the shortest path
    learner = Forgetful(engine, terminations, config, seed=0)
    learner.failures, learner.rng = failures, np.random.default_rng(cap)
    chooser = RandomChooser(np.random.default_rng(0))
    return OptionLoop(engine, terminations, learner, chooser, Recorder(1, engine), config, GAMMA)


@pytest.mark.parametrize(("share", "cap"), [(0.9, 57), (0.7, 500), (0.3, 57)])
def test_forced_shares_of_failures_are_measured(share: float, cap: int) -> None:
    """Success, near and length lie within the binomial's interval of their true values (three in a million miss)."""
    loop = forced_loop(1 - share, cap, 64)
    shortest = loop.engine.shortest_path()
    assert shortest is not None and 1.5 * shortest < cap
    episodes = play(loop, loop.chooser, 4)
    count, scores = episodes.length.size, episodes.scores(shortest)
    assert episodes.length.shape == (64, 4)
    least, most = binom.interval(1 - 3e-6, count, share)
    assert least <= episodes.succeeded.sum() <= most
    assert np.array_equal(scores["success"], scores["near"])
    solved = int(episodes.succeeded.sum())
    assert episodes.length.sum() == solved * shortest + (count - solved) * cap


def test_an_environment_that_ends_early_adds_no_episodes() -> None:
    """The first n of each, also where one environment needs as long for one episode as another for seven."""
    loop = forced_loop(0.5, 500, 16)
    episodes = play(loop, loop.chooser, 1)
    assert episodes.length.shape == (16, 1)
    assert set(episodes.length.ravel().tolist()) == {loop.engine.shortest_path(), 500}


class Noting(Chooser):
    """Takes the first option offered and notes where it was asked."""

    def __init__(self) -> None:
        self.asked: list[NDArray[np.int64]] = []

    def choose(self, environments: Any, ids: NDArray[np.int64], offered: NDArray[np.bool_]) -> NDArray[np.int64]:
        self.asked.append(ids.copy())
        return offered.argmax(1)


def test_nothing_of_an_earlier_chooser_is_left() -> None:
    """The second one is asked first where episodes begin, in every environment, and plays as if it were alone."""

    def loop_at(seed: int) -> OptionLoop:
        engine, config = harsh(220, 16), TrainMetaConfig.of(chooser="ppo", network="planned")
        terminations, rng = planted(engine), np.random.default_rng(seed)
        learner = PlannedLearner(engine, terminations, config, seed=0)
        return OptionLoop(engine, terminations, learner, RandomChooser(rng), Recorder(15, engine), config, GAMMA)

    loop, noting = loop_at(1), Noting()
    begin = loop.engine.ids.copy()
    for _ in range(7):
        loop.step()
    assert loop.engine.elapsed.any() and (loop.option >= 0).any()
    second = play(loop, noting, 2)
    assert np.array_equal(noting.asked[0], begin)
    alone = play(loop_at(2), Noting(), 2)
    assert second.length.tolist() == alone.length.tolist()
    assert second.choices.options.tolist() == alone.choices.options.tolist()


def test_decisions_are_those_of_the_episodes_that_count() -> None:
    """Of environments that wait for the slowest one no decision is kept; every other one is, in the order made."""
    loop = forced_loop(0.5, 500, 16)
    timeout = loop.config.option_timeout
    episodes = play(loop, loop.chooser, 1)
    assert len(episodes.choices.options) == sum(math.ceil(length / timeout) for length in episodes.length.ravel())


class Falling(TerminationRule):
    """Each execution lowers all thresholds."""

    def finished(self, environments: NDArray[np.int64], options: NDArray[np.int64], reached: NDArray[np.bool_]) -> None:
        self.thresholds = self.thresholds - 1


def test_play_teaches_nothing() -> None:
    """Thresholds and counters are after it what they were before."""
    engine = harsh(220, 16)
    config = TrainMetaConfig.of(chooser="ppo", network="planned")
    truth = planted(engine)
    rule = Falling(np.full(15, 0.5, np.float32))
    ends = Terminations(truth.classify, rule)
    learner = PlannedLearner(engine, truth, config, seed=0)
    chooser = RandomChooser(np.random.default_rng(0))
    before = rule.thresholds.copy()
    loop = OptionLoop(engine, ends, learner, chooser, Recorder(15, engine), config, GAMMA)
    play(loop, chooser, 3)
    np.testing.assert_array_equal(rule.thresholds, before)
    assert not learner.option_steps.any() and not learner.positives.any()


def test_uniform_choice_is_drawn_by_the_seed_of_the_run() -> None:
    """The same again for the same seed, another for another."""

    def drawn(seed: int) -> Any:
        _, uniform = play_both(loop_of(Corridor(4), Scripted(0)), seed, 1)
        return uniform.choices.options.tolist()

    assert drawn(0) == drawn(0) != drawn(1)
