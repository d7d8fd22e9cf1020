"""Tables and files of training artefacts as arrays, each damaged one told in one line (Spec G2)."""

from __future__ import annotations

import csv
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hypogoal.core.errors import UserError
from hypogoal.evaluation.choices import Choices
from hypogoal.evaluation.curves import Episodes
from hypogoal.evaluation.distance import Executions

CHOICE_KINDS = {"expected": np.float64}  # the other columns are int64
FLAGS = ("reached", "inside_at_start", "terminated")  # columns of executions.csv that are 0 or 1; the others are int64


def read_episodes(path: Path) -> Episodes:
    """``episodes.csv``: step, length, reward, terminated."""
    table = _read_table(path, ("step", "length", "reward", "terminated"))
    return Episodes(
        table["step"].astype(np.int64),
        table["length"].astype(np.int64),
        table["reward"],
        table["terminated"].astype(np.bool_),
    )


def read_choices(path: Path) -> Choices:
    """``choices.csv``: one row per option and window."""
    names = tuple(Choices.__dataclass_fields__)
    table = _read_table(path, names)
    columns: dict[str, Any] = {name: table[name].astype(CHOICE_KINDS.get(name, np.int64)) for name in names}
    return Choices(**columns)


def read_executions(path: Path) -> Executions:
    """``executions.csv``: one row per execution of an option, in the order in which they ended."""
    names = tuple(Executions.__dataclass_fields__)
    table = _read_table(path, names)
    columns: dict[str, Any] = {name: table[name].astype(np.bool_ if name in FLAGS else np.int64) for name in names}
    return Executions(**columns)


def read_layout(path: Path) -> dict[str, Any]:
    """``layout.json``: layout_seed, shortest_path, random_success, random_episodes."""
    try:
        facts = json.loads(path.read_text(encoding="utf-8"))
        return {key: facts[key] for key in ("layout_seed", "shortest_path", "random_success", "random_episodes")}
    except (OSError, ValueError, KeyError, TypeError):
        raise UserError("missing or damaged", path, "Train the agent again.") from None


def read_terminations(path: Path) -> dict[int, NDArray[np.uint8]]:
    """``terminations.h5``: option -> the last states in which its classifier ended it, uint8 (n, *obs)."""
    import h5py

    try:
        with h5py.File(path, "r") as file:
            return {int(name): np.asarray(file[name][()], dtype=np.uint8) for name in file}
    except (OSError, ValueError):
        raise UserError("missing or damaged", path, "Train the agent again.") from None


def _read_table(path: Path, columns: Sequence[str]) -> dict[str, NDArray[np.float64]]:
    try:
        with path.open(newline="", encoding="utf-8") as file:
            reader = csv.DictReader(file)
            if not set(columns) <= set(reader.fieldnames or ()):
                raise KeyError(path)
            rows = [[float(row[name]) for name in columns] for row in reader]
    except (OSError, ValueError, KeyError, TypeError):
        raise UserError("missing or damaged", path, "Train the agent again.") from None
    values = np.array(rows, dtype=np.float64).reshape(len(rows), len(columns))
    if not np.isfinite(values).all():
        raise UserError("a number is missing", path, "Train the agent again.")
    return {name: values[:, index] for index, name in enumerate(columns)}
