"""Bounds that are decimals: .3 - .1 is less than .2 in binary floating point, and meets it here. A NaN meets none."""

from typing import Any

DIGITS = 9  # rounding of sums of some thousand shares is far behind these, every difference that is meant far before
ROUNDING = 10.0**-DIGITS


def at_least(values: Any, bound: Any) -> Any:
    """Whether values (...) are ``bound`` (...) or more, rounding aside: bool (...)."""
    return values >= bound - ROUNDING


def above(values: Any, bound: Any) -> Any:
    """Whether values (...) are more than ``bound`` (...), and not by rounding alone: bool (...)."""
    return values > bound + ROUNDING
