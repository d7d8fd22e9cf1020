"""What choosing is worth, on planted members whose worth is known (Spec H2, H3)."""

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest
from corridor import LENGTH, Corridor
from made_up import asked, results_of
from made_up import row as row_of
from numpy.typing import NDArray
from option_loops import loop_of
from planted import harsh, planted

from hypogoal.core.seeding import rng_for
from hypogoal.domains.base import Plan
from hypogoal.domains.doorkey.engine import DoorKeyEngine
from hypogoal.evaluation import selection
from hypogoal.evaluation.choosing import judge, qualities, with_choosers
from hypogoal.evaluation.frozen import Choices, play
from hypogoal.evaluation.names import UNIFORM
from hypogoal.evaluation.selection import numbers_of_choices
from hypogoal.meta.config import GAMMA, MetaConfig, TrainMetaConfig
from hypogoal.meta.ppo import MetaPolicy
from hypogoal.options.choosers import Chooser, RandomChooser
from hypogoal.options.loop import OptionLoop
from hypogoal.options.planned import PlannedLearner
from hypogoal.options.recording import Recorder
from hypogoal.options.tables import ChoiceCounts

MEMBERS, GOALS = 3, np.repeat(np.arange(5), 3)
RIGHT = [0, 3, 6, 9, 12]  # the first member of every sub-goal knows it


def agent(layout_seed: int, steps: int) -> OptionLoop:
    """PPO over planned options of planted members, in a world where a wrong key ends the episode."""
    engine, config = harsh(layout_seed, 16), TrainMetaConfig.of(chooser="ppo", network="planned")
    terminations = planted(engine)
    learner = PlannedLearner(engine, terminations, config, seed=0)
    chooser = MetaPolicy(engine, 15, config.part(MetaConfig), 0)
    loop = OptionLoop(engine, terminations, learner, chooser, Recorder(15, engine), config, GAMMA)
    while loop.recorder.steps < steps:
        loop.step()
    return loop


def test_the_agent_finds_the_planted_truth() -> None:
    """Spec H2: it solves the task, uniform-random choice among its own options does not; it takes the better of two."""
    loop = agent(220, 40_000)
    played = play(loop, loop.chooser, 32)
    quality = qualities(loop, GOALS, played.choices.states)
    judged = judge(played.choices, quality, MEMBERS)
    uniform = play(loop, RandomChooser(rng_for(0, "uniform")), 32)
    assert played.succeeded.mean() >= 0.95
    assert uniform.succeeded.mean() <= 0.15
    assert judged["pair"] >= 0.9
    assert judged["score"] >= 0.65
    at_random = judge(uniform.choices, qualities(loop, GOALS, uniform.choices.states), MEMBERS)
    assert abs(at_random["pair"] - 0.5) < 0.15
    assert abs(at_random["score"]) < 0.15


def qualities_of(engine: DoorKeyEngine) -> NDArray[np.float64]:
    """Of the planted members, begun in every state that can be reached."""
    terminations = planted(engine)
    config = TrainMetaConfig.of(chooser="ppo", network="planned")
    learner = PlannedLearner(engine, terminations, config, seed=0)
    loop = OptionLoop(engine, terminations, learner, Silent(), Recorder(15, engine), config, GAMMA)
    return qualities(loop, GOALS, engine.reachable())


def test_right_members_have_quality_one() -> None:
    """Where their sub-goal can be had within the timeout and no other key comes into their way."""
    quality = qualities_of(DoorKeyEngine(220, 1))
    assert (quality[RIGHT] == 1).all()
    assert (np.delete(quality, RIGHT) < 1).all()


def test_an_option_that_loses_the_episode_is_not_good() -> None:
    """Where a wrong key ends the episode, the member that knows the blue key brings it about, and with it the end."""
    quality = qualities_of(harsh(220, 1))
    assert quality[0] == 0
    assert quality[6] == 1, "the red key"


class Silent(Chooser):
    """Never asked."""

    def choose(
        self, environments: NDArray[np.int64], ids: NDArray[np.int64], offered: NDArray[np.bool_]
    ) -> NDArray[np.int64]:
        raise NotImplementedError


def decisions(options: list[int], offered: list[list[int]], count: int) -> Choices:
    allowed = np.zeros((len(options), count), np.bool_)
    for row, some in enumerate(offered):
        allowed[row, some] = True
    return Choices(np.zeros(len(options), np.int64), np.array(options), allowed)


def test_choices_by_hand() -> None:
    """Two sub-goals of two members: 60 decisions for the first, 45 of them for the better; one choice is none."""
    quality = np.array([0.9, 0.1, 0.5, 0.6])
    judged = judge(decisions([0] * 45 + [1] * 15 + [2] * 30, [[0, 1, 2]] * 60 + [[2, 0]] * 30, 4), quality, 2)
    assert judged["preference"][:2].tolist() == [1.5, 0.5]
    assert np.isnan(judged["preference"][2:]).all()
    assert judged["within_rho"] == pytest.approx(1.0)
    assert judged["pair"] == 0.75
    assert judged["score"] == pytest.approx((45 * 0.4 - 15 * 0.4) / (60 * 0.4))


def test_what_nobody_knows_is_left_out() -> None:
    """A member whose quality is not known is neither better nor worse than another."""
    judged = judge(decisions([0] * 50, [[0, 1]] * 50, 2), np.array([0.9, math.nan]), 2)
    assert math.isnan(judged["pair"])
    assert math.isnan(judged["score"])
    assert math.isnan(judged["within_rho"])
    chosen_too = decisions([0] * 40 + [1] * 10, [[0, 1, 2]] * 50, 3)
    judged = judge(chosen_too, np.array([0.9, math.nan, 0.1]), 3)
    assert judged["score"] == pytest.approx(1), "of the forty decisions for a member that is known"


@pytest.mark.parametrize("hundredths", range(0, 81, 4))
def test_a_difference_of_exactly_two_tenths_counts(hundredths: int) -> None:
    """Whatever floating point makes of it, and a hundredth less does not."""
    low, high, short = (number / 100 for number in (hundredths, hundredths + 20, hundredths + 19))
    choices = decisions([0] * 20 + [1] * 30, [[0, 1]] * 50, 2)
    judged = judge(choices, np.array([low, high]), 2)
    assert judged["pair"] == 0.6
    assert judged["within_rho"] == pytest.approx(1.0)
    judged = judge(choices, np.array([low, short]), 2)
    assert math.isnan(judged["pair"])
    assert math.isnan(judged["within_rho"])


@pytest.mark.parametrize("members", range(2, 12))
def test_exactly_twenty_expected_choices_suffice(members: int) -> None:
    """Twenty times each of the members offered is twenty, though thirds do not add up so."""
    options, quality = list(range(members)) * 20, np.zeros(members)
    for count, known in ((len(options), True), (len(options) - 1, False)):
        choices = decisions(options[:count], [list(range(members))] * count, members)
        preference = judge(choices, quality, members)["preference"]
        assert preference.tolist() == [1.0] * members if known else np.isnan(preference).all()


@pytest.mark.parametrize("hundredths", range(101))
def test_members_of_one_quality_leave_nothing_to_choose(hundredths: int) -> None:
    """The mean of three equal numbers may be off by rounding; that is no gain."""
    judged = judge(decisions([0, 1, 2] * 20, [[0, 1, 2]] * 60, 3), np.full(3, hundredths / 100), 3)
    assert math.isnan(judged["score"])
    assert math.isnan(judged["pair"])


def test_the_order_of_decisions_does_not_matter() -> None:
    """Sums of thirds and halves in another order: equal preferences stay equal, and share their rank."""
    rng, offered = np.random.default_rng(0), [[0, 1, 2], [0, 1], [0, 2], [1, 2]] * 30
    taken = [some[row // 4 % 2 if len(some) == 2 else 0] for row, some in enumerate(offered)]  # 60, 30 and 30 times
    quality = np.array([0.1, 0.5, 0.9])
    expected = judge(decisions(taken, offered, 3), quality, 3)
    assert expected["within_rho"] == pytest.approx(-np.sqrt(3) / 2)
    for _ in range(20):
        order = rng.permutation(len(taken))
        judged = judge(decisions([taken[row] for row in order], [offered[row] for row in order], 3), quality, 3)
        assert judged["within_rho"] == expected["within_rho"]
        assert judged["preference"].tolist() == expected["preference"].tolist()


def test_preference_of_an_uncaring_chooser_is_one():
    """Spec F6: however unevenly options are offered."""
    rng = np.random.default_rng(0)
    offered = rng.random((40_000, 3)) < np.array([0.1, 0.5, 1.0])
    expected = (offered / offered.sum(1, keepdims=True)).sum(0)
    choices = np.where(offered, rng.random(offered.shape), -1).argmax(1)
    chosen = np.bincount(choices, minlength=3)
    none = np.zeros(3, np.int64)
    table = ChoiceCounts(none, np.arange(3), offered.sum(0), chosen, expected, none, none)
    np.testing.assert_allclose(numbers_of_choices(table, 3)["preference"], 1, atol=0.05)


def test_counts_by_hand():
    """Spec F6: two windows of four options; one is never offered, one never chosen in the first."""
    rows = [
        (100, 0, 40, 10, 20.0, 5, 50), (100, 1, 40, 20, 10.0, 20, 40), (100, 2, 0, 0, 0.0, 0, 0),
        (100, 3, 10, 0, 5.0, 0, 0), (200, 0, 40, 0, 10.0, 0, 0), (200, 1, 40, 30, 10.0, 30, 60),
        (200, 2, 0, 0, 0.0, 0, 0), (200, 3, 10, 10, 5.0, 9, 20),
    ]  # fmt: skip
    found = numbers_of_choices(ChoiceCounts.of_rows(rows), 4)
    np.testing.assert_allclose(found["preference"], [10 / 30, 50 / 20, np.nan, 1])
    np.testing.assert_allclose(found["chosen"], [10, 50, 0, 10])
    np.testing.assert_allclose(found["duration"], [5, 2, np.nan, 2])


def test_the_first_run_is_that_of_the_smallest_number() -> None:
    """Of seeds 2 and 10 it is 2, though as text 10 comes first."""
    rows = []
    for seed in (10, 2):
        place = {"artefact": f"meta/seed-{seed}", "method": "D-BAT", "layout": 100, "seed": seed}
        rows.append(row_of("preference", 1.0, **place, sub_goal="go-to-goal", member=0, scope=selection.SCOPE))
    context = asked(selection, results_of(*rows))
    assert context is not None
    assert context["members"]["artefact"].tolist() == ["meta/seed-2"]


def test_uniform_random_choice_stands_beside_the_agent_whose_options_it_has() -> None:
    """A method has two choosers: its own and the uniform one."""
    runs = pd.DataFrame({"artefact": ["a", "a", "b"], "method": ["D-BAT", UNIFORM, "one classifier"]})
    told = with_choosers(runs)
    assert told["method"].tolist() == ["D-BAT", "D-BAT", "one classifier"]
    assert told["chooser"].tolist() == ["the agent's", UNIFORM, "the agent's"]


class Mapped(Corridor):
    """It knows what follows."""

    def plan(self, starts: Any = None) -> Plan:
        cells = np.arange(LENGTH)
        following = np.stack([np.maximum(cells - 1, 0), np.minimum(cells + 1, LENGTH - 1)], axis=1)
        return Plan(cells, np.arange(2), following, cells == LENGTH - 1, cells == LENGTH - 1)


def test_a_state_counts_as_often_as_it_is_decided_in() -> None:
    """Three times it begins in cell 1 and goes to the left end, once in cell 4, where it ends the episode instead."""
    learner = SimpleNamespace(act=lambda ids, *_, **__: (ids > 2).astype(int))
    quality = qualities(loop_of(Mapped(1), learner), np.array([0]), np.array([1, 4, 1, 1]))
    assert quality.tolist() == [0.75]
