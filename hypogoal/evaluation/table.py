"""The one table of results: its columns, how numbers become rows, and each run's final values."""

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
TYPES = {  # of the table's columns; if a column does not apply, a text is empty, and an Int64 missing
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
SHARED = ["layout", "ladder", "sub_goal", "seed"]  # columns in which the two runs of a pair agree
RUN = ["method", "artefact", "N", *SHARED]  # columns that tell the numbers of runs apart
MEMBERS = {
    "best": "max",
    "mean": "mean",
    "worst": "min",
}  # how the values of members become one


@cache
def shares() -> set[str]:
    """Return the quantities that lie within 0 and 1."""
    text = Path(__file__).with_name("quantities.toml").read_text(encoding="utf-8")
    return {name for name, (unit, _) in tomllib.loads(text).items() if unit == "fraction"}


def tidy(numbers: Any, **place: Any) -> DataFrame:
    """Return a row for each number by its name. All have the place given (columns of the table)."""
    rows = DataFrame(numbers.items(), columns=["quantity", "value"])
    return rows.assign(**place)


def melted(
    columns: Any,
    index: Any = None,
    **place: Any,
) -> DataFrame:
    """Return a row for each value of each column, by the names of ``index``. By default, the index is K members."""
    table = DataFrame(columns)
    if index is not None:
        table = table.set_axis(index)
    if table.index.names == [None]:
        table = table.rename_axis("member")
    rows = table.reset_index().melt(table.index.names, var_name="quantity")
    return rows.assign(**place)


def options_of(config: Values) -> pd.MultiIndex:
    """Return the sub-goal and the member of each option of an artefact's ``config``, in order: index (G*K,)."""
    goals, members = config["sub_goals"], range(config["members"])
    return pd.MultiIndex.from_product([goals, members], names=["sub_goal", "member"])


def joined(parts: Iterable[DataFrame]) -> DataFrame:
    """Return the table of the rows of several parts. A number that is not defined has no row."""
    return typed(pd.concat([DataFrame(columns=[*TYPES]), *parts]))


def typed(rows: DataFrame) -> DataFrame:
    """Return rows with all columns of the table and their types, without values that are not finite."""
    rows = rows.reindex(columns=[*TYPES]).astype(object)
    rows[TEXTS] = rows[TEXTS].fillna("")
    rows = rows.astype(TYPES)
    return rows[np.isfinite(rows["value"])].reset_index(drop=True)


def read_numbers(path: Path) -> DataFrame:
    """Return the table in ``numbers.csv``, whose columns may be those of another version.

    Raises ``UserError`` if the file is missing or damaged.
    """
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
    """Return the final values of quantities in each run: columns ``RUN``, ``value``, ``quantity`` and ``of``.

    ``member`` says which of a run's members counts: ``best`` (the highest), ``mean`` or ``worst``, or the quantity
    whose value is the member's number, such as ``validated_member``. ``of`` is the quantity in the table of numbers,
    and ``quantity`` is ``name`` with the quantity in place of ``{}``.
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
