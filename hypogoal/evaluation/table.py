"""The one table of results: its rows, and the algebra that every aggregate, pair and view of them derives from (F5).

Select rows, group them by their fields, reduce a run's members to one value, and put runs together: ``tabulate`` into
a table over runs, ``compared`` into pairs of runs, ``wide`` into the entries of ``metrics.json``.
"""

import csv
import io
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hypogoal.core.errors import UserError
from hypogoal.core.files import read_text
from hypogoal.evaluation.numbers import by_groups, grouped, method_rank, over, pairs

EVALUATE_AGAIN = "Evaluate the run again."
BEST, WORST, VALIDATED = "best_member", "worst_member", "validated_member"  # quantities: which member it is
MEMBERS: Mapping[str, Callable[[Any], Any]] = {"best": np.max, "mean": np.mean, "worst": np.min}
Entry = dict[str, Any]


class Row(NamedTuple):
    """One number of ``numbers.csv`` and its place; fields that do not apply are empty."""

    quantity: str  # see ``quantities.toml``
    value: float | int  # NaN where it is not defined: such rows are not written
    method: str = ""  # the ensemble's, or the agent's name
    sub_goal: str = ""
    member: int | str = ""
    scope: str = ""  # the states that it is over
    N: int | None = None  # labelled ladder groups
    ladder: str = ""
    layout: int | str = ""
    seed: int | str = ""  # of the training; ladder and layout too
    step: int | str = ""  # environment steps after which it was so
    artefact: str = ""  # its path within the run


Field = str | Callable[[Row], Any]


class Number(NamedTuple):
    """A number of each run: of which rows, and how the values of its members become one."""

    quantity: str
    scope: str = ""
    unit: str = "fraction"
    # best, mean, worst, or the quantity that says which member: ``VALIDATED``, say.
    member: str = "mean"
    higher: bool = True  # the better
    cell: tuple[str, ...] = ()  # names that seed the resamples, after the entry's; the column's where empty


@dataclass(frozen=True)
class Table:
    """A table over runs: an entry for each combination of the fields ``by``."""

    by: Mapping[str, Field]  # the entry's names of these fields
    numbers: Mapping[str, Number]  # its columns, by dotted keys where they are nested
    count: str = "runs"  # the entry's name of how many runs it is over
    order: Callable[[Any], Any] | None = None  # of keys, in place of the order of the rows
    deviation: bool = False  # with the standard deviation, too
    cell: Callable[[Any], tuple[str, ...]] = lambda key: tuple(map(str, key))  # names that seed the resamples


@dataclass(frozen=True)
class Pairs:
    """Which methods are compared with each other, and by what."""

    name: str  # in ``comparisons``
    numbers: Mapping[str, Number]  # by the name of the quantity in the entries
    rows: Callable[[Sequence[Row]], Sequence[Row]] = lambda rows: rows  # of which it is
    ranked: bool = False  # methods in the order of ``numbers.method_rank``, not in that of the rows


def rows_of(numbers: Mapping[str, Any], **place: Any) -> Iterator[Row]:
    """A row for each number, all of one place; None is not defined, and texts are left out."""
    for name, value in numbers.items():
        if value is None or (isinstance(value, int | float) and not isinstance(value, bool)):
            yield Row(name, math.nan if value is None else value, **place)


def rows_by_member(columns: Mapping[str, NDArray[Any]], **place: Any) -> Iterator[Row]:
    """A row for each member's value of each column, (K,)."""
    for member in range(len(next(iter(columns.values())))):
        numbers = {name: values[member].item() for name, values in columns.items()}
        yield from rows_of(numbers, **place, member=member)


def defined(rows: Iterable[Row]) -> Iterator[Row]:
    """The rows to be written: those with a number."""
    return (row for row in rows if math.isfinite(row.value))


def read_rows(path: Path) -> list[Row]:
    """The rows of ``numbers.csv``; a ``UserError`` where it is missing or damaged."""
    text = read_text(path, "the table of numbers is", EVALUATE_AGAIN)
    try:
        lines = list(csv.DictReader(io.StringIO(text, newline="")))
        return [Row(**{name: _field(name, line[name]) for name in Row._fields}) for line in lines]
    except (ValueError, KeyError, TypeError, csv.Error):
        raise UserError("the table of numbers is damaged", path, EVALUATE_AGAIN) from None


def _field(name: str, text: str) -> Any:
    if name == "value":
        return float(text)
    if name == "N":
        return int(text) if text else None
    whole = name in ("member", "layout", "seed", "step") and text.lstrip("-").isdecimal()
    return int(text) if whole else text


def select(rows: Iterable[Row], **fields: Any) -> list[Row]:
    """The rows whose fields have these values; a tuple: any of them."""
    wanted = {name: value if isinstance(value, tuple) else (value,) for name, value in fields.items()}
    return [row for row in rows if all(getattr(row, name) in values for name, values in wanted.items())]


def by_fields(rows: Iterable[Row], *fields: Field) -> dict[tuple[Any, ...], list[Row]]:
    """The rows by the values of these fields, or functions of the row."""
    return grouped(rows, lambda row: tuple(field(row) if callable(field) else getattr(row, field) for field in fields))


def wide(rows: Iterable[Row], **names: Field) -> list[Entry]:
    """An entry for each place, by the fields ``names`` under the entry's names of them, with all its quantities."""
    return [
        dict(zip(names, key, strict=True)) | {row.quantity: row.value for row in alike}
        for key, alike in by_fields(rows, *names.values()).items()
    ]


def with_members(rows: Iterable[Row], **names: Field) -> list[Entry]:
    """As :func:`wide`, and of each place its ``members`` with the quantities of theirs."""
    entries = []
    for key, alike in by_fields(rows, *names.values()).items():
        entry: Entry = dict(zip(names, key, strict=True))
        entry |= {row.quantity: row.value for row in alike if row.member == ""}
        entry["members"] = wide((row for row in alike if row.member != ""), member="member")
        entries.append(entry)
    return entries


def by_run(rows: Iterable[Row]) -> list[Entry]:
    """Of each run its numbers, and its ``sub_goals``, see :func:`with_members`."""
    runs = []
    for (path, seed, layout), of_run in by_fields(rows, "artefact", "seed", "layout").items():
        run: Entry = {"path": path, "seed": seed, "layout_seed": layout}
        run |= {row.quantity: row.value for row in of_run if row.sub_goal == ""}
        runs.append(run | {"sub_goals": with_members((row for row in of_run if row.sub_goal), sub_goal="sub_goal")})
    return runs


def per_run(rows: Iterable[Row], number: Number) -> list[tuple[Row, float]]:
    """A number of each run, with a row that is of it: of its defined members' values one; NaN where there is none."""
    fields = ("method", "artefact", "layout", "seed", "sub_goal", "ladder", "N")
    runs = by_fields((row for row in rows if row.step == ""), *fields)
    values = []
    for of_run in runs.values():
        alike = [row for row in of_run if (row.quantity, row.scope) == (number.quantity, number.scope)]
        if alike:
            values.append((alike[0], _of_members(of_run, alike, number.member)))
    return values


def _of_members(of_run: Sequence[Row], alike: Sequence[Row], member: str) -> float:
    if member not in MEMBERS:
        picked = next((row.value for row in of_run if row.quantity == member), math.nan)
        return next((float(row.value) for row in alike if row.member == picked), math.nan)
    values = [row.value for row in alike if not math.isnan(row.value)]
    return float(MEMBERS[member](values)) if values else math.nan


def tabulate(rows: Iterable[Row], table: Table) -> list[Entry]:
    """Spec F5: a table over runs, see ``numbers.over``; runs of one layout count once."""
    wanted = {(number.quantity, number.scope) for number in table.numbers.values()}
    picks = {number.member for number in table.numbers.values()}
    rows = [row for row in rows if row.step == "" and ((row.quantity, row.scope) in wanted or row.quantity in picks)]
    cells = by_fields(rows, *table.by.values())
    entries = []
    for key in sorted(cells, key=table.order) if table.order else cells:
        entry: Entry = dict(zip(table.by, key, strict=True))
        entry[table.count] = len({row.artefact for row in cells[key]})
        for name, number in table.numbers.items():
            runs = per_run(cells[key], number)
            cell = (*table.cell(key), *(number.cell or (name,)))
            layouts = [row.layout for row, _ in runs]
            values = [value for _, value in runs]
            aggregated = over(values, number.unit, *cell, layouts=layouts, deviation=table.deviation)
            *folders, last = name.split(".")
            reduce(lambda place, folder: place.setdefault(folder, {}), folders, entry)[last] = aggregated
        entries.append(entry)
    return entries


def compared(rows: Sequence[Row], by: Pairs) -> list[Entry]:
    """Spec F5: the first method against each other by each number, at each N: see ``numbers.pairs``.

    Pairs share layout, ladder, sub-goal and seed.
    """
    rows = by.rows(rows)
    rows = sorted(rows, key=lambda row: method_rank(row.method)) if by.ranked else rows
    entries: list[Entry] = []
    for groups in by_groups({"groups": row.N} for row in rows):
        at_groups = select(rows, N=groups)
        for title, number in by.numbers.items():
            measured = [
                (row.method, (row.layout, row.ladder, row.sub_goal, row.seed), value)
                for row, value in per_run(at_groups, number)
            ]
            where = "" if groups is None else f"N={groups}"
            entries += pairs(measured, title, where, higher=number.higher)
    return entries
