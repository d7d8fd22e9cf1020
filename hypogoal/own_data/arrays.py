"""NumPy arrays: a ``.npz`` file, or a folder of ``.npy`` files with the same names."""

import tokenize
import zipfile
import zlib
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hypogoal.core.config import meant
from hypogoal.core.errors import UserError
from hypogoal.core.files import open_file
from hypogoal.data import Dataset
from hypogoal.observations import NUMBERS, Observations, fields_of
from hypogoal.own_data.parts import Parts

NEEDED = ("observations", "labels", "unlabelled")
OPTIONAL = ("heldout_observations", "heldout_labels")
NAMES = ("sub_goals", "features")
KNOWN = (*NEEDED, *OPTIONAL, *NAMES)
STATES = ("observations", "unlabelled", "heldout_observations")
PACKED = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)  # other methods make gigabytes of a kilobyte
ENCRYPTED = 1  # a flag of an entry
DAMAGED = (
    ValueError, TypeError, OverflowError, KeyError, EOFError, OSError, MemoryError, SyntaxError, tokenize.TokenError,
    zipfile.BadZipFile, zlib.error,
)  # fmt: skip # raised by NumPy and zipfile for malformed sizes, headers and streams


def read_arrays(path: Path) -> Parts:
    """Arrays by name, of a ``.npz`` file or a folder of ``.npy`` files: ``NEEDED``, perhaps ``OPTIONAL``, ``sub_goals``
    (G texts) and ``features``. Mixed observations have an array for each key: ``observations/front``.

    Missing, damaged or misnamed arrays, ones larger than memory, and pickled Python objects are a ``UserError``.
    """
    arrays: dict[str, Any] = dict(_folder(path) if path.is_dir() else _file(path))
    for name in [name for name in arrays if "/" in name]:
        base, _, key = name.partition("/")
        if isinstance(arrays.setdefault(base, {}), np.ndarray):
            raise UserError(f"{base!r} is one array and several by key", path, "Give either.")
        arrays[base][key] = arrays.pop(name)
    missing = [name for name in NEEDED if name not in arrays]
    if missing:
        do = f"Give arrays called {', '.join(NEEDED)}, and {' and '.join(OPTIONAL)} where there are some."
        raise UserError(f"no array {missing[0]!r}", path, do)
    if ("heldout_observations" in arrays) != ("heldout_labels" in arrays):
        raise UserError("held-out states need observations and labels", path, f"Give {' and '.join(OPTIONAL)}.")
    for name in NAMES:
        if name in arrays and arrays[name].dtype.kind != "U":
            raise UserError(f"{name} are {arrays[name].dtype}, not texts", path, "Give numpy.array of str.")
    named: dict[str, Any] = {name: tuple(map(str, arrays[name].ravel())) for name in NAMES if name in arrays}
    return Parts(**{name: arrays[name] for name in (*NEEDED, *OPTIONAL) if name in arrays}, **named)


def write_arrays(path: Path, dataset: Dataset) -> None:
    """Write a data file's states for :func:`read_arrays`; a ``UserError`` if its sub-goals do not share them."""
    columns: dict[str, list[NDArray[np.bool_]]] = {"labelled": [], "heldout": []}
    first: dict[str, Observations] = {}
    for split, labels in columns.items():
        for goal in dataset.sub_goals:
            states = getattr(dataset, split)(goal)
            if not np.array_equal(first.setdefault(split, states.observations), states.observations):
                raise UserError("its sub-goals do not share their states", dataset.path, "Read it with h5py instead.")
            labels.append(states.labels)
    states = {
        "observations": first["labelled"],
        "unlabelled": dataset.unlabelled(),
        "heldout_observations": first["heldout"],
    }
    keys = fields_of(dataset.observation_shape, dataset.observation_dtype)
    arrays: dict[str, Any] = {
        "labels": np.stack(columns["labelled"], axis=1),
        "heldout_labels": np.stack(columns["heldout"], axis=1),
        "sub_goals": np.array(dataset.sub_goals),
        **({"features": np.array(dataset.features())} if dataset.observation_dtype == NUMBERS else {}),
        **{
            f"{name}/{key}" if key else name: some[key] if key else some
            for name, some in states.items()
            for key in keys
        },
    }
    with path.open("wb") as file:
        np.savez_compressed(file, allow_pickle=False, **arrays)


def _file(path: Path) -> dict[str, NDArray[Any]]:
    do = "Write it with numpy.savez."
    with open_file(path, "the arrays are", "Give a .npz file that numpy.savez wrote.") as raw:
        try:
            with zipfile.ZipFile(raw) as archive:
                entries = archive.infolist()
        except (zipfile.BadZipFile, OSError, NotImplementedError, ValueError):
            raise UserError("this is not a .npz file", path, do) from None
        if any(entry.compress_type not in PACKED or entry.flag_bits & ENCRYPTED for entry in entries):
            raise UserError("the arrays are not packed as numpy packs them", path, do)
        raw.seek(0)
        try:
            with np.load(raw, allow_pickle=False) as arrays:
                _require_known(arrays.files, path)
                return {name: arrays[name] for name in arrays.files}
        except DAMAGED as error:
            raise _damaged(path, error) from None


def _folder(path: Path) -> dict[str, NDArray[Any]]:
    arrays = {}
    files = [*path.glob("*.npy"), *(file for name in STATES for file in (path / name).glob("*.npy"))]
    existing = {file.relative_to(path).with_suffix("").as_posix(): file for file in sorted(files) if file.is_file()}
    _require_known(existing, path)
    for name, file in existing.items():
        try:
            arrays[name] = np.load(file, allow_pickle=False)
        except DAMAGED as error:
            raise _damaged(file, error) from None
    return arrays


def _require_known(names: Iterable[str], path: Path) -> None:
    """Refuse (``UserError``) a misspelt name: held-out states would be left out silently."""
    for name in names:
        if not _known(name):
            do = meant(name, KNOWN) or f"Known are {', '.join(KNOWN)}; leave it out."
            raise UserError(f"unknown array {name!r}", path, do)


def _known(name: str) -> bool:
    """Whether a file may hold this array; of states there may be several, by key."""
    base, _, key = name.partition("/")
    return name in KNOWN or (base in STATES and bool(key))


def _damaged(path: Path, error: Exception) -> UserError:
    if "pickle" in str(error):
        return UserError("an array holds Python objects, which are not read", path, "Give arrays of numbers.")
    return UserError("the arrays are damaged", path, "Write them again with numpy.")
