"""The one table of results, and what is done with it: values of runs, means over runs, pairs of runs (Spec F5, H7)."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.special import stdtrit
from scipy.stats import binomtest, bootstrap, trim_mean

from hypogoal.core.errors import UserError

EVALUATE_AGAIN = "Evaluate the run again, with --force."
TEXTS = ("method", "sub_goal", "scope", "ladder", "artefact")  # columns, empty where they do not apply
WHOLE = ("member", "N", "layout", "seed", "step")  # columns of whole numbers, missing where they do not apply
COLUMNS = (
    "quantity",
    "value",
    "method",
    "sub_goal",
    "member",
    "scope",
    "N",
    "ladder",
    "layout",
    "seed",
    "step",
    "artefact",
)
RUN = ["method", "artefact", "layout", "seed", "sub_goal", "ladder", "N"]  # tells one run's numbers from another's
SHARED = ["layout", "ladder", "sub_goal", "seed"]  # of two runs that are a pair
MEMBERS = {"best": "max", "mean": "mean", "worst": "min"}  # how the values of members become one
LOWER_IS_BETTER = ("length", "solved_length", "distance")
DIGITS = 9  # rounding errors of sums of thousands of shares are far smaller, intended differences far larger
ROUNDING = 10.0**-DIGITS
RESAMPLES = 2_000
CONFIDENCE = 0.95
BOOTSTRAP_FROM = 8  # values: of 2 a bootstrap would hold in 49 % of cases, of 5 in 85 %
STATISTICS = ("mean", "standard_error", "standard_deviation", "iqm", "low", "high", "interval_over", "n")
STUDENT, BOOTSTRAP, NOTHING = "Student's t of the mean", "bootstrap of the interquartile mean", "no interval"


@cache
def units() -> dict[str, str]:
    """The unit of each quantity."""
    text = resources.files("hypogoal.evaluation").joinpath("quantities.toml").read_text(encoding="utf-8")
    return {name: unit for name, (unit, _) in tomllib.loads(text).items()}


def tidy(numbers: Mapping[str, float | None], **place: Any) -> pd.DataFrame:
    """A row for each number, all of one place (fields of ``COLUMNS``)."""
    rows = pd.DataFrame({"quantity": list(numbers), "value": list(numbers.values())})
    return rows.assign(**place)


def tidy_members(columns: Mapping[str, NDArray[Any]], **place: Any) -> pd.DataFrame:
    """A row for each of K members' value of each column, (K,)."""
    members = pd.DataFrame(columns).rename_axis("member").reset_index()
    return members.melt("member", var_name="quantity").assign(**place)


def joined(parts: Iterable[pd.DataFrame]) -> pd.DataFrame:
    """Rows of several parts, with every column; a number that is not defined has no row."""
    filled = [part for part in parts if len(part)]
    rows = pd.concat(filled) if filled else pd.DataFrame()
    return typed(rows.reindex(columns=list(COLUMNS)))


def typed(rows: pd.DataFrame) -> pd.DataFrame:
    """The same rows, their columns of the types that all others here expect."""
    for name in TEXTS:
        rows[name] = rows[name].astype(object).fillna("")
    rows = rows.astype({"value": float, **dict.fromkeys(TEXTS, "str"), **dict.fromkeys(WHOLE, "Int64")})
    return rows[np.isfinite(rows["value"])].reset_index(drop=True)


def read_numbers(path: Path) -> pd.DataFrame:
    """``numbers.csv``, whichever columns a later version has added; a ``UserError`` where it is missing or damaged."""
    try:
        return typed(pd.read_csv(path, keep_default_na=False, na_values=dict.fromkeys(("value", *WHOLE), "")))
    except OSError as error:
        raise UserError(f"the table of numbers cannot be read ({error.strerror})", path, EVALUATE_AGAIN) from None
    except (ValueError, KeyError, TypeError) as error:
        raise UserError(f"the table of numbers is damaged ({error})", path, EVALUATE_AGAIN) from None


def per_run(
    numbers: pd.DataFrame, quantity: str, scope: str = "", member: str = "mean", name: str = ""
) -> pd.DataFrame:
    """A quantity's final value in each run: columns ``RUN``, ``value``, ``of``, and ``quantity``, what tables call it.

    ``member``: which of a run's members, ``best`` (the highest), ``mean`` or ``worst``, or the quantity whose value is
    the member's number, such as ``validated_member``.
    """
    final = numbers[numbers["step"].isna()]
    rows = final[(final["quantity"] == quantity) & (final["scope"] == scope)]
    if member not in MEMBERS:
        picked = final[final["quantity"] == member].drop_duplicates(RUN)
        picked = picked[RUN].assign(member=picked["value"].astype("Int64"))
        rows = rows.merge(picked, on=[*RUN, "member"])
    how = MEMBERS.get(member, "mean")
    runs = rows.groupby(RUN, dropna=False, sort=False)["value"].agg(how).reset_index()
    return runs.assign(of=quantity, quantity=name or quantity)


def student_interval(values: NDArray[Any]) -> tuple[float, float]:
    """Spec F5: Student's 95 % interval of the mean of (n,) independent values; NaN for fewer than two."""
    if len(values) < 2:
        return math.nan, math.nan
    error = values.std(ddof=1) / np.sqrt(len(values))
    wide = float(stdtrit(len(values) - 1, (1 + CONFIDENCE) / 2) * error)
    return float(values.mean()) - wide, float(values.mean()) + wide


def interquartile_mean(values: NDArray[np.float64], axis: int = -1) -> Any:
    """Spec F5: the mean of the middle half: a quarter of the values, rounded down, is cut off at either end."""
    return trim_mean(values, 0.25, axis=axis)


def interval(values: NDArray[np.float64]) -> tuple[float, float, str]:
    """Spec F5: a 95 % interval of (n,) independent values, and its kind; NaN for fewer than two.

    Below 8 values Student's, of the mean. From 8 on a percentile bootstrap of the interquartile mean.
    """
    if len(values) < BOOTSTRAP_FROM:
        return *student_interval(values), STUDENT if len(values) > 1 else NOTHING
    drawn = bootstrap(
        [values],
        interquartile_mean,
        n_resamples=RESAMPLES,
        confidence_level=CONFIDENCE,
        method="percentile",
        vectorized=True,
        rng=np.random.default_rng(0),
    )
    bounds = drawn.confidence_interval
    return float(bounds.low), float(bounds.high), BOOTSTRAP


def over(runs: pd.DataFrame, by: Sequence[str]) -> pd.DataFrame:
    """Spec F5: a row of statistics for each combination of ``by`` and each quantity of :func:`per_run`.

    The values are layouts, each by the mean of its runs or, with one layout, the runs. Columns: ``by``, ``quantity``,
    mean, standard_error and standard_deviation (n - 1), iqm, low, high (95 %), interval_over (what the values are and
    the interval's kind), n (runs). Bounds of shares lie within 0 and 1.
    """
    rows = []
    names = [*by, "quantity"]
    for key, cell in runs.groupby(names, dropna=False, sort=False):
        several = cell["layout"].nunique() > 1
        column = cell.groupby("layout", sort=False)["value"].mean() if several else cell["value"]
        values = column.to_numpy(np.float64)
        low, high, kind = interval(values)
        if units().get(cell["of"].iloc[0]) == "fraction":
            low, high = np.clip([low, high], 0, 1).tolist()
        deviation = values.std(ddof=1) if len(values) > 1 else math.nan
        statistics = {
            "mean": values.mean(),
            "standard_error": deviation / np.sqrt(len(values)),
            "standard_deviation": deviation,
            "iqm": interquartile_mean(values),
            "low": low,
            "high": high,
            "interval_over": f"{'layouts' if several else 'runs'}: {kind}",
            "n": len(cell),
        }
        rows.append(dict(zip(names, key, strict=True)) | statistics)
    return pd.DataFrame(rows, columns=[*names, *STATISTICS])


def pairs(runs: pd.DataFrame) -> pd.DataFrame:
    """Spec F5: the first method against each other by each quantity, at each N, over runs that share ``SHARED``.

    Pairs that share layout, data and first weights tell more than two means: these may differ by one run. Runs alike in
    all of ``SHARED`` are paired in order. Columns: N, quantity, first, second, and those of :func:`compare`.
    """
    rows = []
    copies = runs.groupby(["method", "quantity", "N", *SHARED], dropna=False).cumcount()
    runs = runs.assign(copy=copies)
    for (groups, quantity), alike in runs.groupby(["N", "quantity"], dropna=False, sort=False):
        methods = alike["method"].unique()
        first = alike[alike["method"] == methods[0]]
        for method in methods[1:]:
            second = alike[alike["method"] == method]
            both = first.merge(second, on=[*SHARED, "copy"], suffixes=("", "_second"))
            if both.empty:
                continue
            several = both["layout"].nunique() > 1
            of_unit = both["layout"] if several else both["seed"].astype(str) + "/" + both["copy"].astype(str)
            higher = alike["of"].iloc[0] not in LOWER_IS_BETTER
            compared = compare(both["value"], both["value_second"], of_unit, higher=higher)
            rows.append({"N": groups, "quantity": quantity, "first": methods[0], "second": method} | compared)
    return pd.DataFrame(rows) if rows else pd.DataFrame(columns=["N", "quantity", "first", "second"])


def compare(first: pd.Series, second: pd.Series, unit: pd.Series, *, higher: bool = True) -> dict[str, Any]:
    """Spec F5: the first of two methods against the second over n pairs of runs, (n,) each, ``unit`` whose they are.

    Pairs of one unit (one ensemble on several ladders, one layout with several seeds) are not independent: everything
    but the counts is over units, each of which counts once, by its mean. A tie counts half of an improvement.

    Returns:
        n, units (how many), wins, ties, probability (of improvement) with probability_low and _high, difference (mean
        of first - second) with difference_low and _high (Student's 95 %), sign_test (two-sided p, ties left out), and
        higher, whether that is better. Intervals are NaN for one unit.
    """
    difference = first - second
    better = pd.Series(np.sign(difference.round(DIGITS))) * (1 if higher else -1)
    marks = unit.to_numpy()
    scores = ((1 + better) / 2).groupby(marks, sort=False).mean().to_numpy(np.float64)
    differences = difference.groupby(marks, sort=False).mean().to_numpy(np.float64)
    won, lost = int((scores > 0.5).sum()), int((scores < 0.5).sum())
    low, high = np.clip(np.array(student_interval(scores)), 0, 1).tolist()
    difference_low, difference_high = student_interval(differences)
    return {
        "n": len(difference),
        "units": len(scores),
        "wins": int((better > 0).sum()),
        "ties": int((better == 0).sum()),
        "probability": scores.mean(),
        "probability_low": low,
        "probability_high": high,
        "difference": differences.mean(),
        "difference_low": difference_low,
        "difference_high": difference_high,
        "sign_test": float(binomtest(won, won + lost).pvalue) if won + lost else math.nan,
        "higher": higher,
    }


def at_least(values: Any, bound: Any) -> Any:
    """Whether values (...) are at least ``bound`` (...), up to rounding, as .3 - .1 is .2: bool (...)."""
    return values >= bound - ROUNDING


def above(values: Any, bound: Any) -> Any:
    """Whether values (...) exceed ``bound`` (...) by more than rounding: bool (...)."""
    return values > bound + ROUNDING


def plain(value: Any) -> Any:
    """JSON-ready: NaN becomes null, NumPy numbers become Python's."""
    if isinstance(value, Mapping):
        return {str(key): plain(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [plain(inner) for inner in value]
    if isinstance(value, np.generic):
        value = value.item()
    return None if isinstance(value, float) and not math.isfinite(value) else value


def mean_of(values: Any) -> float:
    """The mean of (n,), NaN where there are none."""
    numbers = np.asarray(values)
    return float(numbers.mean()) if len(numbers) else math.nan
