"""LeRobotDataset, formats v2.1 and v3.0: tables in parquet, frames in mp4 or in the tables, facts in ``meta/``.

In v2.1 each episode has files of its own, in v3.0 many episodes share files, and ``meta/episodes/`` says where in a
video an episode begins. The package lerobot is not needed, pyarrow and PyAV are (``hypogoal[lerobot]``).
"""

from __future__ import annotations

import io
import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from hypogoal.core.errors import UserError
from hypogoal.core.files import inside, json_lines, open_file, read_json, read_text
from hypogoal.domains.observations import shrunk_sides
from hypogoal.observations import MAX_SIDE, NUMBERS, PICTURE, Observations
from hypogoal.own_data.arrays import DAMAGED
from hypogoal.own_data.images import FORMATS, MOST_PIXELS
from hypogoal.own_data.parts import Resize, resize_of
from hypogoal.own_data.recordings import Recording, chosen_keys, kept
from hypogoal.own_data.videos import needed, read_frames

INFO, EPISODES = Path("meta") / "info.json", Path("meta") / "episodes"
DO, AGAIN = "Give the folder of a LeRobotDataset in format v2.1 or v3.0.", "Download it again."
PICTURES = VIDEO, IMAGE = ("video", "image")  # types of features
PLACE = re.compile(r"\{(\w+)(?::0(\d)d)?\}")  # in a template of paths; other formats could ask for more than values
OWNER, TIME = "episode_index", "timestamp"  # columns of every table
Frames: TypeAlias = Mapping[int, NDArray[np.int64]]  # by episode


class Episode(NamedTuple):
    """What ``meta/`` says: its table, under "", and its videos by key; where in a video it begins."""

    number: int
    length: int
    files: dict[str, str]
    begins: dict[str, float]  # seconds, by video key


class LeRobot(Recording):
    """The episodes of a dataset; ``keys`` are features, all ``observation.*`` if none."""

    def __init__(self, path: Path, keys: Sequence[str] = (), resize: Resize = 0):
        self.path = path
        info = read_json(path / INFO, "the dataset's facts are", DO)
        try:
            self._old = {"v2": True, "v3": False}[info["codebase_version"][:2]]
            self._fps, self._chunk = float(info["fps"]), int(info.get("chunks_size", 1000))
            self._templates = str(info["data_path"]), str(info.get("video_path"))
            self._kinds = {key: str(feature["dtype"]) for key, feature in info["features"].items()}
            shapes = {key: tuple(map(int, feature["shape"])) for key, feature in info["features"].items()}
            sides = [side for shape in shapes.values() for side in shape]
            if not (self._fps > 0 and self._chunk > 0 and all(0 < side < MAX_SIDE for side in sides)):
                raise ValueError(info)
        except (KeyError, TypeError, ValueError, AttributeError):
            raise UserError("these are not the facts of a LeRobotDataset that is read", path / INFO, DO) from None
        self.fields = {}
        for key in chosen_keys(keys, [key for key in shapes if key.startswith("observation")], path):
            kind, shape = self._kinds[key], shapes[key]
            if kind in PICTURES and len(shape) == 3:
                size = shape[1:] if shape[0] == 3 != shape[2] else shape
                self.fields[key] = (PICTURE, (*shrunk_sides(size, resize_of(resize, key, picture=True)), 3))
            elif re.fullmatch(r"float\d+|u?int\d+|bool", kind):
                self.fields[key] = (NUMBERS, shape or (1,))
            else:
                fault = f"{key} is {kind} {shape}, neither pictures nor numbers"
                raise UserError(fault, path / INFO, "Choose others by --key.")
        self.columns = [key for key, kind in self._kinds.items() if kind not in PICTURES and shapes[key] == (1,)]
        self._episodes = self._read_episodes([key for key in self.fields if self._kinds[key] == VIDEO])
        self.names = [str(episode.number) for episode in self._episodes]
        self.lengths = [episode.length for episode in self._episodes]
        self._last: tuple[Path, dict[str, NDArray[Any]]] | None = None  # the table read last

    def _read_episodes(self, videos: Sequence[str]) -> list[Episode]:
        """What ``meta/`` says of each episode."""
        if self._old:
            lines = read_text(self.path / EPISODES.with_suffix(".jsonl"), "the list of episodes is", DO)
            rows = list(json_lines(lines.split("\n")))
        else:
            lists = sorted((self.path / EPISODES).glob("*/*.parquet"))
            rows = [row for file in lists for row in _table(file).to_pylist()]
        episodes = {}
        try:
            for row in rows:
                number, length = int(row[OWNER]), int(row["length"])
                begins = {key: 0.0 if self._old else float(row[f"videos/{key}/from_timestamp"]) for key in videos}
                if number < 0 or number in episodes or length < 1 or not all(map(math.isfinite, begins.values())):
                    raise ValueError(row)
                files = {}
                for key, head in [("", "data"), *((key, f"videos/{key}") for key in videos)]:
                    old = number // self._chunk, number
                    chunk, file = old if self._old else (int(row[f"{head}/{part}_index"]) for part in ("chunk", "file"))
                    values = {"video_key": key, "chunk_index": chunk, "file_index": file}
                    values |= {"episode_chunk": chunk, "episode_index": file}  # the names of v2.1
                    files[key] = _filled(self._templates[bool(key)], values)
                episodes[number] = Episode(number, length, files, begins)
        except (KeyError, TypeError, ValueError, OverflowError):
            raise UserError("the list of episodes is malformed", self.path / EPISODES, DO) from None
        if not episodes:
            raise UserError("the list of episodes is empty", self.path / EPISODES, DO)
        return list(episodes.values())

    def _file(self, episode: int, key: str = "") -> Path:
        """The table of an episode, or its video."""
        file = inside(self.path, self._episodes[episode].files[key])
        if file is None or not file.is_file():
            fault = f"episode {self.names[episode]} has no {VIDEO if key else 'table'}"
            raise UserError(fault, file or self.path, "Download it whole.")
        return file

    def column(self, episode: int, name: str) -> NDArray[Any]:
        file = self._file(episode)
        if self._last is None or self._last[0] != file:
            plain = [key for key in self.fields if self._kinds[key] not in PICTURES]
            table = _table(file, sorted({OWNER, TIME, *self.columns, *plain}))
            try:
                self._last = file, {key: np.array(table[key].to_pylist()) for key in table.column_names}
            except ValueError:
                raise UserError("a column of the table has rows of different lengths", file, AGAIN) from None
        columns = self._last[1]
        if columns[name].dtype.kind not in "biuf":
            raise UserError(f"the column {name!r} is not numbers", file, "Choose another.")
        return columns[name][self._rows(episode, columns[OWNER], file)]

    def _rows(self, episode: int, owners: NDArray[Any], file: Path) -> NDArray[np.int64]:
        """Where in a table an episode's frames are."""
        rows = np.flatnonzero(owners == self._episodes[episode].number)
        if len(rows) != self.lengths[episode]:
            fault = f"episode {self.names[episode]} has {len(rows)} frames, {self.lengths[episode]} are listed"
            raise UserError(fault, file, AGAIN)
        return rows

    def fill(self, states: Mapping[int, Observations], every: int) -> None:
        frames = {episode: kept(self.lengths[episode], every) for episode in sorted(states)}
        for key, (_, shape) in self.fields.items():
            kind, by_file = self._kinds[key], dict[Path, list[int]]()
            for episode in frames:
                by_file.setdefault(self._file(episode, key if kind == VIDEO else ""), []).append(episode)
            for file, episodes in by_file.items():
                some = {episode: frames[episode] for episode in episodes}
                if kind in PICTURES:
                    (self._read_video if kind == VIDEO else self._read_images)(file, key, some, states)
                    continue
                for episode, numbers in some.items():
                    values = self.column(episode, key)[numbers]
                    if values[0].size != math.prod(shape):
                        raise UserError(f"{key} has the shape {values.shape[1:]}, not {shape}", file, AGAIN)
                    states[episode][key] = values.reshape(-1, *shape)

    def _read_images(self, file: Path, key: str, frames: Frames, states: Mapping[int, Observations]) -> None:
        table = _table(file, [OWNER, key])
        owners = np.array(table[OWNER].to_pylist())
        for episode, numbers in frames.items():
            for row, at in enumerate(self._rows(episode, owners, file)[numbers].tolist()):
                self.store(states[episode], row, key, _decoded(table[key][at].as_py(), file), file)

    def _read_video(self, file: Path, key: str, frames: Frames, states: Mapping[int, Observations]) -> None:
        begins = {episode: self._episodes[episode].begins[key] for episode in frames}
        order = sorted(frames, key=begins.__getitem__)
        times = [begins[episode] + self.column(episode, TIME)[frames[episode]] for episode in order]
        places = [(episode, row) for episode in order for row in range(len(frames[episode]))]

        def keep(number: int, picture: NDArray[np.uint8]) -> None:
            episode, row = places[number]
            self.store(states[episode], row, key, picture, file)

        read_frames(file, np.concatenate(times).tolist(), 0.5 / self._fps, keep)


def _filled(template: str, values: Mapping[str, object]) -> str:
    """A path by its template."""
    return PLACE.sub(lambda place: str(values[place[1]]).zfill(int(place[2] or 0)), template)


def _decoded(cell: Any, file: Path) -> NDArray[np.uint8]:
    """The picture, uint8 (H, W, 3), in a cell of a table."""
    import PIL.Image

    try:
        with PIL.Image.open(io.BytesIO(cell["bytes"]), formats=FORMATS) as image:
            if image.width * image.height > MOST_PIXELS:
                raise ValueError("too large")
            return np.asarray(image.convert("RGB"))
    except (*DAMAGED, PIL.Image.DecompressionBombError):
        raise UserError("a picture in the table is damaged, or not in it", file, AGAIN) from None


def _table(file: Path, names: Sequence[str] | None = None) -> Any:
    """Columns of a parquet file; one that is truncated, larger than memory or lacks a column is a ``UserError``."""
    pyarrow, parquet = needed("pyarrow"), needed("pyarrow.parquet")
    with open_file(file, "the table is", AGAIN) as raw:
        try:
            opened = parquet.ParquetFile(raw)
            table = opened.read(columns=names, use_threads=False)
        except (pyarrow.ArrowException, *DAMAGED):
            raise UserError("the table is truncated or damaged", file, AGAIN) from None
    if missing := [name for name in names or () if name not in table.column_names]:
        raise UserError(f"the table has no column {missing[0]!r}", file, AGAIN)
    return table
