"""NumPy arrays: a ``.npz`` file, or a folder of ``.npy`` files with the same names."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hypogoal.core.config import meant
from hypogoal.core.errors import UserError
from hypogoal.data import Dataset
from hypogoal.importing.files import reading
from hypogoal.importing.parts import Given, Parts
from hypogoal.observations import NUMBERS, Observations, fields_of

STATES = ("observations", "unlabelled", "heldout_observations")
NEEDED = ("observations", "labels", "unlabelled")
KNOWN = (*NEEDED, "heldout_observations", "heldout_labels", "sub_goals", "features")
DO = "Give a .npz file that numpy.savez wrote, of numbers, not of Python objects."


def read_arrays(path: Path, group: str = "") -> Parts:
    """The arrays in a file or a folder, see :func:`parts_of`."""
    return parts_of(_folder(path) if path.is_dir() else _file(path), path, group)


def parts_of(arrays: dict[str, NDArray[Any]], path: Path, group: str = "") -> Parts:
    """Arrays by name: ``NEEDED``, perhaps held-out states, ``sub_goals`` (G texts) and ``features``.

    Mixed observations have an array for each key: ``observations/front``. ``group`` names another array, (N,): labelled
    states with equal values there belong together, and unlabelled ones by the array ``unlabelled_GROUP``. Missing and
    misspelt names are a ``UserError``.
    """
    arrays = dict(arrays)
    groups = {name: arrays.pop(name, None) for name in (group, f"unlabelled_{group}") if group}
    if group and groups[group] is None:
        raise UserError(f"no array {group!r} to group by", path, f"There are {', '.join(arrays)}.")
    sources = _by_key(arrays, path)
    missing = [name for name in NEEDED if name not in sources]
    if missing:
        do = (
            f"Give arrays called {', '.join(NEEDED)}, and heldout_observations and heldout_labels where there are some."
        )
        raise UserError(f"no array {missing[0]!r}", path, do)
    if ("heldout_observations" in sources) != ("heldout_labels" in sources):
        do = "Give heldout_observations and heldout_labels."
        raise UserError("held-out states need observations and labels", path, do)

    def given(name: str, labels: str = "", group: str = "") -> Given:
        states = sources[name]
        count = len(next(iter(states.values())) if isinstance(states, dict) else states)
        return Given(states, [f"{name}[{row}]" for row in range(count)], sources.get(labels), groups.get(group))

    return Parts(
        given("observations", "labels", group),
        given("unlabelled", group=f"unlabelled_{group}"),
        given("heldout_observations", "heldout_labels") if "heldout_labels" in sources else None,
        _texts(sources, "sub_goals", path),
        _texts(sources, "features", path),
    )


def _by_key(arrays: dict[str, NDArray[Any]], path: Path) -> dict[str, Any]:
    """Arrays by name, those of ``STATES`` perhaps by key; a misspelt name is refused, or states would be left out."""
    sources: dict[str, Any] = {}
    for name, values in arrays.items():
        base, _, key = name.partition("/")
        if name not in KNOWN and not (key and base in STATES):
            do = meant(name, KNOWN) or f"Known are {', '.join(KNOWN)}; leave it out, or is it for --group?"
            raise UserError(f"unknown array {name!r}", path, do)
        if base in sources and (not key or not isinstance(sources[base], dict)):
            raise UserError(f"{base!r} is one array and several by key", path, "Give either.")
        if key:
            sources.setdefault(base, {})[key] = values
        else:
            sources[base] = values
    return sources


def _texts(sources: dict[str, Any], name: str, path: Path) -> tuple[str, ...]:
    if name not in sources:
        return ()
    if sources[name].dtype.kind != "U":
        raise UserError(f"{name} are {sources[name].dtype}, not texts", path, "Give numpy.array of str.")
    return tuple(map(str, sources[name].ravel()))


def _file(path: Path) -> dict[str, NDArray[Any]]:
    with reading(path, DO), np.load(path, allow_pickle=False) as arrays:
        return {name: arrays[name] for name in arrays.files}


def _folder(path: Path) -> dict[str, NDArray[Any]]:
    arrays = {}
    for file in sorted(path.rglob("*.npy")):
        with reading(file, DO):
            arrays[file.relative_to(path).with_suffix("").as_posix()] = np.load(file, allow_pickle=False)
    return arrays


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
    arrays: dict[str, Any] = {
        "labels": np.stack(columns["labelled"], axis=1),
        "heldout_labels": np.stack(columns["heldout"], axis=1),
        "sub_goals": np.array(dataset.sub_goals),
    }
    if dataset.observation_dtype == NUMBERS:
        arrays["features"] = np.array(dataset.features())
    for name, some in zip(STATES, (first["labelled"], dataset.unlabelled(), first["heldout"]), strict=True):
        for key in fields_of(dataset.observation_shape, dataset.observation_dtype):
            arrays[f"{name}/{key}" if key else name] = some[key] if key else some
    with path.open("wb") as file:
        np.savez_compressed(file, allow_pickle=False, **arrays)
