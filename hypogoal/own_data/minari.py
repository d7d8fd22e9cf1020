"""Minari datasets: import of episodes, labelled by functions, without the package."""

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hypogoal.core.errors import UserError
from hypogoal.core.files import read_json
from hypogoal.core.hdf5 import find, members, open_hdf5, read_array
from hypogoal.own_data.parts import Parts, Source
from hypogoal.own_data.recordings import split_episodes

MINARI = Path("data") / "main_data.hdf5"  # in a dataset's folder
METADATA = Path("data") / "metadata.json"
DO = "Give the folder of a Minari dataset in the format 'hdf5', for example ~/.minari/datasets/NAME-v0."

Label = Callable[[Any], bool]  # from an observation, by key if it has several, to whether the sub-goal holds


def read_minari(folder: Path, labels: Sequence[Label], *, keys: Sequence[str] = (), seed: int = 0) -> Parts:
    """The observations of a dataset; each whole episode is labelled, unlabelled or held out, drawn by ``seed``.

    ``folder`` contains ``data/``; ``keys`` select parts of observations that are dictionaries. A missing dataset,
    another storage format, too few episodes, and a label function that fails are a ``UserError``.
    """
    if not labels:
        raise UserError("a Minari dataset has no labels", folder, "Give --label NAME=module:function.")
    metadata = read_json(folder / METADATA, "the metadata are", DO)
    stored = metadata.get("data_format", "hdf5") if isinstance(metadata, dict) else None
    if stored != "hdf5":
        raise UserError(f"the storage format {stored!r} is not read", folder, DO)
    space = metadata.get("observation_space")
    read = {key: _episodes(folder / MINARI, key, _picture_shape(space, key)) for key in keys or ("",)}
    names, episodes = next(iter(read.values()))
    parts = split_episodes(len(names), range(len(names)), seed, folder)
    by_key = [{key: np.concatenate([of[i] for i in part]) for key, (_, of) in read.items()} for part in parts]
    labelled, unlabelled, heldout = (some if len(keys) > 1 else next(iter(some.values())) for some in by_key)

    steps = [[f"{names[i]}, step {step}" for i in part for step in range(len(episodes[i]))] for part in parts]

    def name(field: str, row: int) -> str:
        return steps[("observations", "unlabelled", "heldout_observations").index(field)][row]

    return Parts(labelled, _labels(labels, labelled), unlabelled, heldout, _labels(labels, heldout), name=name)


def _episodes(path: Path, key: str, shape: tuple[int, ...] | None) -> tuple[list[str], list[NDArray[Any]]]:
    """The names of the episodes, and the observations of each."""
    with open_hdf5(path, "the dataset", DO) as file:
        names = sorted(
            (name for name in members(file) if name.startswith("episode_")), key=lambda name: (len(name), name)
        )
        place = f"observations/{key}" if key else "observations"
        if names and not key and hasattr(find(file, f"{names[0]}/observations"), "keys"):
            keys = ", ".join(members(find(file, f"{names[0]}/observations")))
            raise UserError("its observations are dictionaries", path, f"Give --key, one of {keys}.")
        stored = getattr(find(file, f"{names[0]}/{place}"), "shape", None) if names and shape else None
        if stored is not None and stored[1:] != shape:
            fault = "its images are stored as JPEG, not as they were seen"
            raise UserError(fault, path, "Make it with jpeg_encoding=False.")
        places = [f"{name}/{place}" for name in names]
        episodes = [read_array(file, name, "uif") for name in places]
    if len({episode.shape[1:] for episode in episodes}) > 1 or not all(episode.ndim for episode in episodes):
        raise UserError("its episodes have observations of different shapes", path, "Give those of one shape.")
    return names, episodes


def _picture_shape(space: object, key: str) -> tuple[int, ...] | None:
    """The shape in the JSON of a space of pictures, which Minari may store as JPEG; None for any other space."""
    try:
        box = json.loads(space) if isinstance(space, str) else {}
        box = box["subspaces"][key] if key else box
        shape = tuple(box["shape"])
        return shape if (box["type"], box["dtype"]) == ("Box", "uint8") and len(shape) in (2, 3) else None
    except (ValueError, KeyError, TypeError, RecursionError):
        return None


def _labels(labels: Sequence[Label], states: Source) -> NDArray[np.bool_]:
    """The functions' labels of each observation, bool (N, G)."""
    observations: Any = states
    if isinstance(states, Mapping):
        observations = [dict(zip(states, row, strict=True)) for row in zip(*states.values(), strict=True)]
    truths = np.empty((len(observations), len(labels)), np.bool_)
    for column, label in enumerate(labels):
        truths[:, column] = [bool(label(observation)) for observation in observations]
    return truths
