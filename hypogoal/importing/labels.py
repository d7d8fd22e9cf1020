"""What labels states: the rules of ``--label`` for episodes, and tables that people fill in (Spec I6)."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hypogoal.core.config import meant
from hypogoal.core.errors import UserError
from hypogoal.core.own_code import load, place_of
from hypogoal.data import Collected, Dataset, States, joined
from hypogoal.importing.episodes import Mark, Recording, Rule
from hypogoal.importing.files import reading
from hypogoal.observations import NUMBERS, digest

LABELS = "hypogoal.labels"  # entry points of label functions
LAST, TABLE = "last:", ".csv"  # how rules begin and end that are neither columns nor code
SPANS = ("episode", "from", "to")  # columns of a table of positive frames; ``to`` is the first frame behind them
SUCCESS = ("next.success", "success", "next.reward", "reward", "rewards")  # columns that say so, the first there is
# Columns of a table of states to label: the picture's file, the label (1, 0 or nothing yet), the row among the
# unlabelled states and its :func:`hypogoal.data.digest`, how much members disagree.
COLUMNS = ("name", "label", "row", "digest", "disagreement")


def rule_of(text: str) -> Rule:
    """The rule that a text names: a column above 0; ``last:N`` frames of each success; a table, ``FILE.csv``; code.

    Code, ``module:function``, gets an observation, by key if it has several.
    """
    if text.endswith(TABLE):
        return _by_table(Path(text))
    if text.startswith(LAST):
        count = text.removeprefix(LAST)
        if not count.isdecimal() or not int(count):
            raise UserError("the number of last frames is not above 0", text, "Give last:10, for example.")
        return Rule(partial(_by_end, int(count)))
    if ":" in text:
        return Rule(partial(_by_code, load(text, "label function", LABELS, {})))
    return Rule(partial(_by_column, text))


def _by_column(name: str, episode: Recording) -> Mark:
    if name not in episode.columns:
        do = meant(name, episode.columns) or f"Its columns are {', '.join(episode.columns) or 'none'}."
        others = "last:N, TABLE.csv and module:function label, too."
        raise UserError(f"no column {name!r} to label by", episode.name, f"{do} {others}")
    values = np.asarray(episode.columns[name]).reshape(-1)
    if values.dtype.kind not in "biuf" or len(values) != episode.length or not np.isfinite(values).all():
        raise UserError(f"the column {name!r} is not one number for each frame", episode.name, "Give another.")
    return lambda row, _: bool(values[row] > 0)


def _by_end(count: int, episode: Recording) -> Mark:
    says = next((name for name in SUCCESS if name in episode.columns), None)
    succeeded = says is None or bool((np.asarray(episode.columns[says]) > 0).any())
    return lambda row, _: succeeded and row >= episode.length - count


def _by_code(function: Any, recording: Recording) -> Mark:
    def mark(_: int, seen: Any) -> bool:
        gets = f"It gets a dictionary of {', '.join(seen)}." if isinstance(seen, dict) else "It gets an observation."
        try:
            value = function(seen)
        except Exception as error:
            raise UserError(
                f"the label function raised {type(error).__name__}: {error}", place_of(error), gets
            ) from error
        if np.shape(value) or value not in (0, 1):
            raise UserError("the label function gave neither True nor False", repr(value), gets)
        return bool(value)

    return mark


def _by_table(path: Path) -> Rule:
    """Positive frames by a table of ``SPANS``; an episode that it does not list has no labels."""
    spans: dict[str, list[tuple[str, str, str]]] = {}
    where = {}
    for number, row in enumerate(read_table(path, SPANS), 2):
        line = f"{path}, line {number}"
        spans.setdefault(row["episode"], []).append((row["from"], row["to"], line))
        where[row["episode"]] = line

    def marks(episode: Recording) -> Mark | None:
        if episode.name not in spans:
            return None
        positive = np.zeros(episode.length, np.bool_)
        numbers = {str(number): number for number in range(episode.length + 1)}
        for first, end, line in spans[episode.name]:
            if first not in numbers or end not in numbers or numbers[first] > numbers[end]:
                fault = f"a label is of frames {first!r} up to {end!r}, episode {episode.name} has {episode.length}"
                raise UserError(fault, line, "Give integers, 0 <= from <= to <= its frames.")
            positive[numbers[first] : numbers[end]] = True
        return lambda row, _: bool(positive[row])

    return Rule(marks, where)


def read_table(path: Path, columns: Sequence[str]) -> list[dict[str, str]]:
    """The rows of a CSV file that has these columns, others left out; a byte order mark is no letter of the first."""
    do = f"Give a CSV file, with commas, whose first line names {', '.join(columns)}."
    with reading(path, do):
        reader = csv.DictReader(path.read_text(encoding="utf-8-sig").splitlines())
        rows = [*reader]
    missing = [name for name in columns if name not in (reader.fieldnames or ())]
    if missing:
        raise UserError(f"the table of labels has no column {missing[0]!r}", path, do)
    for row in rows:
        for name in columns:
            row[name] = (row[name] or "").strip()
    return rows


def with_labels(dataset: Dataset, table: Path, sub_goal: str) -> tuple[Collected, int]:
    """The states of a data file, those that a table labels moved to the labelled ones; and how many these are.

    ``audit`` proposes the table beside pictures of the states, a person or a script fills it in. One of other data,
    that names a state twice or has no label, and data of several sub-goals are a ``UserError``.
    """
    if dataset.sub_goals != (sub_goal,):
        do = f"It has {', '.join(dataset.sub_goals)}."
        raise UserError("a table labels data of one sub-goal, its own", f"{sub_goal}={table}", do)
    observations, origins = dataset.unlabelled(), dataset.unlabelled_origins()
    chosen = _labels_in(table, observations)
    rows, labels = np.array([*chosen]), np.array([*chosen.values()])
    before = dataset.labelled(sub_goal)
    shared = before.origins.keys() & origins.keys()
    first = States(before.observations, before.labels, {name: before.origins[name] for name in shared})
    new = States(observations[rows], labels, {name: origins[name][rows] for name in shared})
    kept = ~np.isin(np.arange(len(observations)), rows)
    rest = States(observations, np.zeros((len(observations), 1), np.bool_), origins).where(kept)
    parts = [_one_column(joined([first, new])), rest, _one_column(dataset.heldout(sub_goal))]
    features = tuple(dataset.features()) if dataset.observation_dtype == NUMBERS else ()
    return Collected(dataset.observation_shape, (sub_goal,), *parts, features), len(rows)


def _labels_in(table: Path, observations: NDArray[Any]) -> dict[int, bool]:
    """The labels of unlabelled states, by row."""
    chosen: dict[int, bool] = {}
    places = {str(place): place for place in range(len(observations))}
    for number, row in enumerate(read_table(table, ("label", "row", "digest")), 2):
        where = f"{table}, line {number}"
        if row["label"] not in ("", "0", "1"):
            raise UserError("a label is neither 1 nor 0", where, "Leave it empty where it is not known.")
        if not row["label"]:
            continue
        place = places.get(row["row"])
        if place is None or digest(observations[place]).hex() != row["digest"]:
            raise UserError("this state is not of these data", where, "Audit an ensemble of these data again.")
        if place in chosen:
            raise UserError("the table names a state twice", where, "Leave one of them out.")
        chosen[place] = row["label"] == "1"
    if not chosen:
        raise UserError("the table has no label yet", table, "Fill in 1 or 0.")
    return chosen


def _one_column(states: States) -> States:
    return States(states.observations, states.labels[:, None], states.origins)
