"""Readers of recorded episodes: Minari, robomimic's HDF5, folders of films, and LeRobotDataset (Spec I6).

A LeRobotDataset, formats v2.1 and v3.0, has tables in parquet, frames in films or in the tables, facts in ``meta/``. In
v2.1 each episode has files of its own, in v3.0 many episodes share files, and ``meta/episodes/`` says where in a film
an episode begins. The package lerobot is not needed, pyarrow and PyAV are (``hypogoal[lerobot]``).
"""

import json
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import pandas as pd

from hypogoal.core.files import reading
from hypogoal.data import Integers, opened
from hypogoal.importing.pictures import FILMS, count_frames, frames_in, picture_of
from hypogoal.importing.states import HELDOUT, Array, Episode, files_of

MINARI = Path("data") / "metadata.json"  # in a dataset's folder
INFO, EPISODES = Path("meta") / "info.json", Path("meta") / "episodes"
OWNER = "episode_index"  # a column of every table
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
    films = files_of(source, FILMS, Counter())
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
    for file in files_of(source, FILMS, left):
        name = file.relative_to(source).with_suffix("")
        seen = {"video": partial(frames_in, file)}
        yield Episode(name.as_posix(), count_frames(file), seen, {})
    left.pop(TABLE, None)


def read_lerobot(
    source: Path,
    keys: Sequence[str],
    left: Counter[str],
) -> Iterator[Episode]:
    """The episodes of a dataset, with ``keys`` of its features beside all ``observation*``."""
    text = (source / INFO).read_text(encoding="utf-8-sig")
    info = json.loads(text)
    table_of = lru_cache(maxsize=1)(_table)  # the episodes of a file come together
    listed = _listed(source)
    listed["episode_chunk"] = listed[OWNER] // info.get("chunks_size", 1000)
    for row in listed.to_dict("records"):
        file = source / info["data_path"].format(**_facts(row, "data"))
        table = table_of(file)
        frames = table[table[OWNER] == row[OWNER]]
        columns = {}
        seen: dict[str, Any] = {}
        for key, feature in info["features"].items():
            if feature["dtype"] == "video":
                facts = _facts(row, f"videos/{key}")
                film = source / info["video_path"].format(video_key=key, **facts)
                values: Any = partial(
                    frames_in,
                    film,
                    rate=info["fps"],
                    begin=facts["from_timestamp"],
                )
            elif feature["dtype"] == "image":
                values = partial(_cells, file, frames[key])
            else:
                values = np.array(frames[key].tolist())
                if values.ndim == 1:
                    columns[key] = values
            if key in keys or key.startswith("observation"):
                seen[key] = values
        yield Episode(str(row[OWNER]), len(frames), seen, columns)


def _listed(source: Path) -> pd.DataFrame:
    """What ``meta/`` says of each episode."""
    file = source / EPISODES.with_suffix(".jsonl")
    if file.exists():
        return pd.read_json(file, lines=True, encoding="utf-8-sig")
    files = (source / EPISODES).glob("*/*.parquet")
    return pd.concat(map(_table, sorted(files)))


def _facts(row: Mapping[Any, Any], head: str) -> dict[Any, Any]:
    """The row of an episode with what it says of its table or film in v3.0: the file's numbers, and when it begins."""
    facts = dict(row)
    for name in ("chunk_index", "file_index", "from_timestamp"):
        facts[name] = row.get(f"{head}/{name}", 0)
    return facts


def _table(file: Path) -> pd.DataFrame:
    with reading(file):
        return pd.read_parquet(file, engine="pyarrow", dtype_backend="pyarrow", partitioning=None)


def _cells(file: Path, column: Any, rows: Integers) -> Iterator[Array]:
    """The pictures in cells of a table, ``{bytes, path}``."""
    for cell in column.iloc[rows]:
        yield picture_of(cell["bytes"], file)


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
