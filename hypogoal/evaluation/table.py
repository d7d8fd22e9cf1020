"""The one table of results: its columns, how numbers become its rows, and each run's final values."""

import tomllib
from collections.abc import Iterable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from pandas import DataFrame

from hypogoal.core.config import Values
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


def options_of(config: Values) -> pd.MultiIndex:
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
