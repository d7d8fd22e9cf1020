"""Minari datasets: import of episodes, labelled by functions, and export of agents' episodes, without the package."""

import json
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hypogoal.core.errors import UserError
from hypogoal.core.files import read_json
from hypogoal.core.hdf5 import create_hdf5, find, members, open_hdf5, read_array
from hypogoal.core.own_code import UsersCode
from hypogoal.data import write_observations
from hypogoal.meta.episodes import Episode
from hypogoal.observations import PICTURE
from hypogoal.own_data.parts import Parts, Source
from hypogoal.own_data.recordings import split_episodes

MINARI = Path("data") / "main_data.hdf5"  # in a dataset's folder
METADATA = Path("data") / "metadata.json"
DO = "Give the folder of a Minari dataset in the format 'hdf5', for example ~/.minari/datasets/NAME-v0."
MINARI_VERSION = "0.5.4"  # its layout is written

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
        with UsersCode(f"the label function {getattr(label, '__name__', column)}", label) as code:
            truths[:, column] = [code.truth(label(observation), "the label") for observation in observations]
    return truths


def write_minari(folder: Path, episodes: Iterable[Episode], *, name: str, actions: int, description: str) -> int:
    """Write at least one episode as a Minari dataset of format ``hdf5``, pictures uncompressed; returns its steps.

    ``name`` is the dataset's id, such as ``doorkey/options-v0``; ``actions`` is the number of primitive actions.
    ``infos/option`` is the option that led to each state, -1 at the start.
    """
    seen: Any = None
    total = count = 0
    (folder / MINARI).parent.mkdir(parents=True)
    with create_hdf5(folder / MINARI) as file:
        for episode in episodes:
            group, steps = file.create_group(f"episode_{count}"), len(episode.actions)
            seen = episode.observations
            group.attrs["id"], group.attrs["total_steps"] = count, steps
            write_observations(group, episode.observations)
            last = np.arange(steps) == steps - 1
            group["actions"], group["rewards"] = episode.actions, episode.rewards
            group["terminations"], group["truncations"] = last & episode.terminated, last & (not episode.terminated)
            group["infos/option"] = np.concatenate([[-1], episode.options])
            total, count = total + steps, count + 1
    shape, bounds = seen.shape[1:], (0, 255) if seen.dtype == PICTURE else (-math.inf, math.inf)
    spaces = {
        "observation_space": {"type": "Box", "dtype": str(seen.dtype), "shape": list(shape)}
        | {bound: np.full(shape, value).tolist() for bound, value in zip(("low", "high"), bounds, strict=True)},
        "action_space": {"type": "Discrete", "dtype": "int64", "start": 0, "n": actions},
    }
    metadata = {
        "total_episodes": count,
        "total_steps": total,
        "data_format": "hdf5",
        "jpeg_encoding": False,
        "dataset_id": name,
        "minari_version": MINARI_VERSION,
        "algorithm_name": "hypogoal",
        "description": description,
        **{name: json.dumps(space) for name, space in spaces.items()},
    }
    (folder / METADATA).write_text(json.dumps(metadata) + "\n", encoding="utf-8")
    return total
