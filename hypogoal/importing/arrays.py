"""NumPy arrays: a ``.npz`` file, or a folder of ``.npy`` files with the same names."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from hypogoal.core.config import near
from hypogoal.core.errors import UserError
from hypogoal.data import Dataset
from hypogoal.importing.files import reading
from hypogoal.importing.parts import Array, Given, Parts
from hypogoal.importing.taken import channels_of
from hypogoal.observations import NUMBERS, fields_of

STATES = ("observations", "unlabelled", "heldout_observations")  # there may be one of these for each key
NEEDED = ("observations", "labels", "unlabelled")
KNOWN = (*NEEDED, "heldout_observations", "heldout_labels", "sub_goals", "features")
DO = "Give a .npz file that numpy.savez wrote, of numbers, not of Python objects."


def read_arrays(path: Path, group: str = "") -> Parts:
    """The arrays in a file or a folder, see :func:`parts_of`."""
    arrays: dict[str, Array] = {}
    if path.is_dir():
        for file in sorted(path.rglob("*.npy")):
            with reading(file, DO):
                arrays[file.relative_to(path).with_suffix("").as_posix()] = np.load(file, allow_pickle=False)
    else:
        # NumPy leaves a cut archive open.
        with reading(path, DO), path.open("rb") as raw, np.load(raw, allow_pickle=False) as stored:
            arrays.update(stored)
    return parts_of(arrays, path, group)


def parts_of(arrays: Mapping[str, Array], path: Path, group: str = "") -> Parts:
    """Arrays by name: ``NEEDED``, perhaps held-out states, ``sub_goals`` (G texts) and ``features``.

    Mixed observations have an array for each key: ``observations/front``. ``group`` names another array, (N,): labelled
    states with equal values there belong together, and unlabelled ones by the array ``unlabelled_GROUP``. Missing and
    misspelt names are a ``UserError``.
    """
    groups = (group, f"unlabelled_{group}") if group else ()
    by_name: dict[str, dict[str, Array]] = {}
    for name, values in arrays.items():
        base, _, key = name.partition("/")
        if name not in (*KNOWN, *groups) and not (key and base in STATES):
            do = near(name, KNOWN) or f"Known are {', '.join(KNOWN)}; leave it out, or is it for --group?"
            raise UserError(f"unknown array {name!r}", path, do)
        by_name.setdefault(base, {})[key] = values
    for name in (*NEEDED, *groups[:1]):
        if name not in by_name:
            do = f"There are {', '.join(arrays)}; needed are {', '.join(NEEDED)}."
            raise UserError(f"no array {name!r}", path, do)
    for name, by_key in by_name.items():
        if "" in by_key and len(by_key) > 1:
            raise UserError(f"{name!r} is one array and several by key", path, "Give either.")
        if name in ("sub_goals", "features") and by_key[""].dtype.kind != "U":
            raise UserError(f"{name} are {by_key[''].dtype}, not texts", path, "Give numpy.array of str.")
    if ("heldout_observations" in by_name) != ("heldout_labels" in by_name):
        do = "Give heldout_observations and heldout_labels."
        raise UserError("held-out states need observations and labels", path, do)
    plain = {name: by_key.get("") for name, by_key in by_name.items()}

    def given(name: str, labels: str, group: str) -> Given:
        count = len(next(iter(by_name[name].values())))
        return Given(by_name[name], [f"{name}[{row}]" for row in range(count)], plain.get(labels), plain.get(group))

    channels = {}
    for key, values in by_name["observations"].items():
        channels.update(channels_of(values[0], key) if len(values) else {})
    return Parts(
        given("observations", "labels", group),
        given("unlabelled", "", f"unlabelled_{group}"),
        given("heldout_observations", "heldout_labels", "") if "heldout_labels" in by_name else None,
        _texts(plain.get("sub_goals")),
        _texts(plain.get("features")),
        channels,
    )


def _texts(values: Array | None) -> tuple[str, ...]:
    return () if values is None else tuple(map(str, values.ravel()))


def write_arrays(path: Path, dataset: Dataset) -> None:
    """Write a data file's states for :func:`read_arrays`; a ``UserError`` if its sub-goals do not share them."""
    arrays: dict[str, Any] = {}
    shared = {"unlabelled": dataset.unlabelled()}
    for split, name, labels in (
        ("labelled", "observations", "labels"),
        ("heldout", "heldout_observations", "heldout_labels"),
    ):
        columns = []
        for goal in dataset.sub_goals:
            states = getattr(dataset, split)(goal)
            if not np.array_equal(shared.setdefault(name, states.observations), states.observations):
                raise UserError("its sub-goals do not share their states", dataset.path, "Read it with h5py instead.")
            columns.append(states.labels)
        arrays[labels] = np.stack(columns, axis=1)
    arrays["sub_goals"] = np.array(dataset.sub_goals)
    if dataset.observation_dtype == NUMBERS:
        arrays["features"] = np.array(dataset.features())
    for name in STATES:
        states = shared[name]
        for key in fields_of(dataset.observation_shape, dataset.observation_dtype):
            arrays[f"{name}/{key}" if key else name] = states[key] if key else states
    with path.open("wb") as file:
        np.savez_compressed(file, allow_pickle=False, **arrays)
