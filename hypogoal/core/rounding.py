"""Comparisons with decimal bounds: .3 - .1 is less than .2 in floating point, but at least .2 here. NaN meets none."""

from typing import Any

DIGITS = 9  # rounding errors of sums of thousands of shares are far smaller, intended differences far larger
ROUNDING = 10.0**-DIGITS


def at_least(values: Any, bound: Any) -> Any:
    """Whether values (...) are at least ``bound`` (...), up to rounding: bool (...)."""
    return values >= bound - ROUNDING


def above(values: Any, bound: Any) -> Any:
    """Whether values (...) exceed ``bound`` (...) by more than rounding: bool (...)."""
    return values > bound + ROUNDING
