"""Another rule than the first yes: patience (Spec H4)."""

import sys
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from hypogoal.core.errors import UserError
from hypogoal.options.choosers import RandomChooser
from hypogoal.options.config import OptionConfig
from hypogoal.options.light import LightLearner
from hypogoal.options.loop import OptionLoop
from hypogoal.options.recording import Recorder
from hypogoal.options.termination import Patience, Terminations, rule_of

sys.path.insert(0, str(Path(__file__).parents[1]))
from corridor import LENGTH, Corridor

LOG_ODDS = np.array([[3.0, -1.0], [2.0, 0.0], [1.0, 1.0], [0.0, 2.0], [-1.0, 3.0], [-2.0, 4.0]], dtype=np.float32)


def by_table(ids: NDArray[np.int64]) -> NDArray[np.float32]:
    return LOG_ODDS[ids]


def patient(thresholds: tuple[float, float], length: int, environments: int = 1) -> Patience:
    return Patience(by_table, 2, None, np.array(thresholds, dtype=np.float32), environments, length)


def execution(rule: Terminations, option: int, states: tuple[int, ...]) -> list[bool]:
    """What is said at each state, and that the execution ends with the last."""
    options, said = np.array([option]), []
    for age, state in enumerate(states):
        said.append(bool(rule.reached(np.array([state]), options, np.array([age]))[0]))
    rule.finished(np.array([0]), options, np.array([said[-1]]))
    return said


def test_a_threshold_falls_to_three_quarters_of_the_best_that_was_seen() -> None:
    rule = patient((10.0, 5.0), 4)
    assert execution(rule, 1, (3, 4)) == [False, False]
    assert rule.thresholds.tolist() == [10, 5]  # two steps of four
    execution(rule, 1, (5, 4))
    assert rule.thresholds.tolist() == [10, 3]  # 3/4 of 4; the other option has had no time
    assert execution(rule, 1, (3, 4, 5)) == [False, False, True]


def test_a_threshold_falls_to_half_of_the_first_at_most_and_never_rises() -> None:
    rule = patient((4.0, 2.0), 2)
    for _ in range(3):
        execution(rule, 0, (2, 3))  # 3/4 of 1
    assert rule.thresholds[0] == 2
    execution(rule, 1, (1, 2))
    execution(rule, 1, (5, 2))  # ends in time after a state that is as sure as can be
    assert rule.thresholds[1] == 1
    unsure = patient((-3.0, 0.0), 1)
    unsure.finished(np.array([0]), np.array([0]), np.array([False]))
    for option in (0, 1):
        execution(unsure, option, (5, 5) if option == 0 else (0, 0))
    assert unsure.thresholds.tolist() == [-3, 0]


def test_an_option_that_gets_there_keeps_its_threshold() -> None:
    """One execution of twenty is enough, fewer are not; counters begin anew with each window."""
    for reaches, expected in ((1, 3.0), (0, 2.25)):
        rule = patient((0.0, 3.0), 20)
        for number in range(20):
            execution(rule, 1, (5,) if number < reaches else (4,))
        assert rule.thresholds[1] == expected
    rule = patient((0.0, 3.0), 2)
    execution(rule, 1, (4, 5))  # reaches
    execution(rule, 1, (4, 4))  # does not, nor does any other of its window
    assert rule.thresholds[1] == 2.25


def test_an_option_is_given_as_many_steps_of_its_own() -> None:
    """Steps of other options do not use up its window."""
    rule = patient((10.0, 5.0), 4)
    execution(rule, 0, (0, 1))
    execution(rule, 1, (1, 2, 3, 3))
    assert rule.thresholds.tolist() == [10, 2.5]


def test_patience_goes_on_where_it_was() -> None:
    """Spec G1: in the middle of an execution and of a window."""
    rng = np.random.default_rng(0)
    steps = [(rng.integers(LENGTH - 1, size=3), rng.integers(2, size=3), rng.random(3) < 0.3) for _ in range(60)]
    whole, begun, resumed = (patient((4.0, 5.0), 7, 3) for _ in range(3))

    def play(rule: Patience, part: list[tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.bool_]]]) -> None:
        for states, options, ends in part:
            said = rule.reached(states, options, np.where(ends, 0, 1))
            rule.finished(np.flatnonzero(ends), options[ends], said[ends])

    play(whole, steps)
    play(begun, steps[:25])
    resumed.restore(begun.snapshot())
    play(resumed, steps[25:])
    np.testing.assert_array_equal(resumed.thresholds, whole.thresholds)
    assert (whole.thresholds < [4, 5]).all()


def loop_of(rule: Terminations, environments: int) -> OptionLoop:
    engine = Corridor(environments)
    config = OptionConfig(
        experience="own",
        mask_reached=False,
        environments=environments,
        warm_up=50,
        update_interval=4,
        option_batch=32,
        epsilon_steps=300,
    )
    policies = LightLearner(engine, rule, config, seed=0)
    return OptionLoop(engine, rule, policies, RandomChooser(np.random.default_rng(0)), Recorder(2, engine), config, 1.0)


def test_options_are_learned_that_were_out_of_reach() -> None:
    """No state is sure enough; with patience the threshold falls, and what the replay holds is judged by it."""
    loop = loop_of(patient((3.5, 5.0), 150, 4), 4)
    for _ in range(400):
        loop.step()
    last = [row for rows in loop.recorder.executions for row in list(rows)[-20:]]
    assert np.mean([row.reached for row in last]) > 0.9
    assert loop.terminations.thresholds.tolist() == [2.25, 3.0]
    ends = {
        option: {row.states[-1] for row in list(rows)[-20:] if row.reached}
        for option, rows in enumerate(loop.recorder.executions)
    }
    assert ends == {0: {0}, 1: {5}}


def test_rules_are_read_from_their_names() -> None:
    assert [rule_of(text) for text in ("learned", "patience:10000")] == [(Terminations, 0), (Patience, 10000)]
    for text in ("patience", "patience:", "patience:0", "patience:-1", "patience:1.5", "learned:3", "single", ""):
        with pytest.raises(UserError, match="learned, patience:STEPS or oracle"):
            rule_of(text)
