"""Figure 2's measures on attributions whose true values are forced: ``studies.attention``."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from studies.attention import COLUMNS, REACH, SQUARE, alike, in_common, near, tables
from studies.cells import write_rows

SIDE = 12 * SQUARE


def attributions(*members: tuple[int, int, float]) -> np.ndarray:
    """Of one state, a pixel (row, column, value) for each member, in the second of two frames."""
    values = np.zeros((1, len(members), SIDE, SIDE, 2))
    for member, (row, column, value) in enumerate(members):
        values[0, member, row, column, 1] = value
    return values


def test_members_that_look_at_the_same_square_have_all_in_common_others_nothing() -> None:
    """Sign and size do not matter, the frame neither; a neighbouring pixel in another square is another part."""
    assert in_common(attributions((0, 0, 1), (SQUARE - 1, 3, -5))).tolist() == [1, 1]
    assert in_common(attributions((0, SQUARE - 1, 1), (0, SQUARE, 1))).tolist() == [0, 0]


def test_the_mean_is_over_the_other_members_and_over_states() -> None:
    """Three members, two of them alike: each of these has half in common with the others, the third nothing."""
    three = attributions((0, 0, 1), (1, 1, 1), (50, 50, 1))
    assert in_common(three).tolist() == [0.5, 0.5, 0]
    shared = attributions((0, 0, 1), (1, 1, 1), (2, 2, 1))
    assert in_common(np.concatenate([three, shared])).tolist() == [0.75, 0.75, 0.5]
    halves = attributions((0, 0, 1), (0, 0, 1)) + attributions((50, 50, 0), (50, 50, 3))
    assert in_common(halves).tolist() == pytest.approx([0.25, 0.25]), "the second gives this square a quarter"


def test_signed_attributions_are_alike_opposed_or_unrelated() -> None:
    """Whatever their size; within a square, for and against cancel."""
    assert alike(attributions((0, 0, 1), (SQUARE - 1, 3, 5))).tolist() == [1, 1]
    assert alike(attributions((0, 0, 1), (0, 1, -5))).tolist() == [-1, -1]
    assert alike(attributions((0, 0, 1), (50, 50, 1))).tolist() == [0, 0]
    both = attributions((0, 0, 4), (0, 0, 1)) + attributions((0, 1, -1), (50, 50, 1))
    assert alike(both).tolist() == pytest.approx([0.5**0.5] * 2)


def test_near_the_agent_is_a_share_of_all_attribution() -> None:
    """At the agent, just inside and just outside of its surroundings; spread evenly, it is their area."""
    places = np.array([[40.0, 30.0]])
    values = attributions((40, 30, 1), (40 + REACH, 30 - REACH, -2), (40 + REACH + 1, 30, 1))
    assert near(values, places).tolist() == [1, 1, 0]
    assert near(np.ones((1, 1, SIDE, SIDE, 4)), places)[0] == pytest.approx((2 * REACH + 1) ** 2 / SIDE**2)


def test_the_table_pairs_seeds(tmp_path: Path) -> None:
    """D-BAT's members have less in common by .1 on one seed and .3 on the other; the nearest one's ranking beside."""
    rows = [
        dict(
            zip(
                COLUMNS,
                (method, seed, 25, member, common, -common, 0.2 + 0.1 * member, 0.5 + 0.4 * member),
                strict=True,
            )
        )
        for method, commons in (("dbat", (0.5, 0.3)), ("none", (0.6, 0.6)))
        for seed, common in enumerate(commons)
        for member, near_agent in enumerate((0.2, 0.3))
    ]
    write_rows(tmp_path / "cells.csv", COLUMNS, rows)
    lines = [line for line in tables(tmp_path / "cells.csv") if line]
    assert "| -0.200 (-0.300 to -0.100) | -0.600 (-0.600 to -0.600) | 0.200 (0.100 to 0.300) |" in lines[-1]
    assert lines[-2].split(" | ")[6:] == [
        "0.200 (0.200 to 0.200)",
        "0.300 (0.300 to 0.300)",
        "0.900 (0.900 to 0.900)",
        "0.700 (0.700 to 0.700) |",
    ]
