"""LeRobotDataset, formats v2.1 and v3.0: tables in parquet, frames in films or in the tables, facts in ``meta/``.

In v2.1 each episode has files of its own, in v3.0 many episodes share files, and ``meta/episodes/`` says where in a
film an episode begins. The package lerobot is not needed, pyarrow and PyAV are (``hypogoal[lerobot]``).
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hypogoal.core.errors import UserError
from hypogoal.importing.episodes import AGAIN, Recording, Rows
from hypogoal.importing.files import needed, reading
from hypogoal.importing.films import EXTRA, frames_near
from hypogoal.importing.pictures import picture_of

INFO, EPISODES = Path("meta") / "info.json", Path("meta") / "episodes"
DO = "Give the folder of a whole LeRobotDataset in format v2.1 or v3.0."
OWNER, TIME = "episode_index", "timestamp"  # columns of every table
VIDEO, IMAGE = "video", "image"  # types of features
NUMBERS = ("float", "int", "uint", "bool")  # how the types of all others begin that are read


def read_lerobot(source: Path, keys: Sequence[str], left: Counter[str]) -> Iterator[Recording]:
    """The episodes of a dataset, with ``keys`` of its features, all ``observation*`` if none are given."""
    needed("pyarrow", EXTRA)
    with reading(source / INFO, DO):
        info = json.loads((source / INFO).read_text(encoding="utf-8-sig"))
        kinds = {key: str(feature["dtype"]) for key, feature in info["features"].items()}
        version = info["codebase_version"]
    if version[:2] not in ("v2", "v3"):
        raise UserError(f"the format {version} is not read", source, DO)
    seen = [key for key in kinds if key in keys or key.startswith("observation")]
    numbers = [key for key, kind in kinds.items() if kind.startswith(NUMBERS)]
    pictures = [key for key in keys or seen if kinds.get(key) == IMAGE]
    table_of = lru_cache(maxsize=1)(
        partial(_table, columns=[*numbers, *pictures])
    )  # episodes of one file come together
    for row in _listed(source, version):
        with reading(source, DO):
            places = _Places(source, info, row)
            table = table_of(places.table())
            own = table.filter(np.array(table[OWNER]) == places.number)
            if len(own) != row["length"]:
                fault = f"episode {places.number} has {len(own)} frames, {row['length']} are listed"
                raise UserError(fault, places.table(), AGAIN)
            values = {key: _numbers(own[key], info["features"][key]["shape"]) for key in numbers}
            observations: dict[str, Any] = {}
            for key in seen:
                if kinds[key] == VIDEO:
                    observations[key] = partial(_film, places, key, values[TIME])
                elif kinds[key] == IMAGE:
                    observations[key] = partial(_cells, places.table(), own, key)
                elif key in numbers:
                    observations[key] = values[key].__getitem__
            texts = [key for key in seen if key not in observations]
            columns = {key: column for key, column in values.items() if column.size == len(own)}
            yield Recording(str(places.number), len(own), observations, columns, texts)


def _listed(source: Path, version: str) -> list[dict[str, Any]]:
    """What ``meta/`` says of each episode."""
    if version.startswith("v2"):
        file = source / EPISODES.with_suffix(".jsonl")
        with reading(file, DO):
            lines = file.read_text(encoding="utf-8-sig").splitlines()
            return [json.loads(line) for line in lines if line.strip()]
    rows = []
    for file in sorted((source / EPISODES).glob("*/*.parquet")):
        rows += _table(file).to_pylist()
    if not rows:
        raise UserError("the list of episodes is empty", source / EPISODES, DO)
    return rows


class _Places:
    """Where the parts of an episode lie; its ``row`` of the list of episodes says so in v3.0, its number in v2.1."""

    def __init__(self, source: Path, info: Mapping[str, Any], row: Mapping[str, Any]):
        self.source, self.info, self.row = source, info, row
        self.number = int(row[OWNER])
        self.old = "data/chunk_index" not in row

    def table(self) -> Path:
        return self._file("data_path", "data", "")

    def film(self, key: str) -> tuple[Path, float]:
        """The film of a key, and the second of it at which the episode begins."""
        file = self._file("video_path", f"videos/{key}", key)
        return file, 0.0 if self.old else float(self.row[f"videos/{key}/from_timestamp"])

    def _file(self, template: str, head: str, key: str) -> Path:
        if self.old:
            chunk, file = self.number // int(self.info.get("chunks_size", 1000)), self.number
        else:
            chunk, file = self.row[f"{head}/chunk_index"], self.row[f"{head}/file_index"]
        values = {"chunk_index": chunk, "file_index": file, "episode_chunk": chunk, "episode_index": file}
        return self.source / self.info[template].format(video_key=key, **values)


def _table(file: Path, columns: Sequence[str] | None = None) -> Any:
    parquet = needed("pyarrow.parquet", EXTRA)
    with reading(file, AGAIN), file.open("rb") as raw:
        return parquet.ParquetFile(raw).read(columns=columns, use_threads=False)


def _numbers(column: Any, shape: Sequence[int]) -> NDArray[Any]:
    """A column of a table, (T, *shape)."""
    return np.array(column.to_pylist()).reshape(len(column), *shape)


def _film(places: _Places, key: str, times: NDArray[Any], rows: Rows) -> Iterable[NDArray[np.uint8]]:
    file, begin = places.film(key)
    return frames_near(file, (begin + times.reshape(-1)[rows]).tolist(), 0.5 / float(places.info["fps"]))


def _cells(file: Path, table: Any, key: str, rows: Rows) -> Iterator[NDArray[np.uint8]]:
    """The pictures in cells of a table, ``{bytes, path}``."""
    for number, cell in zip(rows.tolist(), table[key].take(rows).to_pylist(), strict=True):
        if not cell or not cell["bytes"]:
            raise UserError(
                f"the table has no picture for {key}, frame {number}", file, "Write pictures into the tables."
            )
        yield picture_of(cell["bytes"], file)
