"""What labels states: the rules of ``--label`` for episodes, and tables that people fill in (Spec I6)."""

import csv
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from hypogoal.core.config import near
from hypogoal.core.errors import UserError
from hypogoal.core.own_code import load
from hypogoal.data import Collected, Dataset, Labels, joined
from hypogoal.importing.episodes import Episode
from hypogoal.importing.files import reading
from hypogoal.observations import NUMBERS, Observations, digest

GROUP = "hypogoal.labels"  # entry points of label functions
LAST, TABLE = "last:", ".csv"  # how rules begin and end that are neither columns nor code
SPANS = {"episode": str, "from": int, "to": int}  # columns of a table of positive frames; ``to`` is the first behind
SUCCESS = ("next.success", "success", "next.reward", "reward", "rewards")  # columns that say so, the first there is
# Columns of a table of states to label: the picture's file, the label (1, 0 or nothing yet), the row among the
# unlabelled states and its :func:`hypogoal.observations.digest`, how much members disagree.
COLUMNS = ("name", "label", "row", "digest", "disagreement")
TRUTHS = {"0": False, "1": True}


class Rule(NamedTuple):
    """What labels a sub-goal.

    Attributes:
        marks: from an episode to its labels, bool (T,), or to a function of an observation; None: it has no labels.
        listed: the episodes that a table names, and where.
    """

    marks: Callable[[Episode], Any]
    listed: Mapping[str, str] = {}


def rule_of(text: str) -> Rule:
    """The rule that a text names: a column above 0; ``last:N`` frames of each success; a table, ``FILE.csv``; code.

    Code, ``module:function``, gets an observation, by key if it has several.
    """
    if text.endswith(TABLE):
        return _by_table(Path(text))
    count = text.removeprefix(LAST)
    if count != text and count.isdecimal():
        return Rule(partial(_by_end, int(count)))
    if ":" in text:
        function = load(text, "label function", GROUP, {})
        return Rule(lambda _: function)
    return Rule(partial(_by_column, text))


def _by_column(name: str, episode: Episode) -> Labels:
    """Where a column is above 0."""
    values = np.ravel(episode.columns.get(name, ()))
    are_numbers = values.dtype.kind in "biuf" and len(values) == episode.length
    if not are_numbers or not np.isfinite(values).all():
        columns = ", ".join(episode.columns) or "none"
        do = near(name, episode.columns) or f"Its columns are {columns}."
        fault = f"no column {name!r} with a number for each frame"
        raise UserError(fault, episode.name, do)
    return values > 0


def _by_end(count: int, episode: Episode) -> Labels:
    rows = np.arange(episode.length)
    succeeded = True
    for name in reversed(SUCCESS):
        if name in episode.columns:
            succeeded = bool((episode.columns[name] > 0).any())
    return succeeded & (rows >= episode.length - count)


def _by_table(path: Path) -> Rule:
    """Positive frames by a table of ``SPANS``; an episode that it does not list has no labels."""
    rows = read_table(path, SPANS)

    def marks(episode: Episode) -> Labels | None:
        positive = np.zeros(episode.length, np.bool_)
        spans = [row for row in rows if row["episode"] == episode.name]
        for row in spans:
            first, end = row["from"], row["to"]
            if not 0 <= first <= end <= episode.length:
                fault = f"a label is of frames {first} up to {end} of {episode.length}"
                raise UserError(fault, row["line"], "Give 0 <= from <= to <= the episode's frames.")
            positive[first:end] = True
        return positive if spans else None

    return Rule(marks, {row["episode"]: row["line"] for row in rows})


def is_marked(mark: Any, row: int, seen: Any) -> bool:
    """Whether a frame is positive, by what :attr:`Rule.marks` gave."""
    if not callable(mark):
        return bool(mark[row])
    value = mark(seen)
    if np.shape(value) or value not in (0, 1):
        fault = "the label function gave neither True nor False"
        do = "It gets an observation, by key if there are several."
        raise UserError(fault, repr(value), do)
    return bool(value)


def read_table(path: Path, columns: Mapping[str, type]) -> list[dict[str, Any]]:
    """The rows of a CSV file that has these columns, and the ``line`` of each; a byte order mark is left out."""
    rows = []
    names = ", ".join(columns)
    do = f"Give a CSV file, with commas, whose first line names {names}."
    with reading(path, do), path.open(encoding="utf-8-sig", newline="") as text:
        lines = csv.DictReader(text, restval="")
        for number, cells in enumerate(lines, 2):
            row: dict[str, Any] = {"line": f"{path}, line {number}"}
            for name, kind in columns.items():
                row[name] = kind(cells[name].strip())
            rows.append(row)
    return rows


def with_labels(
    dataset: Dataset,
    table: Path,
    sub_goal: str,
) -> tuple[Collected, int]:
    """The states of a data file, those that a table labels moved to the labelled ones; and how many these are.

    ``audit`` proposes the table beside pictures of the states, a person or a script fills it in. One of other data,
    that names a state twice or has no label, and data of several sub-goals are a ``UserError``.
    """
    if dataset.sub_goals != (sub_goal,):
        goals = ", ".join(dataset.sub_goals)
        fault = "a table labels data of one sub-goal, its own"
        raise UserError(fault, f"{sub_goal}={table}", f"It has {goals}.")
    unlabelled = dataset.unlabelled_states()
    labels = _labels_in(table, unlabelled.observations)
    rows = np.array([*labels])
    marks = np.array([*labels.values()])
    old, heldout = dataset.labelled(sub_goal), dataset.heldout(sub_goal)
    learned = joined([old, replace(unlabelled.where(rows), labels=marks)])
    others = np.delete(np.arange(len(unlabelled.labels)), rows)
    rest = unlabelled.where(others)
    features: Sequence[str] = ()
    if dataset.observation_dtype == NUMBERS:
        features = dataset.features()
    collected = Collected(
        dataset.observation_shape,
        dataset.sub_goals,
        labelled=replace(learned, labels=learned.labels[:, None]),
        unlabelled=rest,
        heldout=replace(heldout, labels=heldout.labels[:, None]),
        features=tuple(features),
        channels=dataset.channels,
    )
    return collected, len(labels)


def _labels_in(table: Path, observations: Observations) -> dict[int, bool]:
    """The labels of unlabelled states, by row."""
    places = {digest(state).hex(): place for place, state in enumerate(observations)}
    labels: dict[int, bool] = {}
    for row in read_table(table, {"label": str, "digest": str}):
        if not row["label"]:
            continue
        place = places.get(row["digest"])
        if place is None:
            do = "Audit an ensemble of these data again."
            raise UserError("this state is not of these data", row["line"], do)
        if place in labels or row["label"] not in TRUTHS:
            fault = "a label is neither 1 nor 0, or the second of its state"
            do = "Give each state one label, or leave it empty where that is not known."
            raise UserError(fault, row["line"], do)
        labels[place] = TRUTHS[row["label"]]
    if not labels:
        do = "Fill in 1 or 0."
        raise UserError("the table has no label yet", table, do)
    return labels
