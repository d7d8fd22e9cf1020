"""LeRobotDataset, formats v2.1 and v3.0: tables in parquet, frames in films or in the tables, facts in ``meta/``.

In v2.1 each episode has files of its own, in v3.0 many episodes share files, and ``meta/episodes/`` says where in a
film an episode begins. The package lerobot is not needed, pyarrow and PyAV are (``hypogoal[lerobot]``).
"""

import json
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from hypogoal.data import Integers
from hypogoal.importing.episodes import Array, Episode
from hypogoal.importing.files import needed, reading
from hypogoal.importing.films import EXTRA, frames_in
from hypogoal.importing.pictures import picture_of

INFO, EPISODES = Path("meta") / "info.json", Path("meta") / "episodes"
DO = "Give the folder of a whole LeRobotDataset in format v2.1 or v3.0."
OWNER = "episode_index"  # a column of every table
NUMBERS = ("float", "int", "uint", "bool")  # how the types of all others begin that are read


def read_lerobot(
    source: Path,
    keys: Sequence[str],
    left: Counter[str],
) -> Iterator[Episode]:
    """The episodes of a dataset, with ``keys`` of its features beside all ``observation*``."""
    with reading(source, DO):
        text = (source / INFO).read_text(encoding="utf-8-sig")
        info = json.loads(text)
        table_of = lru_cache(maxsize=1)(_table)  # the episodes of a file come together
        for row in _listed(source):
            place = partial(_place, source, info, row)
            file = place("data_path", "data")
            table = table_of(file)
            is_own = np.array(table[OWNER]) == row[OWNER]
            frames = table.filter(is_own)
            columns = {}
            seen: dict[str, Any] = {}
            for key, feature in info["features"].items():
                kind = feature["dtype"]
                if kind.startswith(NUMBERS):
                    values = np.array(frames[key].to_pylist())
                    columns[key] = values.reshape(len(frames), *feature["shape"])
                if key not in keys and not key.startswith("observation"):
                    continue
                if kind == "video":
                    film = place("video_path", f"videos/{key}", key)
                    begin = row.get(f"videos/{key}/from_timestamp", 0.0)
                    seen[key] = partial(frames_in, film, rate=info["fps"], begin=begin)
                elif kind == "image":
                    seen[key] = partial(_cells, file, frames[key])
                else:
                    seen[key] = columns.get(key)
            yield Episode(
                str(row[OWNER]),
                len(frames),
                seen,
                columns,
            )


def _listed(source: Path) -> list[dict[str, Any]]:
    """What ``meta/`` says of each episode."""
    file = source / EPISODES.with_suffix(".jsonl")
    if file.exists():
        text = file.read_text(encoding="utf-8-sig")
        lines = filter(str.strip, text.splitlines())
        return [*map(json.loads, lines)]
    rows: list[dict[str, Any]] = []
    files = (source / EPISODES).glob("*/*.parquet")
    for file in sorted(files):
        rows += _table(file).to_pylist()
    return rows


def _place(
    source: Path,
    info: Mapping[str, Any],
    row: Mapping[str, Any],
    name: str,
    head: str,
    key: str = "",
) -> Path:
    """Where an episode's table or film lies: its row of the list says so in v3.0."""
    size = info.get("chunks_size", 1000)
    chunk = row.get(f"{head}/chunk_index", row[OWNER] // size)
    file = row.get(f"{head}/file_index", row[OWNER])
    place = info[name].format(
        video_key=key,
        chunk_index=chunk,
        file_index=file,
        episode_chunk=chunk,
        episode_index=file,
    )
    return source / place


def _table(file: Path) -> Any:
    parquet = needed("pyarrow.parquet", EXTRA)
    with reading(file), file.open("rb") as raw:
        return parquet.ParquetFile(raw).read(use_threads=False)


def _cells(file: Path, column: Any, rows: Integers) -> Iterator[Array]:
    """The pictures in cells of a table, ``{bytes, path}``."""
    for cell in column.take(rows).to_pylist():
        yield picture_of(cell["bytes"], file)
