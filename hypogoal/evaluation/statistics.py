"""Means over runs, intervals that hold as often as they say, pairs of runs, and equality up to rounding."""

import math
from collections.abc import Sequence
from functools import cache
from typing import Any

import numpy as np
from pandas import DataFrame
from scipy.special import bdtr

from hypogoal.core.arrays import Doubles
from hypogoal.evaluation.table import SHARED, shares

LOWER_IS_BETTER = ("length", "solved_length", "distance")
DIGITS = 9  # rounding errors of sums of thousands of shares are far smaller, intended differences far larger
ROUNDING = 10.0**-DIGITS
TAILS = (0.025, 0.975)  # quantiles of a 95 % interval
RESAMPLES = 20_000
SHARES_FROM, MEDIANS_FROM = 3, 6  # least values of an interval; ``studies/coverage.py`` simulates how often it holds


def tables_of(
    runs: DataFrame,
    by: Sequence[str],
    paired: Sequence[str] = (),
) -> dict[str, DataFrame]:
    """Return ``table`` and ``compared`` for a question, of :func:`table.per_run`. Without runs, return nothing."""
    if runs.empty:
        return {}
    return {
        "table": over(runs, by),
        "compared": runs[runs["quantity"].isin(paired)],
    }


def over(runs: DataFrame, by: Sequence[str]) -> DataFrame:
    """Return a row of statistics for each combination of ``by`` and each quantity of :func:`table.per_run`.

    The values are layouts, each by the mean of its runs or, with one layout, the runs. Columns: ``by``, ``quantity``,
    mean, standard_error and standard_deviation (n - 1); estimate, the mean of shares and the median of all else, and
    its 95 % interval, low and high, see :func:`interval`; n (runs), units (values).
    """
    names = [*by, "quantity"]
    rows = []
    for key, cell in runs.groupby(names, dropna=False, sort=False):
        labels = dict(zip(names, key, strict=True))
        rows.append(labels | statistics(cell))
    return DataFrame(rows)


def statistics(runs: DataFrame) -> dict[str, Any]:
    """Return the statistics of runs that are alike, see :func:`over`."""
    values = runs["value"]
    if runs["layout"].nunique() > 1:
        values = values.groupby(runs["layout"], sort=False).mean()
    are_shares = runs["of"].iloc[0] in shares()
    low, high = interval(values.to_numpy(), are_shares=are_shares)
    return {
        "mean": values.mean(),
        "standard_error": values.sem(),
        "standard_deviation": values.std(),
        "estimate": values.mean() if are_shares else values.median(),
        "low": low,
        "high": high,
        "n": len(runs),
        "units": len(values),
    }


def interval(values: Doubles, *, are_shares: bool) -> tuple[float, float]:
    """Return a 95 % interval of (n,) independent values, or NaN if there are too few.

    Shares, at least ``SHARES_FROM``, have the interval of :func:`bounded`. All else, at least ``MEDIANS_FROM`` values,
    has that of :func:`median_bounds`.
    """
    least, bounds = (SHARES_FROM, bounded) if are_shares else (MEDIANS_FROM, median_bounds)
    return bounds(values) if len(values) >= least else (math.nan, math.nan)


def bounded(values: Doubles, least: float = 0.0) -> tuple[float, float]:
    """Return bounds of the mean of (n,) values between ``least`` and 1: Gaffke's 95 % interval (2005).

    Each value is weighted by one of the gaps that n random numbers leave within 0 and 1. The remaining gap is the
    weight of a value that was not seen, which is ``least`` for the lower end and 1 for the upper end. Of zeros and
    ones, the interval is Clopper and Pearson's.
    """
    weights = gaps(len(values))
    weighed = weights[:, 1:] @ np.sort(values)
    low = np.quantile(weighed + weights[:, 0] * least, TAILS[0])
    high = np.quantile(weighed + weights[:, 0], TAILS[1])
    return float(low), min(float(high), 1.0)  # rounding may exceed 1


@cache
def gaps(count: int) -> Doubles:
    """Return the gaps that ``count`` uniform numbers leave within 0 and 1, drawn again and again.

    The result is float64 (RESAMPLES, count + 1).
    """
    return np.random.default_rng(0).dirichlet(np.ones(count + 1), RESAMPLES)


def median_bounds(values: Doubles) -> tuple[float, float]:
    """Return bounds of the median of (n,) values: two of the values, so far apart that the median is rarely outside.

    At n = 10 these are the second and the ninth value, since at most one of ten lies below the median in 1 % of cases.
    Without ties the interval excludes 0 if and only if the sign test does (p < .05).
    """
    count = len(values)
    ordered = np.sort(values)
    below = bdtr(np.arange(count), count, 0.5)  # P(at most k of ``count`` values lie below the median), by k
    outside = int((below < TAILS[0]).sum())
    return float(ordered[outside - 1]), float(ordered[-outside])


def pairs(runs: DataFrame) -> DataFrame:
    """Return the first method against each other by each quantity, at each N, over runs that share ``SHARED``.

    Pairs that share layout, data and first weights tell more than two means, which may differ because of one run.
    Columns: N, quantity, first, second, and those of :func:`compare`.
    """
    rows = []
    for (groups, quantity), cell in runs.groupby(["N", "quantity"], dropna=False, sort=False):
        place = {
            "N": groups,
            "quantity": quantity,
        }
        (_, first), *others = cell.groupby("method", sort=False)
        for _, second in others:
            both = paired(first, second, SHARED)
            if len(both):
                rows.append(place | compare(both))
    return DataFrame(rows)


def paired(
    first: DataFrame,
    second: DataFrame,
    on: Sequence[str],
) -> DataFrame:
    """Return a row for each two runs that agree in ``on``. The second run's columns end with ``_second``."""
    return first.merge(second, on=list(on), suffixes=("", "_second"))


def compare(both: DataFrame, unit: str = "layout") -> dict[str, Any]:
    """Compare the first of two methods with the second over n pairs of runs, see :func:`paired`.

    Pairs of one unit (a column: the layout, or the seed where there is one layout) are not independent. So everything
    but the counts is over units, each of which counts once, by its mean. A tie counts half of an improvement.

    Returns:
        first and second, their names and mean_first and mean_second; n, units (how many), unit (of what), wins, ties,
        probability (of improvement) with probability_low and _high, difference (median of first - second) with
        difference_low and _high (95 %) and _least and _most (of all units), sign_test (two-sided p, ties left out),
        and higher, whether higher values are better. Intervals are NaN for too few units, see :func:`interval`.
    """
    unit = unit if both[unit].nunique() > 1 else "seed"
    higher = both["of"].iloc[0] not in LOWER_IS_BETTER
    difference = both["value"] - both["value_second"]
    better = np.sign(difference.round(DIGITS)) * (1 if higher else -1)
    columns: dict[str, Any] = {
        "mean_first": both["value"],
        "mean_second": both["value_second"],
        "probability": (1 + better) / 2,
        "difference": difference,
    }
    by_unit = both[[unit]].assign(**columns).groupby(unit, sort=False).mean()
    won = int((by_unit["probability"] > 0.5).sum())
    lost = int((by_unit["probability"] < 0.5).sum())
    probability_low, probability_high = interval(by_unit["probability"].to_numpy(), are_shares=True)
    differences = by_unit["difference"]
    low, high = interval(differences.to_numpy(), are_shares=False)
    return {
        "first": both["method"].iloc[0],
        "second": both["method_second"].iloc[0],
        "n": len(both),
        "units": len(by_unit),
        "unit": unit,
        "wins": int((better > 0).sum()),
        "ties": int((better == 0).sum()),
        "sign_test": sign_test(won, lost),
        "higher": higher,
        **by_unit[["mean_first", "mean_second", "probability"]].mean(),
        "probability_low": probability_low,
        "probability_high": probability_high,
        "difference": differences.median(),
        "difference_low": low,
        "difference_high": high,
        "difference_least": differences.min(),
        "difference_most": differences.max(),
    }


def sign_test(won: int, lost: int) -> float:
    """Return the two-sided p of a count at least as uneven if neither is better, or NaN if both counts are 0."""
    decided = won + lost
    return min(1.0, 2 * bdtr(min(won, lost), decided, 0.5)) if decided else math.nan


def at_least(values: Any, bound: Any) -> Any:
    """Return whether values (...) are at least ``bound`` (...), up to rounding, as .3 - .1 is .2: bool (...)."""
    return values >= bound - ROUNDING


def above(values: Any, bound: Any) -> Any:
    """Return whether values (...) exceed ``bound`` (...) by more than rounding: bool (...)."""
    return values > bound + ROUNDING
