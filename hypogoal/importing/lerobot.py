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
import pandas as pd

from hypogoal.core.files import reading
from hypogoal.data import Integers
from hypogoal.importing.episodes import Array, Episode
from hypogoal.importing.films import frames_in
from hypogoal.importing.pictures import picture_of

INFO, EPISODES = Path("meta") / "info.json", Path("meta") / "episodes"
OWNER = "episode_index"  # a column of every table


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
