"""LeRobotDataset, formats v2.1 and v3.0: tables in parquet, frames in films or in the tables, facts in ``meta/``.

In v2.1 each episode has files of its own, in v3.0 many episodes share files, and ``meta/episodes/`` says where in a
film an episode begins. The package lerobot is not needed, pyarrow and PyAV are (``hypogoal[lerobot]``).
"""

import json
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from hypogoal.core.errors import UserError
from hypogoal.data import Integers
from hypogoal.importing.episodes import AGAIN, Recording
from hypogoal.importing.files import needed, reading
from hypogoal.importing.films import EXTRA, frames_near
from hypogoal.importing.parts import Array
from hypogoal.importing.pictures import picture_of

INFO, EPISODES = Path("meta") / "info.json", Path("meta") / "episodes"
DO = "Give the folder of a whole LeRobotDataset in format v2.1 or v3.0."
OWNER, TIME = "episode_index", "timestamp"  # columns of every table
VIDEO, IMAGE = "video", "image"  # types of features
NUMBERS = ("float", "int", "uint", "bool")  # how the types of all others begin that are read


def read_lerobot(source: Path, keys: Sequence[str], left: Counter[str]) -> Iterator[Recording]:
    """The episodes of a dataset, with ``keys`` of its features, all ``observation*`` if none are given."""
    with reading(source / INFO, DO):
        info = json.loads((source / INFO).read_text(encoding="utf-8-sig"))
        kinds = {key: str(feature["dtype"]) for key, feature in info["features"].items()}
        version = info["codebase_version"]
        if version[:2] not in ("v2", "v3"):
            raise UserError(f"the format {version} is not read", source, DO)
    seen = [key for key in kinds if key in keys or key.startswith("observation")]
    numbers = [key for key, kind in kinds.items() if kind.startswith(NUMBERS)]
    pictures = [key for key in keys or seen if kinds.get(key) == IMAGE]
    table_of = lru_cache(maxsize=1)(partial(_table, columns=[*numbers, *pictures]))  # episodes of one come together
    for row in _listed(source, version):
        with reading(source, DO):
            places = _Places(source, info, row)
            file = places.file("data_path", "data", "")
            table = table_of(file)
            frames = table.filter(np.array(table[OWNER]) == row[OWNER])
            if len(frames) != row["length"]:
                fault = f"episode {row[OWNER]} has {len(frames)} frames, {row['length']} are listed"
                raise UserError(fault, file, AGAIN)
            values = {}
            for key in numbers:
                values[key] = np.array(frames[key].to_pylist()).reshape(len(frames), *info["features"][key]["shape"])
            read: dict[str, Any] = {key: values[key].__getitem__ for key in seen if key in values}
            for key in seen:
                if kinds[key] == VIDEO:
                    read[key] = partial(places.film, key, values[TIME].ravel())
                if kinds[key] == IMAGE:
                    read[key] = partial(_cells, file, frames, key)
            texts = [key for key in seen if key not in read]
            yield Recording(str(row[OWNER]), len(frames), read, values, texts)


def _listed(source: Path, version: str) -> list[dict[str, Any]]:
    """What ``meta/`` says of each episode."""
    file = source / EPISODES.with_suffix(".jsonl")
    rows: list[dict[str, Any]] = []
    if version.startswith("v2"):
        with reading(file, DO):
            lines = file.read_text(encoding="utf-8-sig").splitlines()
            rows += map(json.loads, filter(str.strip, lines))
    for table in sorted((source / EPISODES).glob("*/*.parquet")):
        rows += _table(table).to_pylist()
    if not rows:
        raise UserError("the list of episodes is empty", source / EPISODES, DO)
    return rows


@dataclass(frozen=True)
class _Places:
    """Where the parts of an episode lie: its ``row`` of the list says so in v3.0, its number in v2.1."""

    source: Path
    info: Mapping[str, Any]
    row: Mapping[str, Any]

    def file(self, template: str, head: str, key: str) -> Path:
        number = self.row[OWNER]
        chunk = self.row.get(f"{head}/chunk_index", number // self.info.get("chunks_size", 1000))
        file = self.row.get(f"{head}/file_index", number)
        values = {"chunk_index": chunk, "file_index": file, "episode_chunk": chunk, "episode_index": file}
        return self.source / self.info[template].format(video_key=key, **values)

    def film(self, key: str, times: Array, rows: Integers) -> Iterable[Array]:
        """Frames of a film, in which the episode begins at some second."""
        begin = self.row.get(f"videos/{key}/from_timestamp", 0.0)
        file = self.file("video_path", f"videos/{key}", key)
        return frames_near(file, (begin + times[rows]).tolist(), 0.5 / self.info["fps"])


def _table(file: Path, columns: Sequence[str] | None = None) -> Any:
    parquet = needed("pyarrow.parquet", EXTRA)
    with reading(file, AGAIN), file.open("rb") as raw:
        return parquet.ParquetFile(raw).read(columns=columns, use_threads=False)


def _cells(file: Path, table: Any, key: str, rows: Integers) -> Iterator[Array]:
    """The pictures in cells of a table, ``{bytes, path}``."""
    for cell in table[key].take(rows).to_pylist():
        if not cell or not cell["bytes"]:
            raise UserError(f"the table has no picture for each frame of {key}", file, "Write them into the tables.")
        yield picture_of(cell["bytes"], file)
