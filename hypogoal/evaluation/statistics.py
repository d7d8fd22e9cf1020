"""Numbers over runs (Spec F5): mean and standard error, and the interquartile mean with a bootstrap interval."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import binomtest, bootstrap, trim_mean

RESAMPLES = 2_000
CONFIDENCE = 0.95


def mean_and_error(values: NDArray[np.float64]) -> tuple[float, float]:
    """Spec F5: mean and standard error of the mean (n - 1 in the variance) of (n,); the error of one value is NaN."""
    if len(values) == 0:
        return float("nan"), float("nan")
    error = float(values.std(ddof=1) / np.sqrt(len(values))) if len(values) > 1 else float("nan")
    return float(values.mean()), error


def interquartile_mean(values: NDArray[np.float64], axis: int = -1) -> Any:
    """Spec F5: the mean of the middle half (a quarter of the values, rounded down, is cut off at either end)."""
    return trim_mean(values, 0.25, axis=axis)


def bootstrap_interval(
    values: NDArray[np.float64],
    strata: Sequence[Hashable],
    rng: np.random.Generator,
    statistic: Callable[..., Any] = interquartile_mean,
) -> tuple[float, float, str]:
    """Spec F5: 95 % percentile bootstrap interval of the interquartile mean, or of another statistic.

    Runs are drawn again within their stratum (a layout), so the interval speaks of these layouts with other seeds.
    Where a layout has a single run there is nothing to draw within it: then runs are drawn from all of them, and the
    interval speaks of other layouts too.

    Args:
        values: float (n,), one per run.
        strata: n hashable marks.
        rng: draws the resamples.
        statistic: takes values and ``axis``.

    Returns:
        Lower and upper bound, NaN for fewer than two runs, and over what was resampled.
    """
    if len(values) < 2:
        return float("nan"), float("nan"), "one run: no interval"
    marks = sorted(set(strata), key=str)
    groups = [values[[mark == own for own in strata]] for mark in marks]
    if min(len(group) for group in groups) < 2:
        groups, over = [values], "runs"
    else:
        over = "runs within layouts" if len(groups) > 1 else "runs"
    if np.ptp(values) == 0:
        return float(values[0]), float(values[0]), over

    def together(*resampled: NDArray[np.float64], axis: int = -1) -> Any:
        return statistic(np.concatenate(resampled, axis=axis), axis=axis)

    found = bootstrap(
        groups,
        together,
        n_resamples=RESAMPLES,
        confidence_level=CONFIDENCE,
        method="percentile",
        vectorized=True,
        rng=rng,
    ).confidence_interval
    return float(found.low), float(found.high), over


def aggregate(
    values: Sequence[float], strata: Sequence[Hashable], unit: str, rng: np.random.Generator
) -> dict[str, Any]:
    """Spec F5: everything said of a number over runs. Runs whose number is NaN are left out and ``n`` says so.

    Returns:
        mean, standard_error, iqm, interval (95 %, of the iqm), interval_over, n, unit.
    """
    known = np.array([value for value in values if not np.isnan(value)], dtype=np.float64)
    marks = [mark for value, mark in zip(values, strata, strict=True) if not np.isnan(value)]
    mean, error = mean_and_error(known)
    low, high, over = bootstrap_interval(known, marks, rng)
    return {
        "mean": mean,
        "standard_error": error,
        "iqm": float(interquartile_mean(known)) if len(known) else float("nan"),
        "interval": [low, high],
        "interval_over": over,
        "n": len(known),
        "unit": unit,
    }


def aggregate_with_deviation(
    values: Sequence[float], strata: Sequence[Hashable], unit: str, rng: np.random.Generator
) -> dict[str, Any]:
    """Spec F1, F3: :func:`aggregate` and the standard deviation over runs (n - 1), the bands of Figures 3 and 4."""
    known = np.array([value for value in values if not np.isnan(value)], dtype=np.float64)
    deviation = float(known.std(ddof=1)) if len(known) > 1 else float("nan")
    return {**aggregate(values, strata, unit, rng), "standard_deviation": deviation}


def compare_pairs(
    first: NDArray[np.float64],
    second: NDArray[np.float64],
    units: Sequence[Hashable],
    rng: np.random.Generator,
    *,
    within: bool = False,
    higher: bool = True,
) -> dict[str, Any]:
    """Spec F5: the first of two methods against the second over n pairs of runs that share layout and seed.

    The probability of improvement is the share of pairs in which the first is better, a tie counting half. Pairs of one
    unit (one seed's ensemble on several ladders, one layout with several seeds) are not independent: interval and sign
    test are over units, each of which counts once, by its mean. Where one wins every pair there is nothing to resample
    and the interval has no width, so the sign test stands beside it, which few units cannot make small.

    Args:
        first: float (n,), pair by pair; pairs with a NaN are left out.
        second: float (n,), of the other method.
        units: n hashable marks.
        rng: draws the resamples.
        within: the intervals, not the sign test, are drawn within units where each has several pairs: they speak of
            these layouts with other seeds (see :func:`bootstrap_interval`).
        higher: the better value is the higher one.

    Returns:
        n, units (how many), wins, ties, probability, interval (95 %) and interval_over, difference (mean of
        first - second) and difference_interval (95 %), sign_test (two-sided p, ties left out). NaN without pairs.
    """
    known = ~(np.isnan(first) | np.isnan(second))
    marks = [mark for mark, one in zip(units, known, strict=True) if one]
    difference = first[known] - second[known]
    better = np.sign(difference if higher else -difference)
    scores = (1 + better) / 2
    count, wins, ties = len(scores), int((better > 0).sum()), int((better == 0).sum())
    of_units, differences = (_by_unit(values, marks) for values in (scores, difference))
    if within:
        low, high, over = bootstrap_interval(scores, marks, rng, np.mean)
        *around, _ = bootstrap_interval(difference, marks, rng, np.mean)
    else:
        nothing = [0] * len(of_units)
        low, high, over = bootstrap_interval(of_units, nothing, rng, np.mean)
        *around, _ = bootstrap_interval(differences, nothing, rng, np.mean)
    won, lost = int((of_units > 0.5).sum()), int((of_units < 0.5).sum())
    return {
        "n": count,
        "units": len(of_units),
        "wins": wins,
        "ties": ties,
        "probability": float(scores.mean()) if count else float("nan"),
        "interval": [low, high],
        "interval_over": over,
        "difference": float(difference.mean()) if count else float("nan"),
        "difference_interval": list(around),
        "sign_test": float(binomtest(won, won + lost).pvalue) if won + lost else float("nan"),
    }


def _by_unit(values: NDArray[np.float64], marks: Sequence[Hashable]) -> NDArray[np.float64]:
    """The mean of each unit's values, in the order in which units come."""
    return np.array([values[[mark == own for own in marks]].mean() for mark in dict.fromkeys(marks)], dtype=np.float64)
