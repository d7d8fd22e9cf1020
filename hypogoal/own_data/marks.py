"""A table of states to label: unlabelled states of a data file, and their labels once somebody gave them (Spec I6).

``audit`` proposes it beside pictures of the states, a person or a script fills it in, ``import`` moves those states to
the labelled ones.
"""

from __future__ import annotations

import csv
import re
from pathlib import Path

import numpy as np

from hypogoal.core.errors import UserError
from hypogoal.core.files import read_text
from hypogoal.data import Collected, Dataset, States, joined
from hypogoal.observations import NUMBERS, digest

# The picture's file, the label (1, 0 or nothing yet), the row among the unlabelled states and its
# :func:`hypogoal.observations.digest`, how much members disagree.
COLUMNS = ("name", "label", "row", "digest", "disagreement")
REQUIRED = ("label", "row", "digest")
PLACE = re.compile(r"[0-9]{1,12}")
DO = "Give a table from 'audit', with 1 or 0 as labels."


def read_marks(path: Path) -> list[dict[str, str]]:
    """The rows of a table; one that is missing or damaged is a ``UserError``."""
    text = read_text(path, "the table of labels is", DO)
    try:
        reader = csv.DictReader(text.splitlines())
        if not set(REQUIRED) <= set(reader.fieldnames or ()):
            raise UserError(f"a table of labels has the columns {', '.join(REQUIRED)}", path, DO)
        rows = [{name: row[name].strip() for name in REQUIRED if row.get(name) is not None} for row in reader]
    except (csv.Error, AttributeError):
        raise UserError("the table of labels is damaged", path, DO) from None
    for number, row in enumerate(rows, 2):
        if not set(REQUIRED) <= set(row) or not PLACE.fullmatch(row["row"]) or row["label"] not in ("", "0", "1"):
            raise UserError("this is no row and label", f"{path}, line {number}", DO)
    return rows


def with_marks(dataset: Dataset, marks: Path, sub_goal: str) -> tuple[Collected, int]:
    """The states of a data file, those that ``marks`` labels moved to the labelled ones; and how many these are.

    A table of other data, that names a state twice or has no label, and data of several sub-goals are a ``UserError``.
    """
    if dataset.sub_goals != (sub_goal,):
        do = f"It has {', '.join(dataset.sub_goals)}."
        raise UserError("a table labels data of one sub-goal, its own", f"{sub_goal}={marks}", do)
    rows = [row for row in read_marks(marks) if row["label"]]
    if not rows:
        raise UserError("the table has no label yet", marks, "Fill in 1 or 0.")
    observations, origins = dataset.unlabelled(), dataset.unlabelled_origins()
    chosen, labels = np.array([int(row["row"]) for row in rows]), np.array([row["label"] == "1" for row in rows])
    fits = len(set(chosen.tolist())) == len(rows) and chosen.max() < len(observations)
    if not fits or any(
        digest(observations[place]).hex() != row["digest"] for place, row in zip(chosen, rows, strict=True)
    ):
        raise UserError(
            "the table is of other data, or names a state twice",
            marks,
            f"Audit an ensemble of {dataset.path.name} again.",
        )
    before = dataset.labelled(sub_goal)
    shared = before.origins.keys() & origins.keys()
    first = States(before.observations, before.labels, {name: before.origins[name] for name in shared})
    new = States(observations[chosen], labels, {name: origins[name][chosen] for name in shared})
    kept = np.ones(len(observations), np.bool_)
    kept[chosen] = False
    labelled, heldout = joined([first, new]), dataset.heldout(sub_goal)
    rest = States(
        observations[kept],
        np.zeros((kept.sum(), 1), np.bool_),
        {name: values[kept] for name, values in origins.items()},
    )
    features = tuple(dataset.features()) if dataset.observation_dtype == NUMBERS else ()
    return Collected(
        dataset.observation_shape, (sub_goal,), _columns(labelled), rest, _columns(heldout), features
    ), len(rows)


def _columns(states: States) -> States:
    return States(states.observations, states.labels[:, None], states.origins)
