"""Tables and files of training artefacts as arrays, each damaged one told in one line (Spec G2)."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hypogoal.core.errors import UserError
from hypogoal.core.files import read_json, read_text
from hypogoal.core.hdf5 import Foreign, members, open_hdf5, read_array
from hypogoal.evaluation.choices import Choices
from hypogoal.evaluation.curves import Episodes
from hypogoal.evaluation.distance import Executions

AGAIN = "Train the agent again."
MOST = 2**53  # integers that a float holds
MOST_OPTIONS = 2**16
MAX_TABLE_BYTES = 2**30
CHOICE_KINDS = {"expected": np.float64}  # the other columns are int64
FLAGS = ("reached", "inside_at_start", "terminated")  # columns of executions.csv that are 0 or 1; the others are int64


def read_episodes(path: Path) -> Episodes:
    """``episodes.csv``: step, length, reward, terminated."""
    table = read_table(path, ("step", "length", "reward", "terminated"))
    return Episodes(
        table["step"].astype(np.int64),
        table["length"].astype(np.int64),
        table["reward"],
        table["terminated"].astype(np.bool_),
    )


def read_choices(path: Path) -> Choices:
    """``choices.csv``: one row per option and window."""
    names = tuple(Choices.__dataclass_fields__)
    table = read_table(path, names)
    columns: dict[str, Any] = {name: table[name].astype(CHOICE_KINDS.get(name, np.int64)) for name in names}
    return Choices(**columns)


def read_executions(path: Path) -> Executions:
    """``executions.csv``: one row per execution of an option, in the order in which they ended."""
    names = tuple(Executions.__dataclass_fields__)
    table = read_table(path, names)
    columns: dict[str, Any] = {name: table[name].astype(np.bool_ if name in FLAGS else np.int64) for name in names}
    return Executions(**columns)


def read_layout(path: Path) -> dict[str, Any]:
    """``layout.json``: layout_seed, shortest_path, random_success, random_episodes."""
    facts = read_json(path, "the layout's file is", AGAIN)
    wanted = {"layout_seed": int, "shortest_path": int | None, "random_success": float | int | None}
    fits = isinstance(facts, dict) and all(isinstance(facts.get(key, ...), kind) for key, kind in wanted.items())
    if not fits or not 0 <= facts["layout_seed"] < MOST or type(facts.get("random_episodes")) is not int:
        raise UserError("the layout's file is damaged", path, AGAIN)
    return {key: facts[key] for key in (*wanted, "random_episodes")}


def read_terminations(path: Path) -> dict[int, NDArray[np.uint8]]:
    """``terminations.h5``: option -> the last states in which its classifier ended it, uint8 (n, *obs)."""
    with open_hdf5(path, "the file of terminations", AGAIN) as file:
        try:
            return {int(name): read_array(file, name, "u").astype(np.uint8) for name in members(file)}
        except (Foreign, ValueError) as error:
            raise UserError(f"the file of terminations is damaged ({error})", path, AGAIN) from None


def read_table(path: Path, columns: Sequence[str] | None = None) -> dict[str, NDArray[np.float64]]:
    """Columns of a table of numbers, float (n,) each.

    Args:
        path: a CSV file with a header.
        columns: those that must be there; all that are where None.

    Raises:
        UserError: missing, too large, no table, or what stands in it is no finite number of at most 2^53.
    """
    text = read_text(path, "the table is", AGAIN, MAX_TABLE_BYTES)
    try:
        reader = csv.DictReader(io.StringIO(text, newline=""))
        columns = list(reader.fieldnames or ()) if columns is None else columns
        if not set(columns) <= set(reader.fieldnames or ()):
            raise KeyError(path)
        rows = [[float(row[name]) for name in columns] for row in reader]
    except (ValueError, KeyError, TypeError, csv.Error):
        raise UserError("the table is damaged", path, AGAIN) from None
    values = np.array(rows, dtype=np.float64).reshape(len(rows), len(columns))
    # NaN is no number, and of an integer column nothing may be lost.
    if not (np.abs(values) < MOST).all():
        raise UserError("a number in the table is missing or too large", path, AGAIN)
    table = {name: values[:, index] for index, name in enumerate(columns)}
    options = table.get("option", np.zeros(0))
    if not ((options >= 0) & (options < MOST_OPTIONS)).all():
        raise UserError("an option in the table has no possible number", path, AGAIN)
    return table
