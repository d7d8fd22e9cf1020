"""What labels states: the rules of ``--label`` for episodes, and tables that people fill in (Spec I6)."""

import csv
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from hypogoal.core.config import near
from hypogoal.core.errors import UserError
from hypogoal.core.own_code import load, place_of
from hypogoal.data import Collected, Dataset, States, joined
from hypogoal.importing.episodes import Mark, Recording, Rule
from hypogoal.importing.files import reading
from hypogoal.observations import NUMBERS, Observations, digest

LABELS = "hypogoal.labels"  # entry points of label functions
LAST, TABLE = "last:", ".csv"  # how rules begin and end that are neither columns nor code
SPANS = ("episode", "from", "to")  # columns of a table of positive frames; ``to`` is the first frame behind them
SUCCESS = ("next.success", "success", "next.reward", "reward", "rewards")  # columns that say so, the first there is
# Columns of a table of states to label: the picture's file, the label (1, 0 or nothing yet), the row among the
# unlabelled states and its :func:`hypogoal.observations.digest`, how much members disagree.
COLUMNS = ("name", "label", "row", "digest", "disagreement")


def rule_of(text: str) -> Rule:
    """The rule that a text names: a column above 0; ``last:N`` frames of each success; a table, ``FILE.csv``; code.

    Code, ``module:function``, gets an observation, by key if it has several.
    """
    if text.endswith(TABLE):
        return _by_table(Path(text))
    count = text.removeprefix(LAST)
    if count == text and ":" in text:
        return Rule(partial(_by_code, load(text, "label function", LABELS, {})))
    if count == text:
        return Rule(partial(_by_column, text))
    if not count.isdecimal() or not int(count):
        raise UserError("the number of last frames is not above 0", text, "Give last:10, for example.")
    return Rule(partial(_by_end, int(count)))


def _by_column(name: str, recording: Recording) -> Mark:
    if name not in recording.columns:
        do = near(name, recording.columns) or f"Its columns are {', '.join(recording.columns) or 'none'}."
        others = "last:N, TABLE.csv and module:function label, too."
        raise UserError(f"no column {name!r} to label by", recording.name, f"{do} {others}")
    values = np.ravel(recording.columns[name])
    if values.dtype.kind not in "biuf" or len(values) != recording.length or not np.isfinite(values).all():
        raise UserError(f"the column {name!r} is not one number for each frame", recording.name, "Give another.")
    return lambda row, _: bool(values[row] > 0)


def _by_end(count: int, recording: Recording) -> Mark:
    says = [name for name in SUCCESS if name in recording.columns]
    succeeded = not says or bool((recording.columns[says[0]] > 0).any())
    return lambda row, _: succeeded and row >= recording.length - count


def _by_code(function: Any, _: Recording) -> Mark:
    def mark(_: int, seen: Any) -> bool:
        gets = f"It gets a dictionary of {', '.join(seen)}." if isinstance(seen, dict) else "It gets an observation."
        try:
            value = function(seen)
        except Exception as error:
            fault = f"the label function raised {type(error).__name__}: {error}"
            raise UserError(fault, place_of(error), gets) from error
        if np.shape(value) or value not in (0, 1):
            raise UserError("the label function gave neither True nor False", repr(value), gets)
        return bool(value)

    return mark


def _by_table(path: Path) -> Rule:
    """Positive frames by a table of ``SPANS``; an episode that it does not list has no labels."""
    rows = read_table(path, SPANS)

    def marks(recording: Recording) -> Mark | None:
        numbers = {str(number): number for number in range(recording.length + 1)}
        positive = np.zeros(recording.length, np.bool_)
        listed = [row for row in rows if row["episode"] == recording.name]
        for row in listed:
            first, end = numbers.get(row["from"], -1), numbers.get(row["to"], -1)
            if not 0 <= first <= end:
                text = f"{row['from']!r} up to {row['to']!r}"
                fault = f"a label is of frames {text}, episode {recording.name} has {recording.length}"
                raise UserError(fault, row["line"], "Give integers, 0 <= from <= to <= its frames.")
            positive[first:end] = True
        return (lambda row, _: bool(positive[row])) if listed else None

    return Rule(marks, {row["episode"]: row["line"] for row in rows})


def read_table(path: Path, columns: Sequence[str]) -> list[dict[str, str]]:
    """The rows of a CSV file that has these columns, and the ``line`` of each; a byte order mark is left out."""
    do = f"Give a CSV file, with commas, whose first line names {', '.join(columns)}."
    with reading(path, do):
        reader = csv.DictReader(path.read_text(encoding="utf-8-sig").splitlines(), restval="")
        records = [*reader]
    missing = [name for name in columns if name not in (reader.fieldnames or ())]
    if missing:
        raise UserError(f"the table of labels has no column {missing[0]!r}", path, do)
    rows = []
    for number, cells in enumerate(records, 2):
        row = {name: cells[name].strip() for name in columns}
        rows.append({**row, "line": f"{path}, line {number}"})
    return rows


def with_labels(dataset: Dataset, table: Path, sub_goal: str) -> tuple[Collected, int]:
    """The states of a data file, those that a table labels moved to the labelled ones; and how many these are.

    ``audit`` proposes the table beside pictures of the states, a person or a script fills it in. One of other data,
    that names a state twice or has no label, and data of several sub-goals are a ``UserError``.
    """
    if dataset.sub_goals != (sub_goal,):
        do = f"It has {', '.join(dataset.sub_goals)}."
        raise UserError("a table labels data of one sub-goal, its own", f"{sub_goal}={table}", do)
    unlabelled = dataset.unlabelled_states()
    labels = _labels_in(table, unlabelled.observations)
    rows = np.array([*labels])
    new = replace(unlabelled.where(rows), labels=np.array([*labels.values()])[:, None])
    rest = unlabelled.where(~np.isin(np.arange(len(unlabelled.labels)), rows))
    labelled, test = dataset.labelled(sub_goal), dataset.heldout(sub_goal)
    before = States(labelled.observations, labelled.labels[:, None], labelled.origins)
    heldout = States(test.observations, test.labels[:, None], test.origins)
    features = tuple(dataset.features()) if dataset.observation_dtype == NUMBERS else ()
    shape = dataset.observation_shape
    sets = joined([before, new]), rest, heldout
    return Collected(shape, (sub_goal,), *sets, features=features, channels=dataset.channels), len(labels)


def _labels_in(table: Path, observations: Observations) -> dict[int, bool]:
    """The labels of unlabelled states, by row."""
    places = {str(place): place for place in range(len(observations))}
    labels: dict[int, bool] = {}
    for row in read_table(table, ("label", "row", "digest")):
        if row["label"] not in ("", "0", "1"):
            raise UserError("a label is neither 1 nor 0", row["line"], "Leave it empty where it is not known.")
        if not row["label"]:
            continue
        place = places.get(row["row"], -1)
        if place < 0 or digest(observations[place]).hex() != row["digest"]:
            raise UserError("this state is not of these data", row["line"], "Audit an ensemble of these data again.")
        if place in labels:
            raise UserError("the table names a state twice", row["line"], "Leave one of them out.")
        labels[place] = row["label"] == "1"
    if not labels:
        raise UserError("the table has no label yet", table, "Fill in 1 or 0.")
    return labels
