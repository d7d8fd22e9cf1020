"""Prioritised replay, transitions over several steps, and Double-DQN targets (Spec D2, D3)."""

import copy
import math
from dataclasses import dataclass

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from hypogoal.core.adam import Adam
from hypogoal.core.arrays import Columns
from hypogoal.options.config import LearnerConfig
from hypogoal.options.double_dqn import SOFT, DoubleDQN, ReplayBatch, descend, double_q_targets, linear_epsilon
from hypogoal.options.replay import PrioritisedReplay, Steps, StepsAhead


@dataclass(frozen=True)
class Numbers(Columns):
    """What is stored here."""

    x: NDArray[np.int32]


def test_sampling_follows_priorities_and_weights_correct_for_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """Spec D2 (Schaul et al. 2015): with alpha 1 a transition is drawn in proportion to its priority."""
    monkeypatch.setattr("hypogoal.options.replay.ALPHA", 1.0)
    monkeypatch.setattr("hypogoal.options.replay.BETA", 1.0)
    replay = PrioritisedReplay(Numbers.zeros(4))
    replay.add(Numbers(np.arange(4)))
    replay.set_priorities(np.arange(4), np.array([1.0, 2.0, 3.0, 4.0]))
    rng = np.random.default_rng(0)
    drawn, weights = replay.sample(10_000, rng)
    np.testing.assert_allclose(np.bincount(drawn) / 10_000, np.array([1, 2, 3, 4]) / 10, atol=0.01)
    # beta = 1: weight times chance is the same for all.
    by_item = np.array([weights[drawn == item][0] for item in range(4)])
    np.testing.assert_allclose(by_item * np.array([1, 2, 3, 4]), by_item[0], rtol=1e-2)
    assert weights.max() == 1.0


def test_what_is_new_has_the_largest_priority_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    """Spec D2: to the power alpha, as those that were learned from."""
    monkeypatch.setattr("hypogoal.options.replay.ALPHA", 0.5)
    replay = PrioritisedReplay(Numbers.zeros(4))
    replay.add(Numbers(np.arange(2)))
    replay.set_priorities(np.arange(2), np.array([1.0, 9.0]))
    replay.add(Numbers(np.array([2])))
    np.testing.assert_allclose(replay.priorities, [1.0, 3.0, 3.0, 0.0], rtol=1e-3)


def test_the_ring_forgets_the_oldest() -> None:
    """Spec D3: capacity transitions are kept."""
    replay = PrioritisedReplay(Numbers.zeros(3))
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


@pytest.mark.parametrize("interval", [0, 2])
def test_the_target_follows_with_everything(interval: int) -> None:
    """Spec D2: a hundredth at each update, or a full copy now and then; batch statistics included."""
    config = LearnerConfig(target_interval=interval, option_learning_rate=0.1)
    network = torch.nn.Sequential(torch.nn.Linear(3, 2), torch.nn.BatchNorm1d(2), torch.nn.Unflatten(1, (1, 2)))
    learning, states = DoubleDQN(network, config), torch.randn(4, 3, generator=torch.Generator().manual_seed(0))
    ones = np.ones(4, np.int64)
    batch = ReplayBatch(
        actions=np.array([0, 1, 1, 0]),
        steps=ones,
        reached=ones[:, None] > 0,
        terminated=ones > 0,
        learns=ones[:, None] > 0,
        weights=ones.astype(np.float32),
    )
    first = copy.deepcopy(learning.target.state_dict())
    for updates in (1, 2):
        before = copy.deepcopy(learning.target.state_dict())
        learning.update(network(states), network(states), learning.target(states), batch, [0], 0)
        rate = SOFT if interval == 0 else float(updates == interval)
        for name, value in learning.target.state_dict().items():
            new = network.state_dict()[name]
            wanted = before[name] + rate * (new - before[name]) if value.is_floating_point() else value
            torch.testing.assert_close(value, wanted)
    assert any(not torch.equal(value, first[name]) for name, value in learning.target.state_dict().items())


@pytest.mark.parametrize("largest", [1e-3, 1e3, math.inf])
def test_gradients_are_cut_as_torch_cuts_them(largest: float) -> None:
    """The same bytes, though gradients within the norm are left alone."""
    ours = torch.nn.Linear(5, 3)
    theirs = copy.deepcopy(ours)
    descend(ours(torch.ones(1, 5)).square().sum(), Adam(ours.parameters(), 0.1), "it", "here", largest)
    theirs(torch.ones(1, 5)).square().sum().backward()
    torch.nn.utils.clip_grad_norm_(theirs.parameters(), largest)
    for one, other in zip(ours.parameters(), theirs.parameters(), strict=True):
        assert torch.equal(one.grad, other.grad)


def test_epsilon_falls_linearly() -> None:
    """Tables 2 and 4: from 1 to the final value over so many steps."""
    np.testing.assert_allclose(linear_epsilon(np.array([0, 4000, 8000, 9000]), 8000, 0.01), [1, 0.505, 0.01, 0.01])


@dataclass(frozen=True)
class Ended(Steps):
    """Whether the sequence ended."""

    end: NDArray[np.bool_]


def test_transitions_reach_n_steps_on_but_not_beyond_the_end() -> None:
    """Spec D2: two sequences, n = 3. The first, 10 -> 11 -> 12 -> 13 -> 14, ends there; the second goes on."""
    ahead = StepsAhead(2, 3)
    rows = []
    for t in range(4):
        s, following = np.array([10 + t, 20 + t]), np.array([11 + t, 21 + t])
        ended = np.array([t == 3, False])
        rows.append(ahead.add(Ended(s, np.array([t, 10 + t]), following, np.ones(2, int), ended), ended))
    assert [len(row) for row in rows] == [0, 0, 2, 4]

    def listed(row):
        columns = (values.tolist() for values in vars(row).values())
        return list(zip(*columns, strict=True))

    assert listed(rows[2]) == [(10, 0, 13, 3, False), (20, 10, 23, 3, False)]
    assert listed(rows[3]) == [(11, 1, 14, 3, True), (12, 2, 14, 2, True), (13, 3, 14, 1, True), (21, 11, 24, 3, False)]
    # The next sequence begins empty: nothing is joined to what came before.
    both = np.array([True, True])
    again = ahead.add(Ended(np.array([30, 24]), np.array([0, 14]), np.array([31, 25]), np.ones(2, int), both), both)
    assert sorted(zip(again.state.tolist(), again.next_state.tolist(), again.steps.tolist(), strict=True)) == [
        (22, 25, 3),
        (23, 25, 2),
        (24, 25, 1),
        (30, 31, 1),
    ]


def test_one_step_ahead_is_the_plain_transition() -> None:
    """Spec D2: n = 1 changes nothing."""
    ended = np.array([False, True])
    steps = Ended(np.array([4, 7]), np.array([1, 0]), np.array([5, 8]), np.ones(2, int), ended)
    for name, values in vars(StepsAhead(2, 1).add(steps, ended)).items():
        np.testing.assert_array_equal(values, getattr(steps, name))


def test_targets_over_several_steps_by_hand() -> None:
    """Spec D2: reached after three steps 0.9 ** 2; not reached after two, 0.9 ** 2 times the value there."""
    ahead = torch.tensor([3.0, 2.0])
    reached = torch.tensor([True, False])
    next_online, next_target = torch.tensor([[0.0, 1.0], [2.0, 1.0]]), torch.tensor([[7.0, 7.0], [0.5, 9.0]])
    targets = double_q_targets(reached * 0.9 ** (ahead - 1), reached, next_online, next_target, 0.9**ahead)
    torch.testing.assert_close(targets, torch.tensor([0.81, 0.81 * 0.5]))
