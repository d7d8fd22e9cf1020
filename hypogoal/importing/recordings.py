"""Readers of recorded episodes: Minari, robomimic's HDF5, folders of films, and LeRobotDataset (Spec I6)."""

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from hypogoal.data import opened
from hypogoal.importing.episodes import HELDOUT, Array, Episode, files_of
from hypogoal.importing.films import SUFFIXES, count_frames, frames_in
from hypogoal.importing.lerobot import INFO, read_lerobot

MINARI = Path("data") / "metadata.json"  # in a dataset's folder
HDF5 = (".h5", ".hdf5")
DEMOS = "Give a file with data/demo_0/obs, as robomimic's dataset_states_to_obs.py writes it; arrays as .npz."
TABLE = ".csv"  # labels of films, beside them

# From a source, the keys to read, and what counts by suffix the files that are not read.
Reader: TypeAlias = Callable[[Path, Sequence[str], Counter[str]], Iterator[Episode]]


def reader_of(source: Path) -> Reader | None:
    """What reads a recording; None of what is none."""
    if (source / MINARI).exists():
        return read_minari
    if (source / INFO).exists():
        return read_lerobot
    if source.suffix.lower() in HDF5:
        return read_robomimic
    films = files_of(source, SUFFIXES, Counter())
    return read_films if films else None


def read_minari(
    source: Path,
    keys: Sequence[str],
    left: Counter[str],
) -> Iterator[Episode]:
    """The episodes of a dataset in any of Minari's formats; T is one more than the steps."""
    import minari

    dataset = minari.MinariDataset(source / MINARI.parent)
    for recorded in dataset.iterate_episodes():
        columns = {
            "rewards": np.append(0, recorded.rewards),
            "terminations": np.append(0, recorded.terminations),
        }
        yield _episode(f"episode_{recorded.id}", recorded.observations, columns)


def read_robomimic(
    source: Path,
    keys: Sequence[str],
    left: Counter[str],
) -> Iterator[Episode]:
    """The demonstrations ``data/*/obs/KEY``; those that ``mask/valid`` lists are held out."""
    with opened(source, DEMOS, "the recording") as file:
        demos = file["data"]
        valid = np.array(file.get("mask/valid", ()))
        by_number = sorted(demos, key=len)  # HDF5 lists names in order: demo_10 before demo_2
        for name in by_number:
            demo = demos[name]
            columns = {key: part[()] for key, part in demo.items() if getattr(part, "ndim", 0) == 1}
            role = HELDOUT if name.encode() in valid else ""
            yield _episode(name, demo["obs"], columns, role)


def read_films(
    source: Path,
    keys: Sequence[str],
    left: Counter[str],
) -> Iterator[Episode]:
    """The films in a folder, an episode each, called by their path in it."""
    for file in files_of(source, SUFFIXES, left):
        name = file.relative_to(source).with_suffix("")
        seen = {"video": partial(frames_in, file)}
        yield Episode(name.as_posix(), count_frames(file), seen, {})
    left.pop(TABLE, None)


def _episode(name: str, observations: Any, columns: Mapping[str, Array], role: str = "") -> Episode:
    """An episode whose observations are arrays (T, ...) in nested dictionaries, HDF5 groups or tuples."""
    leaves = _leaves(observations, "")
    length = max(map(len, leaves.values()), default=0)
    return Episode(name, length, leaves, columns, role)


def _leaves(values: Any, place: str) -> dict[str, Any]:
    """The arrays by key: ``robot/position``; of an observation that is not nested by ""."""
    if isinstance(values, tuple):
        values = dict(enumerate(values))
    if not hasattr(values, "items"):
        return {place: values}
    leaves = {}
    for key, part in values.items():
        inner = f"{place}/{key}".removeprefix("/")
        leaves.update(_leaves(part, inner))
    return leaves
