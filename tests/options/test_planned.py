"""Options that are planned: exact shortest ways (Spec H3)."""

import numpy as np
import pytest
from corridor import Corridor

from hypogoal.core.errors import UserError
from hypogoal.domains.doorkey.engine import START, DoorKeyEngine
from hypogoal.options.config import OptionConfig
from hypogoal.options.planned import FAR, PlannedLearner, distances
from hypogoal.options.termination import Terminations, oracle_terminations


def planned(engine: DoorKeyEngine, terminations: Terminations) -> PlannedLearner:
    return PlannedLearner(engine, terminations, OptionConfig.of(network="planned"), seed=0)


def test_distances_by_hand() -> None:
    """Four states in a row and one apart; the third ends the episode, so nothing leads through it."""
    after = np.array([[0, 1], [0, 2], [2, 2], [2, 3], [4, 4]])
    reached = np.zeros((5, 2), np.bool_)
    reached[2, 0] = reached[3, 1] = True
    final = np.array([False, False, True, False, False])
    assert distances(reached, after, final).tolist() == [[2, FAR], [1, FAR], [0, FAR], [1, 0], [FAR, FAR]]


@pytest.mark.parametrize("wrong_key", ["harmless", "ends"])
def test_ways_are_shortest(wrong_key: str) -> None:
    """The goal's option takes the layout's shortest path, and every step of every option comes one step nearer."""
    for layout_seed in range(5):
        engine = DoorKeyEngine(layout_seed, 1, wrong_key=wrong_key)
        learner = planned(engine, oracle_terminations(engine, range(5)))
        shortest = engine.shortest_path()  # None where a wrong key lies in the way
        assert learner.steps[0, 4] == (FAR if shortest is None else shortest)
        plan = engine.plan()
        for option in range(5):
            going = np.flatnonzero((learner.steps[:, option] > 0) & (learner.steps[:, option] < FAR))
            options = np.full(len(going), option)
            actions = learner.act(plan.ids[going], options, np.zeros(len(going), np.int64))
            place = {state: row for row, state in enumerate(plan.ids.tolist())}
            after = [place[state] for state in engine.follow(plan.ids[going], actions).tolist()]
            assert np.array_equal(learner.steps[after, option], learner.steps[going, option] - 1)


def test_it_goes_where_its_member_predicts_positive() -> None:
    """Not to the true sub-goal: a member that is wrong gets an option that goes to the wrong place, surely."""
    engine = DoorKeyEngine(3, 1)
    ids = engine.plan().ids
    wrong = ids[engine.origins(ids)["agent_x"] == 1][-1]
    learner = planned(engine, Terminations.of_predictions(lambda states: (states == wrong)[:, None], 1))
    state, steps = np.array([START]), 0
    while state[0] != wrong:
        state = engine.follow(state, learner.act(state, np.zeros(1, np.int64), np.array([steps])))
        steps += 1
    assert steps == learner.steps[0, 0]


def test_nobody_plans_where_nobody_knows() -> None:
    """One line of what, where and what to do."""
    engine = Corridor(2)
    with pytest.raises(UserError, match="this domain does not know what each action leads to"):
        planned(engine, oracle_terminations(engine, (0,)))  # type: ignore[arg-type]
