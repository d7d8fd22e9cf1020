"""Readers of recorded episodes: Minari, robomimic's HDF5, folders of films, and LeRobotDataset (Spec I6)."""

import json
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from hypogoal.core.errors import UserError
from hypogoal.data import reading as reading_hdf5
from hypogoal.importing.episodes import HELDOUT, Array, Episode
from hypogoal.importing.files import files_of, needed, reading
from hypogoal.importing.films import SUFFIXES, count_frames, frames_in
from hypogoal.importing.lerobot import INFO, read_lerobot

MINARI = Path("data") / "metadata.json"  # in a dataset's folder
HDF5 = (".h5", ".hdf5")
DEMOS = "Give a file with data/demo_0/obs, as robomimic's dataset_states_to_obs.py writes it."
SMALL = 32  # Minari keeps pictures with a shorter side as they are
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
    minari = needed("minari", "minari")
    with reading(source):
        text = (source / MINARI).read_text(encoding="utf-8")
        jpeg = json.loads(text).get("jpeg_encoding", True)
        dataset = minari.MinariDataset(source / MINARI.parent)
        for recorded in dataset.iterate_episodes():
            columns = {
                "rewards": np.append(0, recorded.rewards),
                "terminations": np.append(0, recorded.terminations),
            }
            name = f"episode_{recorded.id}"
            episode = _episode(name, recorded.observations, columns)
            for key, values in episode.observations.items():
                read = not keys or key in keys
                if jpeg and read and _is_large_picture(values):
                    fault = "its images are stored as JPEG, not as they were seen"
                    raise UserError(fault, source, "Make it with jpeg_encoding=False.")
            yield episode


def _is_large_picture(values: Any) -> bool:
    """Whether Minari stores these states (T, ...) as JPEG unless told not to."""
    if getattr(values, "dtype", None) != np.uint8:
        return False
    return values.ndim > 2 and min(values.shape[1:3]) >= SMALL


def read_robomimic(
    source: Path,
    keys: Sequence[str],
    left: Counter[str],
) -> Iterator[Episode]:
    """The demonstrations ``data/*/obs/KEY``; those that ``mask/valid`` lists are held out."""
    with reading_hdf5(source, "the recording", DEMOS) as file:
        demos = file["data"]
        valid: list[bytes] = []
        if "mask/valid" in file:
            valid = file["mask/valid"][()].tolist()
        by_number = sorted(demos, key=len)  # HDF5 lists names in order: demo_10 before demo_2
        for name in by_number:
            demo = demos[name]
            columns = {}
            for key, part in demo.items():
                if getattr(part, "ndim", 0) == 1:
                    columns[key] = part[()]
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
    lengths = map(len, leaves.values())
    return Episode(name, max(lengths, default=0), leaves, columns, role)


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
