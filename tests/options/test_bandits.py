"""A bandit over options (Spec H4): what it finds, by hand what it is credited with, and what stays of it."""

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from planted import NearPlanner, harsh, planted

from hypogoal.core.errors import UserError
from hypogoal.evaluation.frozen import play
from hypogoal.meta.config import TrainMetaConfig
from hypogoal.options.choosers import Chooser, Outcome, RandomChooser
from hypogoal.options.loop import OptionLoop
from hypogoal.options.planned import PlannedLearner
from hypogoal.options.recording import Recorder
from hypogoal.options.thompson import ThompsonChooser

HERE = np.arange(2)  # two environments
ALL = np.ones((2, 3), np.bool_)  # three options


def loop_of(name: str, kind: type[PlannedLearner], seed: int, environments: int) -> OptionLoop:
    engine, config = harsh(220, environments), TrainMetaConfig(network="planned")
    terminations, rng = planted(engine), np.random.default_rng(seed)
    chooser: Chooser = RandomChooser(rng) if name == "random" else ThompsonChooser(15, environments, rng)
    learner = kind(engine, terminations, config, seed=0)
    return OptionLoop(engine, terminations, learner, chooser, Recorder(15, engine), config, config.gamma)


def solved(loop: OptionLoop, episodes: int, last: int) -> float:
    """The share of the last of so many training episodes."""
    while len(loop.recorder.episodes) < episodes:
        loop.step()
    return float(np.mean([success for *_, success in loop.recorder.episodes][-last:]))


def test_thompson_finds_the_right_members_within_200_episodes() -> None:
    """In nine of ten seeds, in their order: key, door, goal. Uniform choice never does."""
    found, chance = 0, []
    for seed in range(10):
        loop = loop_of("thompson", NearPlanner, seed, 4)
        share = solved(loop, 200, 50)
        successes = loop.chooser.credit[0]  # type: ignore[attr-defined]
        found += share >= 0.8 and successes[9:12].argmax() == 0 and successes[12:].argmax() == 0
        chance.append(solved(loop_of("random", NearPlanner, seed, 4), 200, 50))
    assert found >= 9
    assert max(chance) <= 0.15


def ended(bandit: ThompsonChooser, returned: list[float], terminated: list[bool], truncated: list[bool]) -> None:
    """What the options that run in both environments came to."""
    no, one = np.zeros(2, np.bool_), np.ones(2)
    over = np.array(terminated), np.array(truncated)
    bandit.record(Outcome(HERE, HERE, HERE, no, no, np.array(returned), HERE, one, HERE, *over))


def test_a_domain_says_itself_what_is_solved() -> None:
    """Spec B6: whatever the rewards, and whether or not the episode was cut."""
    bandit = ThompsonChooser(3, 2, np.random.default_rng(0))
    bandit.choose(HERE, HERE, only(0, 1))
    no, one, yes = np.zeros(2, np.bool_), np.ones(2), np.array([True, False])
    bandit.record(Outcome(HERE, HERE, HERE, no, no, np.array([0.0, 1.0]), HERE, one, HERE, ~yes, yes, yes))
    bandit.learn()
    assert bandit.credit.tolist() == [[1, 0, 0], [0, 1, 0]]


def only(*options: int) -> NDArray[np.bool_]:
    """One option offered in each environment."""
    return np.arange(3) == np.array(options)[:, None]


def test_episodes_credit_what_was_chosen_in_them() -> None:
    """Solved: over, and rewarded in sum. Each option once, however often it was chosen in the episode."""
    bandit = ThompsonChooser(3, 2, np.random.default_rng(0))
    for offered in (only(0, 1), only(0, 2)):
        assert bandit.choose(HERE, HERE, offered).tolist() == offered.argmax(1).tolist()
        assert not bandit.credit.any()
        ended(bandit, [0.5, 0.0], [False, False], [False, False])
        bandit.learn()
    bandit.choose(HERE, HERE, only(2, 2))
    ended(bandit, [-0.25, 1.0], [True, False], [False, True])  # solved; rewarded, but cut
    bandit.learn()
    assert bandit.credit.tolist() == [[1, 0, 1], [0, 1, 1]]
    bandit.choose(HERE, HERE, only(1, 1))
    ended(bandit, [0.0, 1.0], [True, True], [False, False])  # lost; solved
    bandit.learn()
    assert bandit.credit.tolist() == [[1, 1, 1], [0, 2, 1]]


def test_a_snapshot_holds_what_came_of_an_episode_so_far() -> None:
    """Spec G1: what an episode has earned, and what is noted but not learned."""
    one, other = (ThompsonChooser(3, 2, np.random.default_rng(seed)) for seed in (0, 1))
    one.choose(HERE, HERE, only(0, 1))
    ended(one, [0.5, 0.0], [False, True], [False, False])
    other.restore(one.snapshot())
    for bandit in (one, other):
        ended(bandit, [-0.25, 0.0], [True, False], [False, False])
        bandit.learn()
        np.testing.assert_array_equal(bandit.credit, [[1, 0, 0], [0, 1, 0]])


def test_thompson_draws_anew_for_every_episode() -> None:
    """In an episode it stays with what it drew, also where it is asked again; environments differ, episodes too."""
    many, offered = np.arange(50), np.ones((50, 3), np.bool_)
    bandit = ThompsonChooser(3, 50, np.random.default_rng(0))
    first = bandit.choose(many, many, offered)
    assert set(first) == {0, 1, 2}
    np.testing.assert_array_equal(bandit.choose(many, many, offered), first)
    loop = loop_of("thompson", PlannedLearner, 0, 1)
    choices = play(loop, loop.chooser, 100).choices
    assert len({int(option) for option in choices.options[choices.offered.all(1)]}) > 5
    assert not loop.chooser.credit.any()  # type: ignore[attr-defined]


def test_what_is_loaded_chooses_alike() -> None:
    """From the same draws as the one that learned; another's, or a damaged one, is one line."""
    loop = loop_of("thompson", PlannedLearner, 3, 4)
    solved(loop, 150, 1)
    one, other = loop.chooser, ThompsonChooser(15, 4, np.random.default_rng(7))
    assert isinstance(one, ThompsonChooser) and one.credit[0].any()
    fresh = ThompsonChooser(15, 4, np.random.default_rng(7))
    other.load(one.state())
    one.rng, one._taken[:] = np.random.default_rng(7), 0.0
    where, offered = np.arange(4), np.ones((4, 15), np.bool_)
    chosen = [np.stack([it.choose(where, where, offered) for _ in range(50)]) for it in (one, other, fresh)]
    np.testing.assert_array_equal(chosen[0], chosen[1])
    assert (chosen[0] != chosen[2]).any()
    for wrong in (torch.zeros(2, 14, dtype=torch.float64), torch.full((2, 15), -1.0, dtype=torch.float64)):
        with pytest.raises(UserError, match=r"do not fit|below 0"):
            other.load({"credit": wrong})
