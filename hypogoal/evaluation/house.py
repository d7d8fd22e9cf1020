"""The one table of results, and what is done with it: values of runs, means over runs, pairs of runs (Spec F5, H7)."""

import math
import tomllib
from collections.abc import Iterable, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from pandas import DataFrame
from pydantic_core import to_json
from scipy.special import bdtr, stdtrit

from hypogoal.core.files import reading

EVALUATE_AGAIN = "Evaluate the run again, with --force."
TYPES = {  # of the table's columns; a text is empty, an Int64 missing where it does not apply
    "quantity": "str",
    "value": "float",
    "method": "str",
    "sub_goal": "str",
    "member": "Int64",
    "scope": "str",
    "N": "Int64",
    "ladder": "str",
    "layout": "Int64",
    "seed": "Int64",
    "step": "Int64",
    "artefact": "str",
}
TEXTS = [name for name, kind in TYPES.items() if kind == "str"]
NUMBERS = [name for name, kind in TYPES.items() if kind != "str"]
SHARED = ["layout", "ladder", "sub_goal", "seed"]  # of two runs that are a pair
RUN = ["method", "artefact", "N", *SHARED]  # tells one run's numbers from another's
MEMBERS = {
    "best": "max",
    "mean": "mean",
    "worst": "min",
}  # how the values of members become one
LOWER_IS_BETTER = ("length", "solved_length", "distance")
DIGITS = 9  # rounding errors of sums of thousands of shares are far smaller, intended differences far larger
ROUNDING = 10.0**-DIGITS
RESAMPLES = 2_000
CONFIDENCE = 0.95
BOOTSTRAP_FROM = 8  # values: of 2 a bootstrap would hold in 49 % of cases, of 5 in 85 %


@cache
def shares() -> set[str]:
    """The quantities that lie within 0 and 1."""
    text = Path(__file__).with_name("quantities.toml").read_text(encoding="utf-8")
    return {name for name, (unit, _) in tomllib.loads(text).items() if unit == "fraction"}


def tidy(numbers: Any, **place: Any) -> DataFrame:
    """A row for each number by its name, all of one place (columns of the table)."""
    rows = DataFrame(numbers.items(), columns=["quantity", "value"])
    return rows.assign(**place)


def melted(
    columns: Any,
    index: Any = None,
    **place: Any,
) -> DataFrame:
    """A row for each value of each column, by the names of its ``index``; without any it is of each of K members."""
    table = DataFrame(columns)
    if index is not None:
        table = table.set_axis(index)
    if table.index.names == [None]:
        table = table.rename_axis("member")
    rows = table.reset_index().melt(table.index.names, var_name="quantity")
    return rows.assign(**place)


def options_of(config: Any) -> pd.MultiIndex:
    """The sub-goal and the member of each option of an artefact's ``config``, in order: an index of (G*K,) rows."""
    goals, members = config["sub_goals"], range(config["members"])
    return pd.MultiIndex.from_product([goals, members], names=["sub_goal", "member"])


def joined(parts: Iterable[DataFrame]) -> DataFrame:
    """The table of rows of several parts; a number that is not defined has no row."""
    return typed(pd.concat([DataFrame(columns=[*TYPES]), *parts]))


def typed(rows: DataFrame) -> DataFrame:
    """The same rows, with the columns and types that all others here expect."""
    rows = rows.reindex(columns=[*TYPES]).astype(object)
    rows[TEXTS] = rows[TEXTS].fillna("")
    rows = rows.astype(TYPES)
    return rows[np.isfinite(rows["value"])].reset_index(drop=True)


def read_numbers(path: Path) -> DataFrame:
    """``numbers.csv`` of this version, or of one with other columns; a ``UserError`` where it is missing or damaged."""
    nothing = dict.fromkeys(NUMBERS, "")
    with reading(path, EVALUATE_AGAIN, "the table of numbers"):
        rows = pd.read_csv(path, keep_default_na=False, na_values=nothing)
        return typed(rows.dropna(subset=["quantity", "value"]))


def per_run(
    numbers: DataFrame,
    *quantities: str,
    scope: str = "",
    member: str = "mean",
    name: str = "{}",
) -> DataFrame:
    """Quantities' final values in each run: columns ``RUN``, ``value``, ``quantity`` as tables call it, ``of`` which.

    ``member``: which of a run's members, ``best`` (the highest), ``mean`` or ``worst``, or the quantity whose value is
    the member's number, such as ``validated_member``. ``name``: what ``{}``, the quantity, is called.
    """
    final = numbers[numbers["step"].isna()]
    rows = final[final["quantity"].isin(quantities) & (final["scope"] == scope)]
    if member not in MEMBERS:
        picked = final[final["quantity"] == member].drop_duplicates(RUN)
        picked = picked[RUN].assign(member=picked["value"].astype("Int64"))
        rows = rows.merge(picked, on=[*RUN, "member"])
    values = rows.groupby([*RUN, "quantity"], dropna=False, sort=False)["value"]
    runs = values.agg(MEMBERS.get(member, "mean")).reset_index()
    return runs.assign(of=runs["quantity"], quantity=runs["quantity"].map(name.format))


def student_interval(values: Any) -> tuple[float, float]:
    """Spec F5: Student's 95 % interval of the mean of (n,) independent values; NaN for fewer than two."""
    numbers = pd.Series(values, dtype=float)
    wide = stdtrit(len(numbers) - 1, (1 + CONFIDENCE) / 2) * numbers.sem()
    return numbers.mean() - wide, numbers.mean() + wide


def interval(values: Any) -> tuple[float, float]:
    """Spec F5: a 95 % interval of (n,) independent values; NaN for fewer than two.

    Below 8 values Student's, of the mean. From 8 on a percentile bootstrap of the interquartile mean.
    """
    if len(values) < BOOTSTRAP_FROM:
        return student_interval(values)
    from scipy.stats import bootstrap  # takes longer to import than all else here

    drawn = bootstrap(
        [values],
        interquartile_mean,
        n_resamples=RESAMPLES,
        confidence_level=CONFIDENCE,
        method="percentile",
        rng=np.random.default_rng(0),
    )
    low, high = drawn.confidence_interval
    return float(low), float(high)


def interquartile_mean(values: Any, axis: int = 0) -> Any:
    """Spec F5: the mean of the middle half: a quarter of the values, rounded down, is cut off at either end."""
    count = values.shape[axis]
    middle = range(count // 4, count - count // 4)
    return np.sort(values, axis).take(middle, axis).mean(axis)


def tables_of(
    runs: DataFrame,
    by: Sequence[str],
    paired: Sequence[str] = (),
) -> dict[str, DataFrame]:
    """What a question's template is given of :func:`per_run`: ``table``, and ``compared``; nothing without runs."""
    if runs.empty:
        return {}
    return {
        "table": over(runs, by),
        "compared": runs[runs["quantity"].isin(paired)],
    }


def over(runs: DataFrame, by: Sequence[str]) -> DataFrame:
    """Spec F5: a row of statistics for each combination of ``by`` and each quantity of :func:`per_run`.

    The values are layouts, each by the mean of its runs or, with one layout, the runs. Columns: ``by``, ``quantity``,
    mean, standard_error and standard_deviation (n - 1), iqm, low, high (95 %), n (runs), units (values). Bounds of
    shares lie within 0 and 1.
    """
    names = [*by, "quantity"]
    rows = []
    for key, cell in runs.groupby(names, dropna=False, sort=False):
        labels = dict(zip(names, key, strict=True))
        rows.append(labels | statistics(cell))
    return DataFrame(rows)


def statistics(runs: DataFrame) -> dict[str, float]:
    """See :func:`over`: of runs that are alike."""
    values = runs["value"]
    if runs["layout"].nunique() > 1:
        values = values.groupby(runs["layout"], sort=False).mean()
    low, high = interval(values.to_numpy())
    if runs["of"].iloc[0] in shares():
        low, high = np.clip([low, high], 0, 1)
    return {
        "mean": values.mean(),
        "standard_error": values.sem(),
        "standard_deviation": values.std(),
        "iqm": interquartile_mean(values.to_numpy()),
        "low": low,
        "high": high,
        "n": len(runs),
        "units": len(values),
    }


def pairs(runs: DataFrame) -> DataFrame:
    """Spec F5: the first method against each other by each quantity, at each N, over runs that share ``SHARED``.

    Pairs that share layout, data and first weights tell more than two means: these may differ by one run. Columns: N,
    quantity, first, second, and those of :func:`compare`.
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
    """A row for each two runs that agree in ``on``; the second's columns end with ``_second``."""
    return first.merge(second, on=list(on), suffixes=("", "_second"))


def compare(both: DataFrame, unit: str = "layout") -> dict[str, Any]:
    """Spec F5: the first of two methods against the second over n pairs of runs, see :func:`paired`.

    Pairs of one unit (a column: the layout, or the seed where there is one layout) are not independent: everything but
    the counts is over units, each of which counts once, by its mean. A tie counts half of an improvement.

    Returns:
        first and second, their names and mean_first and mean_second; n, units (how many), unit (of what), wins, ties,
        probability (of improvement) with probability_low and _high, difference (mean of first - second) with
        difference_low and _high (Student's 95 %, of shares cut at -1 and 1), sign_test (two-sided p, ties left out),
        and higher, whether that is better. Intervals are NaN for one unit.
    """
    unit = unit if both[unit].nunique() > 1 else "seed"
    quantity = both["of"].iloc[0]
    higher = quantity not in LOWER_IS_BETTER
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
    result = {
        "first": both["method"].iloc[0],
        "second": both["method_second"].iloc[0],
        "n": len(both),
        "units": len(by_unit),
        "unit": unit,
        "wins": int((better > 0).sum()),
        "ties": int((better == 0).sum()),
        "sign_test": sign_test(won, lost),
        "higher": higher,
        **by_unit.mean(),
    }
    widest = 1 if quantity in shares() else math.inf
    for name, least, most in (("probability", 0, 1), ("difference", -widest, widest)):
        result[f"{name}_low"], result[f"{name}_high"] = np.clip(student_interval(by_unit[name]), least, most)
    return result


def sign_test(won: int, lost: int) -> float:
    """The two-sided p of so uneven a count where neither is better; NaN without any."""
    decided = won + lost
    return min(1.0, 2 * bdtr(min(won, lost), decided, 0.5)) if decided else math.nan


def at_least(values: Any, bound: Any) -> Any:
    """Whether values (...) are at least ``bound`` (...), up to rounding, as .3 - .1 is .2: bool (...)."""
    return values >= bound - ROUNDING


def above(values: Any, bound: Any) -> Any:
    """Whether values (...) exceed ``bound`` (...) by more than rounding: bool (...)."""
    return values > bound + ROUNDING


def as_json(facts: Any) -> str:
    """Text of facts and numbers, NumPy's too; NaN becomes null."""
    return to_json(
        facts,
        indent=1,
        inf_nan_mode="null",
        fallback=np.generic.item,
    ).decode()
