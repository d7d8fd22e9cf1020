"""Readers of recorded episodes: Minari, LeRobotDataset, robomimic's HDF5, folders of films (Spec I6)."""

import json
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import TypeAlias

import numpy as np

from hypogoal.core.errors import UserError
from hypogoal.data import reading as reading_hdf5
from hypogoal.importing.episodes import Recording, recording_of
from hypogoal.importing.files import files_of, needed, reading
from hypogoal.importing.films import SUFFIXES, count_frames, frames_at
from hypogoal.importing.lerobot import INFO, read_lerobot

MINARI = Path("data") / "metadata.json"  # in a dataset's folder
HDF5 = (".h5", ".hdf5")
DEMOS = "Give a file with data/demo_0/obs, as robomimic's dataset_states_to_obs.py writes it."
DATASET = "Give the folder of a Minari dataset, for example ~/.minari/datasets/NAME-v0."
SMALL = 32  # Minari keeps pictures with a shorter side as they are
TABLE = ".csv"  # labels of films, beside them

# From a source, the keys to read, and what counts by suffix the files that are not read.
Reader: TypeAlias = Callable[[Path, Sequence[str], Counter[str]], Iterator[Recording]]


def reader_of(source: Path) -> Reader | None:
    """What reads a recording; None of what is none."""
    if (source / MINARI).exists():
        return read_minari
    if (source / INFO).exists():
        return read_lerobot
    if source.is_file():
        return read_robomimic if source.suffix.lower() in HDF5 else None
    return read_films if files_of(source, SUFFIXES, Counter()) else None


def read_minari(source: Path, keys: Sequence[str], left: Counter[str]) -> Iterator[Recording]:
    """The episodes of a dataset in any of Minari's formats; T is one more than the steps."""
    minari = needed("minari", "minari")
    with reading(source, DATASET):
        facts = json.loads((source / MINARI).read_text(encoding="utf-8"))
        for episode in minari.MinariDataset(source / MINARI.parent).iterate_episodes():
            columns = {name: np.append(0, getattr(episode, name)) for name in ("rewards", "terminations")}
            recording = recording_of(f"episode_{episode.id}", episode.observations, columns)
            for key in (keys or recording.observations) if facts.get("jpeg_encoding", True) else ():
                _refuse_jpeg(recording, key, source)
            yield recording


def _refuse_jpeg(recording: Recording, key: str, source: Path) -> None:
    """Minari stores pictures as JPEG unless told not to: these are not what the agent saw."""
    for first in recording.observations[key](np.arange(1)) if key in recording.observations else ():
        if first.dtype == np.uint8 and first.ndim in (2, 3) and min(first.shape[:2]) >= SMALL:
            do = "Make it with jpeg_encoding=False."
            raise UserError("its images are stored as JPEG, not as they were seen", source, do)


def read_robomimic(source: Path, keys: Sequence[str], left: Counter[str]) -> Iterator[Recording]:
    """The demonstrations ``data/*/obs/KEY``; those that ``mask/valid`` lists are held out."""
    with reading(source, DEMOS), reading_hdf5(source, "the recording", DEMOS) as file:
        demos = file.get("data", {})
        valid = file["mask/valid"][()].tolist() if "mask/valid" in file else []
        names = [name for name in demos if "obs" in demos[name]]
        if not names:
            raise UserError(f"it has no data/demo_0/obs but {', '.join(file) or 'nothing'}", source, DEMOS)
        for name in sorted(names, key=lambda name: (len(name), name)):
            demo = demos[name]
            columns = {key: part[()] for key, part in demo.items() if getattr(part, "ndim", 0) == 1}
            yield recording_of(name, demo["obs"], columns, held_out=name.encode() in valid)


def read_films(source: Path, keys: Sequence[str], left: Counter[str]) -> Iterator[Recording]:
    """The films in a folder, an episode each, called by their path in it."""
    for file in files_of(source, SUFFIXES, left):
        name = file.relative_to(source).with_suffix("").as_posix()
        yield Recording(name, count_frames(file), {"video": partial(frames_at, file)}, {})
    left.pop(TABLE, None)
