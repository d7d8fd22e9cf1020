"""Prioritised replay and Double-DQN targets (Spec D2, D3)."""

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from hypogoal.core.arrays import Columns
from hypogoal.learners.double_dqn import double_q_targets, follow, linear_epsilon
from hypogoal.learners.replay import PrioritisedReplay, SumTree


@dataclass(frozen=True)
class Numbers(Columns):
    """What is stored here."""

    x: NDArray[np.int32]


def test_sum_tree_finds_the_leaf_of_a_prefix_sum_like_the_plain_search() -> None:
    """Spec D2: the tree gives what a cumulative sum gives."""
    rng = np.random.default_rng(0)
    for capacity in (2, 7, 64, 100):
        tree = SumTree(capacity)
        priorities = rng.random(capacity) * (rng.random(capacity) < 0.7)
        priorities[0] = 1.0
        tree.set(np.arange(capacity), priorities)
        sums = rng.random(200) * priorities.sum() * 0.999999
        plain = np.searchsorted(np.cumsum(priorities), sums, side="right")
        np.testing.assert_array_equal(tree.find(sums), plain)
        np.testing.assert_allclose(tree.total, priorities.sum())


def test_sum_tree_stays_right_under_many_overwrites() -> None:
    """Spec D2: after random updates every inner node is the sum of its leaves."""
    rng = np.random.default_rng(1)
    tree = SumTree(50)
    plain = np.zeros(50)
    for _ in range(200):
        indices = rng.choice(50, size=rng.integers(1, 20), replace=False)
        values = rng.random(len(indices))
        tree.set(indices, values)
        plain[indices] = values
    np.testing.assert_allclose(tree.get(np.arange(50)), plain)
    np.testing.assert_allclose(tree.total, plain.sum())


def test_sampling_follows_priorities_and_weights_correct_for_it() -> None:
    """Spec D2 (Schaul et al. 2015): with alpha 1 a transition is drawn in proportion to its priority."""
    replay = PrioritisedReplay(4, Numbers, alpha=1.0, beta=1.0)
    indices = replay.add(Numbers(np.arange(4)))
    replay.set_priorities(indices, np.array([1.0, 2.0, 3.0, 4.0]))
    rng = np.random.default_rng(0)
    drawn, weights = replay.sample(10_000, rng)
    np.testing.assert_allclose(np.bincount(drawn) / 10_000, np.array([1, 2, 3, 4]) / 10, atol=0.01)
    # beta = 1: weight times chance is the same for all.
    by_item = np.array([weights[drawn == item][0] for item in range(4)])
    np.testing.assert_allclose(by_item * np.array([1, 2, 3, 4]), by_item[0], rtol=1e-2)
    assert weights.max() == 1.0


def test_what_is_new_has_the_largest_priority_seen() -> None:
    """Spec D2: to the power alpha, as those that were learned from."""
    replay = PrioritisedReplay(4, Numbers, alpha=0.5, beta=0.4)
    replay.set_priorities(replay.add(Numbers(np.arange(2))), np.array([1.0, 9.0]))
    np.testing.assert_allclose(replay.tree.get(replay.add(Numbers(np.array([2])))), [3.0], rtol=1e-3)
    np.testing.assert_allclose(replay.tree.get(np.arange(2)), [1.0, 3.0], rtol=1e-3)


def test_the_ring_forgets_the_oldest() -> None:
    """Spec D3: capacity transitions are kept."""
    replay = PrioritisedReplay(3, Numbers, alpha=0.6, beta=0.4)
    replay.add(Numbers(np.array([1, 2])))
    replay.add(Numbers(np.array([3, 4])))
    assert sorted(replay.data.x) == [2, 3, 4]
    assert replay.size == 3


def test_double_q_targets_by_hand() -> None:
    """Spec D2: the online network picks the action, the target network values it; nothing follows a terminal state."""
    next_online = torch.tensor([[1.0, 5.0], [9.0, 0.0]])
    next_target = torch.tensor([[10.0, 2.0], [3.0, 100.0]])
    targets = double_q_targets(torch.tensor([0.5, 1.0]), torch.tensor([False, True]), next_online, next_target, 0.9)
    torch.testing.assert_close(targets, torch.tensor([0.5 + 0.9 * 2.0, 1.0]))


def test_bounded_targets_lie_between_0_and_1() -> None:
    """Spec D2: an option returns 1 at most, discounted, and no less than 0: values fed on themselves cannot grow."""
    values = torch.tensor([[4.0, 0.0], [-3.0, -5.0], [0.5, 0.2]])
    rewards, terminal = torch.tensor([0.0, 0.0, 0.0]), torch.tensor([False, False, False])
    targets = double_q_targets(rewards, terminal, values, values, 0.9, bounded=True)
    torch.testing.assert_close(targets, torch.tensor([1.0, 0.0, 0.45]))


def test_follow_moves_or_copies_everything() -> None:
    """Spec D2: a full target copy, batch statistics included (the authors copy only the head)."""
    online = torch.nn.Sequential(torch.nn.Linear(2, 2), torch.nn.BatchNorm1d(2))
    target = torch.nn.Sequential(torch.nn.Linear(2, 2), torch.nn.BatchNorm1d(2))
    online(torch.randn(8, 2, generator=torch.Generator().manual_seed(0)))
    before = target[0].weight.clone()
    follow(target.state_dict().values(), online.state_dict().values(), 0.25)
    torch.testing.assert_close(target[0].weight, 0.75 * before + 0.25 * online[0].weight)
    follow(target.state_dict().values(), online.state_dict().values(), 1.0)
    for mine, theirs in zip(target.state_dict().values(), online.state_dict().values(), strict=True):
        torch.testing.assert_close(mine, theirs)


def test_epsilon_falls_linearly() -> None:
    """Tables 2 and 4: from 1 to the final value over so many steps."""
    np.testing.assert_allclose(linear_epsilon(np.array([0, 4000, 8000, 9000]), 8000, 0.01), [1, 0.505, 0.01, 0.01])
