"""Random actions: independent or kept, among all or a named set (Spec D3)."""

import numpy as np
import pytest

from hypogoal.options.config import LearnerConfig
from hypogoal.options.exploration import Exploration

GREEDY = 99  # no random action


def played(mode: str, epsilon: float, steps: int, age=lambda t: t, count: int = 1) -> np.ndarray:
    """The actions (steps, count) of an exploration among 50, or GREEDY."""
    exploration = Exploration(LearnerConfig(exploration=mode), count, 50, np.random.default_rng(0))
    policy, chance = np.full(count, GREEDY), np.full(count, epsilon)
    return np.array([exploration.mix(policy, chance, np.full(count, age(t))) for t in range(steps)])


def test_independent_actions_last_one_step() -> None:
    """Spec D3: epsilon is the share of random actions; the next one knows nothing of the last."""
    actions = played("independent", 0.3, 20_000)[:, 0]
    random = actions != GREEDY
    assert random.mean() == pytest.approx(0.3, abs=0.02)
    both = random[1:] & random[:-1]
    assert both.mean() == pytest.approx(0.09, abs=0.01)
    assert (actions[1:] == actions[:-1])[both].mean() == pytest.approx(1 / 50, abs=0.02)


def test_persistent_actions_are_kept_for_zeta_many_steps() -> None:
    """Dabney et al. 2020: begun with chance epsilon, kept n steps with P(n) = n^-2 / zeta(2)."""
    side_by_side = played("persistent", 0.05, 5_000, count=20)
    actions = np.vstack([side_by_side, np.full(20, GREEDY)]).T.ravel()  # one after the other, a step between them
    random = np.concatenate([[False], actions != GREEDY, [False]])
    begins, ends = np.flatnonzero(~random[:-1] & random[1:]), np.flatnonzero(random[:-1] & ~random[1:])
    lengths = ends - begins
    # A stretch of one step: one of length 1 (0.608), not followed at once by another (0.95).
    assert (lengths == 1).mean() == pytest.approx(0.608 * 0.95, abs=0.02)
    assert (lengths >= 20).mean() == pytest.approx(0.03, abs=0.015)
    # Where it is not yet random, a stretch begins with chance epsilon.
    greedy = ~random[1:-1]
    assert len(begins) / (greedy.sum() + len(begins)) == pytest.approx(0.05, abs=0.01)
    # Within a stretch of a single draw nothing changes: at most one change per begin.
    long = [actions[begin : begin + 20] for begin, length in zip(begins, lengths, strict=True) if length >= 20]
    assert np.mean([len(np.unique(stretch)) <= 2 for stretch in long]) > 0.7


def test_a_kept_action_ends_with_its_execution() -> None:
    """Spec D3: at the first step of an execution nothing is left of the last one's."""
    exploration = Exploration(LearnerConfig(exploration="persistent"), 2000, 50, np.random.default_rng(1))
    policy = np.full(2000, GREEDY)
    ones, none = np.ones(2000), np.zeros(2000)
    first = exploration.mix(policy, ones, np.zeros(2000))
    assert (first != GREEDY).all()
    kept = exploration.mix(policy, none, np.ones(2000))
    going_on = kept != GREEDY
    assert going_on.mean() == pytest.approx(1 - 0.608, abs=0.04)
    np.testing.assert_array_equal(kept[going_on], first[going_on])
    assert (exploration.mix(policy, none, np.zeros(2000)) == GREEDY).all()
