"""Bounds that are decimals, met exactly."""

from __future__ import annotations

import math
from fractions import Fraction

import numpy as np
import pytest

from hypogoal.domains import montezuma_states
from hypogoal.evaluation.curves import NEAR, SOLVED
from hypogoal.evaluation.numbers import above, at_least


def test_what_misses_a_bound_by_rounding_meets_it() -> None:
    """Every difference of two hundredths against every other, as exact fractions compare; NaN meets none."""
    hundredths = np.arange(101)
    upper, lower = np.meshgrid(hundredths, hundredths)
    for bound in hundredths.tolist():
        assert (at_least(upper / 100 - lower / 100, bound / 100) == (upper - lower >= bound)).all()
        assert (above(upper / 100 - lower / 100, bound / 100) == (upper - lower > bound)).all()
    assert not (0.3 - 0.1 >= 0.2)  # which is what plain floats say
    assert at_least(0.3 - 0.1, 0.2)
    assert not at_least(0.2 - 1e-6, 0.2)
    assert not at_least(math.nan, 0.0) and not above(math.nan, 0.0)


@pytest.mark.parametrize(
    "share",
    [
        *(NEAR, SOLVED, *montezuma_states.KIND_SHARES.values(), montezuma_states.SPARE),
        *(montezuma_states.FEWEST_POSITIVES, montezuma_states.FEWEST_AT_A_BASE),
    ],
)
def test_shares_of_counts_need_no_tolerance(share: float) -> None:
    """Where a constant's share of a whole number is a whole number, floats hit it: these are compared as they are."""
    exact = Fraction(str(share))
    for count in range(5_000):
        if (exact * count).denominator == 1:
            assert share * count == exact * count
