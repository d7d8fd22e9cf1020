"""Initiation sets learned from executions (Spec D7)."""

import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from hypogoal.core.errors import UserError
from hypogoal.core.seeding import rng_for
from hypogoal.options import initiation
from hypogoal.options.choosers import RandomChooser
from hypogoal.options.config import OptionConfig
from hypogoal.options.initiation import FEWEST, Initiation, Narrowed
from hypogoal.options.loop import OptionLoop
from hypogoal.options.recording import Recorder
from hypogoal.options.termination import oracle_terminations

sys.path.insert(0, str(Path(__file__).parents[1]))
from corridor import LENGTH, Corridor

ALWAYS_LEFT = 0


@pytest.fixture(autouse=True)
def never_ignored(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(initiation, "IGNORED", 0.0)


class Walker:
    """A learner that always plays one action."""

    def act(self, ids, options, age, *, explore=True):
        return np.full(len(ids), ALWAYS_LEFT)

    def observe(self, moved):
        pass

    def learn(self):
        return {}


def loop_with_initiation(**changes) -> OptionLoop:
    engine = Corridor(4)
    config = OptionConfig(initiation="learned", **{"option_timeout": 2, "mask_reached": False, **changes})
    verdicts = oracle_terminations(engine, (0, 1))
    sets = Initiation(engine, 2, seed=0)
    chooser = RandomChooser(rng_for(0, "random"))
    return OptionLoop(engine, verdicts, Walker(), chooser, Recorder(2, engine), config, gamma=0.9, initiation=sets)


def test_an_option_that_never_gets_there_is_held_back_and_one_that_does_is_not() -> None:
    """Spec D7: who always walks left reaches the left end from cells 0 to 2 in two steps, the right end never."""
    loop = loop_with_initiation()
    for _ in range(1_500):
        loop.step()
    probabilities = loop.initiation.probabilities(np.arange(3))
    assert (probabilities[:, 0] > 0.9).all() and (probabilities[:, 1] < 0.1).all()
    offered = loop.initiation.narrow(np.arange(3), np.ones((3, 2), dtype=np.bool_))
    np.testing.assert_array_equal(offered, [[True, False]] * 3)


def test_where_none_would_be_left_and_for_a_share_of_the_choices_all_are_offered(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Spec D7: nobody stands without options, and an option can show that it has learned since."""
    monkeypatch.setattr(initiation, "THRESHOLD", 1.0)
    loop = loop_with_initiation()
    loop.initiation.executions[:] = FEWEST
    offered = np.array([[True, False], [True, True]])
    np.testing.assert_array_equal(loop.initiation.narrow(np.array([1, 2]), offered), offered)

    monkeypatch.setattr(initiation, "IGNORED", 0.25)
    loop = loop_with_initiation()
    loop.initiation.executions[:] = FEWEST
    loop.initiation.probabilities = lambda ids: np.tile(np.array([[1.0, 0.0]], np.float32), (len(ids), 1))
    wide = loop.initiation.narrow(np.zeros(4_000, dtype=np.int64), np.ones((4_000, 2), dtype=np.bool_))
    assert wide[:, 0].all() and 0.2 < wide[:, 1].mean() < 0.3


def test_an_option_is_not_held_back_before_it_was_tried(monkeypatch: pytest.MonkeyPatch) -> None:
    """Spec D7: fewer than FEWEST executions say nothing."""
    monkeypatch.setattr(initiation, "THRESHOLD", 1.0)
    loop = loop_with_initiation()
    loop.initiation.executions[:] = (FEWEST, FEWEST - 1)
    narrowed = loop.initiation.narrow(np.array([1]), np.ones((1, 2), dtype=np.bool_))
    np.testing.assert_array_equal(narrowed, [[False, True]])


def test_executions_are_remembered_one_after_another_the_last_of_them_for_good(monkeypatch: pytest.MonkeyPatch) -> None:
    """Spec D7: where KEPT are remembered, a new one takes the oldest one's place."""
    monkeypatch.setattr(initiation, "KEPT", 5)
    sets = Initiation(Corridor(4), 2, seed=0)
    for first in (0, 2, 4):
        sets.record(np.array([first, first + 1]), np.array([0, 1]), np.array([True, False]))
    assert sets.states.tolist() == [5, 1, 2, 3, 4] and sets.option.tolist() == [1, 1, 0, 1, 0]
    assert sets.reached.tolist() == [False, False, True, False, True]
    assert sets.executions.tolist() == [3, 3] and sets.count == 6


def test_executions_that_the_end_of_the_episode_cut_short_say_nothing() -> None:
    """Spec D7: of an episode's last option, not out of time and not at its sub-goal, nobody knows."""
    loop = loop_with_initiation(option_timeout=LENGTH)
    loop.engine.max_steps = 1
    for _ in range(5):
        loop.step()
    assert loop.initiation.count == 0


def test_an_artefacts_initiation_sets_hold_back_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    """Spec D7, E1: from an observation as in training from a state, but for the share that is left alone."""
    monkeypatch.setattr(initiation, "THRESHOLD", 0.5)
    loop = loop_with_initiation(mask_reached=True)
    for _ in range(600):
        loop.step()
    own = loop.initiation
    narrow = Narrowed(own.state(), loop.engine.observation_shape, 2)
    ids = np.arange(LENGTH)
    offered = np.ones((LENGTH, 2), dtype=np.bool_)
    offered[0, 0] = offered[-1, 1] = False
    expected = own.narrow(ids, offered)
    found = [narrow(image, one) for image, one in zip(loop.engine.images(ids), offered, strict=True)]
    np.testing.assert_array_equal(found, expected)
    assert not np.array_equal(expected, offered) and expected.any(1).all()
    with pytest.raises(UserError, match=r"initiation\.safetensors"):
        Narrowed(own.state(), loop.engine.observation_shape, 3)
    with pytest.raises(UserError, match=r"initiation\.safetensors"):
        Narrowed({**own.state(), "executions": torch.zeros(3)}, loop.engine.observation_shape, 2)
