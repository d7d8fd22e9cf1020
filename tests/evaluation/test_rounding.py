"""Bounds that are decimals, met exactly."""

import math

import numpy as np

from hypogoal.evaluation.numbers import above, at_least


def test_what_misses_a_bound_by_rounding_meets_it() -> None:
    """Every difference of two hundredths against every other, as exact fractions compare; NaN meets none."""
    hundredths = np.arange(101)
    upper, lower = np.meshgrid(hundredths, hundredths)
    for bound in hundredths.tolist():
        assert (at_least(upper / 100 - lower / 100, bound / 100) == (upper - lower >= bound)).all()
        assert (above(upper / 100 - lower / 100, bound / 100) == (upper - lower > bound)).all()
    assert not at_least(0.2 - 1e-6, 0.2) and not at_least(math.nan, 0.0) and not above(math.nan, 0.0)
