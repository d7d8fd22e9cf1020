"""The study that scores audits: its enumerated truth on cases whose value is forced."""

from __future__ import annotations

import numpy as np
import pytest

from studies.audits import CAPS, NEVER, SIDE, WORLDS, payable, states_of

FIELD = len(WORLDS) - 1
MIDDLE = SIDE // 2


def cell(x: int, y: int) -> int:
    return x * SIDE + y


@pytest.mark.parametrize(
    ("positive", "steps"),
    [
        ([], NEVER),
        ([cell(MIDDLE, MIDDLE + 1)], 1),
        ([cell(3, 5)], MIDDLE - 3 + MIDDLE - 5),  # in the open: as many steps as columns and rows
        ([cell(0, 0)], 2 * MIDDLE),  # exactly the cap
        ([cell(MIDDLE, MIDDLE)], 2),  # a start inside: there and back
        ([cell(MIDDLE, MIDDLE + 2), cell(MIDDLE, MIDDLE + 1)], 1),
    ],
)
def test_steps_to_a_false_positive_in_the_field(positive: list[int], steps: int) -> None:
    states = states_of(FIELD, 0)
    says = states.truth.copy()
    says[positive] = True
    assert payable(states, says, CAPS[FIELD]) == steps


def test_what_lies_behind_success_or_beyond_the_cap_pays_nobody() -> None:
    """The corner is success; of what only leads through it no execution comes to, nor of what is farther than asked."""
    states = states_of(FIELD, 0)
    corner = SIDE - 1
    assert states.truth[cell(corner, corner)] and not states.truth[cell(0, 0)]
    says = states.truth.copy()
    says[cell(0, 0)] = True
    assert payable(states, says, 2 * MIDDLE - 1) == NEVER
    walled = np.zeros_like(says)
    for x, y in ((0, 1), (1, 0)):
        walled[cell(x, y)] = True
    says |= walled
    assert payable(states, says, CAPS[FIELD]) == 2 * MIDDLE - 1, "the wall itself is a false positive"
