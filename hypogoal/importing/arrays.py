"""NumPy arrays: a ``.npz`` file, or a folder of ``.npy`` files with the same names."""

from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from hypogoal.core.errors import UserError
from hypogoal.core.files import reading
from hypogoal.importing.states import HELDOUT, LABELLED, UNLABELLED, Array, Episode, files_of

# Of each set of states: what the names of its observations begin with, and those of its other arrays.
SETS = {
    LABELLED: ("observations", ""),
    UNLABELLED: ("unlabelled", "unlabelled_"),
    HELDOUT: ("heldout_observations", "heldout_"),
}
DO = "Give a .npz file that numpy.savez wrote, of numbers, not of Python objects."
LABELS = "Give (N,), or (N, sub-goals) and --sub-goal NAME for each column: 1 where it holds, 0 where not."

Arrays = dict[str, Array]


def read_arrays(path: Path, left: Counter[str]) -> Arrays:
    """The arrays of a file or a folder by name; observations of several keys are ``observations/front`` and so on.

    ``left`` counts other files of the folder.
    """
    arrays = {"sub_goals": np.array(["sub-goal"]), "features": np.array([])}
    for file in files_of(path, (".npy",), left):
        inner = file.relative_to(path).with_suffix("")
        with reading(file, DO):
            arrays[inner.as_posix()] = np.load(file)
    if path.is_file():
        with reading(path, DO), path.open("rb") as raw, np.load(raw) as stored:  # NumPy leaves a cut archive open
            arrays.update(stored)
    return arrays


def episodes_of(
    arrays: Arrays,
    sub_goals: Sequence[str],
    group: str,
    left: Counter[str],
) -> Iterator[Episode]:
    """The three sets of states as an episode each; labels that do not fit states and sub-goals are a ``UserError``.

    ``group`` names another array, (N,): labelled states with equal values there belong together, and unlabelled ones by
    the array ``unlabelled_GROUP``. ``left`` counts arrays that are not read.
    """
    if group and group not in arrays:
        names = ", ".join(arrays)
        raise UserError("no such array", group, f"There are {names}.")
    rest = arrays.keys() - {"sub_goals", "features"}
    for role, (name, prefix) in SETS.items():
        seen = {}
        for full, values in arrays.items():
            base, _, key = full.partition("/")
            if base == name:
                seen[key] = np.atleast_1d(values)
                rest.remove(full)
        count = max(map(len, seen.values()), default=0)
        unlabelled = 0 if role != UNLABELLED else count
        labels = arrays.get(f"{prefix}labels", np.zeros((unlabelled, len(sub_goals))))
        columns = np.atleast_2d(labels.T)
        if columns.shape != (len(sub_goals), count) or not np.isin(columns, (0, 1)).all():
            fault = f"labels of {count} {role} states and {len(sub_goals)} sub-goals are not 0 or 1 for each"
            raise UserError(fault, f"{labels.dtype} {labels.shape}", LABELS)
        by_goal = dict(zip(sub_goals, columns.astype(bool), strict=True))
        groups = arrays.get(f"{prefix}{group}", np.full(count, ""))
        rest -= {f"{prefix}labels", f"{prefix}{group}"}
        if count:
            yield Episode(name, count, seen, by_goal, role, groups.astype(str))
    for name in rest:
        left[f"array {name!r}"] += 1
