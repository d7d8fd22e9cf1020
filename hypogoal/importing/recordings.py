"""Readers of recorded episodes: Minari, LeRobotDataset, robomimic's HDF5, folders of films (Spec I6)."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from hypogoal.core.errors import UserError
from hypogoal.importing import films
from hypogoal.importing.episodes import Recording, episode_of
from hypogoal.importing.files import files_of, needed, reading
from hypogoal.importing.lerobot import INFO, read_lerobot

MINARI = Path("data") / "metadata.json"  # in a dataset's folder
HDF5 = (".h5", ".hdf5")
DEMOS = "Give a file with data/demo_0/obs, as robomimic's dataset_states_to_obs.py writes it."
DATASET = "Give the folder of a Minari dataset, for example ~/.minari/datasets/NAME-v0."
NO_JPEG = 32  # Minari keeps pictures with a shorter side as they are
TABLE = ".csv"  # labels of films, beside them

# From a source, the keys to read and what counts, by suffix, files that are not read.
Reader: TypeAlias = Callable[[Path, Sequence[str], Counter[str]], Iterator[Recording]]


def reader_of(source: Path) -> Reader | None:
    """What reads a recording; None of what is none."""
    if (source / MINARI).exists():
        return read_minari
    if (source / INFO).exists():
        return read_lerobot
    if source.is_file():
        return read_robomimic if source.suffix.lower() in HDF5 else None
    return read_films if files_of(source, films.SUFFIXES, Counter()) else None


def read_minari(source: Path, keys: Sequence[str], left: Counter[str]) -> Iterator[Recording]:
    """The episodes of a dataset in any of Minari's formats; T is one more than the steps."""
    minari = needed("minari", "hypogoal[minari]")
    with reading(source, DATASET):
        facts = json.loads((source / MINARI).read_text(encoding="utf-8"))
        dataset = minari.MinariDataset(source / MINARI.parent)
        for recorded in dataset.iterate_episodes():
            columns = {"rewards": np.append(0, recorded.rewards), "terminations": np.append(0, recorded.terminations)}
            episode = episode_of(f"episode_{recorded.id}", recorded.observations, columns)
            if facts.get("jpeg_encoding", True):
                _refuse_jpeg(episode, keys, source)
            yield episode


def _refuse_jpeg(episode: Recording, keys: Sequence[str], source: Path) -> None:
    """Minari stores pictures as JPEG unless told not to: these are not what the agent saw."""
    for key in keys or episode.observations:
        rows = episode.observations.get(key)
        [first] = rows(np.arange(1)) if rows else [np.zeros(())]
        if first.dtype == np.uint8 and first.ndim in (2, 3) and min(first.shape[:2]) >= NO_JPEG:
            do = "Make it with jpeg_encoding=False."
            raise UserError("its images are stored as JPEG, not as they were seen", source, do)


def read_robomimic(source: Path, keys: Sequence[str], left: Counter[str]) -> Iterator[Recording]:
    """The demonstrations ``data/*/obs/KEY``; those that ``mask/valid`` lists are held out."""
    import h5py

    with reading(source, DEMOS), h5py.File(source) as file:
        demos = file.get("data", {})
        valid = {name.decode() for name in file["mask/valid"][()]} if "mask/valid" in file else set()
        found = [name for name in demos if "obs" in demos[name]]
        if not found:
            raise UserError(f"it has no data/demo_0/obs but {', '.join(file) or 'nothing'}", source, DEMOS)
        for name in sorted(found, key=lambda name: (len(name), name)):
            demo = demos[name]
            columns = {key: part[()] for key, part in demo.items() if getattr(part, "ndim", 0) == 1}
            yield episode_of(name, demo["obs"], columns, held_out=name in valid)


def read_films(source: Path, keys: Sequence[str], left: Counter[str]) -> Iterator[Recording]:
    """The films in a folder, an episode each, called by their path in it."""
    files = files_of(source, films.SUFFIXES, left)
    left.pop(TABLE, None)
    for file in files:
        frames: dict[str, Any] = {"video": partial(films.frames_at, file)}
        name = file.relative_to(source).with_suffix("").as_posix()
        yield Recording(name, films.count_frames(file), frames, {})
