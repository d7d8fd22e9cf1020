"""Transitions over several steps (Spec D2)."""

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from hypogoal.options.double_dqn import double_q_targets
from hypogoal.options.replay import Steps, StepsAhead


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
