"""NumPy arrays: a ``.npz`` file, or a folder of ``.npy`` files with the same names."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from hypogoal.core.config import near
from hypogoal.core.errors import UserError
from hypogoal.data import Dataset
from hypogoal.importing.episodes import HELDOUT, LABELLED, UNLABELLED, Array, Episode
from hypogoal.importing.files import reading
from hypogoal.observations import NUMBERS, Observations

# Of each set of states, the array and what its other arrays' names begin with.
SETS = {
    LABELLED: ("observations", ""),
    UNLABELLED: ("unlabelled", "unlabelled_"),
    HELDOUT: ("heldout_observations", "heldout_"),
}
KEYED = [name for name, _ in SETS.values()]  # there may be one of these for each key
NEEDED = ("observations", "labels", "unlabelled")
KNOWN = (*NEEDED, "heldout_observations", "heldout_labels", "sub_goals", "features")
DO = "Give a .npz file that numpy.savez wrote, of numbers, not of Python objects."
LABELS = "Give (N,), or (N, sub-goals) and --sub-goal NAME for each column: 1 where it holds, 0 where not."

Arrays: TypeAlias = dict[str, dict[str, Array]]  # by name, and by key: "front" of observations/front, else ""


def read_arrays(path: Path, group: str = "") -> Arrays:
    """The arrays of a file or a folder; missing and misspelt names are a ``UserError``.

    ``NEEDED``, perhaps held-out ones, ``sub_goals`` (G texts) and ``features``. Mixed observations have an array for
    each key: ``observations/front``. ``group`` names another array, (N,): labelled states with equal values there
    belong together, and unlabelled ones by the array ``unlabelled_GROUP``.
    """
    loaded: dict[str, Array] = {}
    with reading(path, DO):
        for file in sorted(path.rglob("*.npy")):
            inner = file.relative_to(path).with_suffix("")
            loaded[inner.as_posix()] = np.load(file)
        if path.is_file():
            with path.open("rb") as raw, np.load(raw) as stored:  # NumPy leaves a cut archive open
                loaded.update(stored)
    arrays: Arrays = {}
    for full, values in loaded.items():
        base, _, key = full.partition("/")
        plain = base if base in KEYED else full
        if plain not in (*KNOWN, group, f"unlabelled_{group}"):
            names = ", ".join(KNOWN)
            do = near(full, KNOWN) or f"Known are {names}; leave it out, or is it for --group?"
            raise UserError(f"unknown array {full!r}", path, do)
        arrays.setdefault(base, {})[key] = values
    arrays.setdefault("sub_goals", {"": np.array(["sub-goal"])})
    arrays.setdefault("features", {"": np.array([])})
    needed = [*NEEDED, group or "labels"]
    for name in needed:
        if name not in arrays:
            present = ", ".join(loaded)
            raise UserError(f"no array {name!r}", path, f"There are {present}.")
    return arrays


def episodes_of(
    arrays: Arrays,
    sub_goals: Sequence[str],
    group: str,
    path: Path,
) -> Iterator[Episode]:
    """Each state as an episode of its own; labels that do not fit states and sub-goals are a ``UserError``."""
    goals = len(sub_goals)
    for role, (name, prefix) in SETS.items():
        by_key = arrays.get(name, {})
        with reading(path, DO):
            count = max(map(len, by_key.values()), default=0)
            expected = 0 if role != UNLABELLED else count
            blank = np.zeros((expected, goals))
            labels = arrays.get(f"{prefix}labels", {"": blank})[""]
            columns = labels if labels.ndim > 1 else labels[:, None]
            are_marks = np.isin(columns, (0, 1)).all()
            if columns.shape != (count, goals) or not are_marks:
                fault = f"labels of {count} {role} states and {goals} sub-goals are not 0 or 1 for each"
                raise UserError(fault, f"{labels.dtype} {labels.shape}", LABELS)
            groups = np.full(count, "")
            if f"{prefix}{group}" in arrays:
                groups = arrays[f"{prefix}{group}"][""]
            for row in range(count):
                seen = {key: values[row : row + 1] for key, values in by_key.items()}
                marks = columns[row, :, None]
                by_goal = dict(zip(sub_goals, marks, strict=True))
                yield Episode(
                    f"{name}[{row}]",
                    1,
                    seen,
                    by_goal,
                    role,
                    str(groups[row]),
                )


def write_arrays(path: Path, dataset: Dataset) -> None:
    """Write a data file's states for :func:`read_arrays`; a ``UserError`` if its sub-goals do not share them."""
    states: dict[str, Observations] = {}
    arrays: dict[str, Any] = {"sub_goals": np.array(dataset.sub_goals)}
    for prefix, split in (("", dataset.labelled), ("heldout_", dataset.heldout)):
        parts = [split(goal) for goal in dataset.sub_goals]
        shared = parts[0].observations
        for part in parts:
            if not np.array_equal(shared, part.observations):
                fault = "its sub-goals do not share their states"
                raise UserError(fault, dataset.path, "Read it with h5py instead.")
        states[f"{prefix}observations"] = shared
        columns = [part.labels for part in parts]
        arrays[f"{prefix}labels"] = np.stack(columns, axis=1)
    states["unlabelled"] = dataset.unlabelled()
    if dataset.observation_dtype == NUMBERS:
        arrays["features"] = np.array(dataset.features())
    for name, values in states.items():
        if not values.dtype.names:
            arrays[name] = values
        for key in values.dtype.names or ():
            arrays[f"{name}/{key}"] = values[key]
    with path.open("wb") as file:
        np.savez_compressed(file, allow_pickle=False, **arrays)
