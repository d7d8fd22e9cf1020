"""A study's flat agent with the same knowledge: members' first positive predictions earn a reward (Spec E7)."""

import numpy as np
import pytest
from corridor import Corridor

from hypogoal.options.termination import Terminations
from studies.bonus import BONUS, PaidEnv


def ends(ids: np.ndarray) -> np.ndarray:
    """Two members: one is positive at the start and the cells beside it (1 to 3), one at both ends."""
    return np.stack([(ids > 0) & (ids < 4), (ids == 0) | (ids == 5)], axis=1)


def test_a_member_is_paid_for_once_an_episode_by_hand() -> None:
    """Cells 0..5, start at 2; the first positive of each, not the start's own, again in the next episode."""
    env = PaidEnv(Corridor(2, max_steps=6), Terminations.of_predictions(ends, 2))
    env.reset()
    #       to    3/1     4/0     5: over/0  3/1     4/0     5: over, 0: cut
    bonuses = [[1, 1], [0, 1], [1, 0], [1, 0], [0, 0], [1, 0], [1, 1]]
    solved = [[0, 0], [0, 0], [1, 0], [0, 0], [0, 0], [1, 0], [0, 0]]
    for bonus, reward in zip(bonuses, solved, strict=True):
        _, rewards, done, _ = env.step(np.array([1, 0]))
        assert rewards.tolist() == pytest.approx((BONUS * np.array(bonus) + reward).tolist())
        assert done[0] == reward[0]
    assert env.episodes.rows == [(6, 3, 1.0, 1, 1), (12, 3, 1.0, 1, 1), (12, 6, 0.0, 0, 0)]
    env.reset()
    assert env.step(np.array([1, 0]))[1].tolist() == pytest.approx([BONUS, BONUS])
    assert env.step(np.array([1, 0]))[1].tolist() == pytest.approx([0, BONUS])
    assert env.step(np.array([0, 1]))[1].tolist() == [0, 0], "both are back among cells that were paid for"
