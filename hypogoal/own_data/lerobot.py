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
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hypogoal.core.errors import UserError
from hypogoal.core.files import inside, json_lines, open_file, read_json, read_text
from hypogoal.dataset import MAX_SIDE, NUMBERS, PICTURE
from hypogoal.domains.observations import shrunk_sides
from hypogoal.own_data.arrays import DAMAGED
from hypogoal.own_data.images import FORMATS, MOST_PIXELS
from hypogoal.own_data.parts import Resize, require_memory, resize_of
from hypogoal.own_data.recordings import Frames, Recording, chosen_keys, kept, store
from hypogoal.own_data.videos import needed, read_frames

INFO, EPISODES = Path("meta") / "info.json", Path("meta") / "episodes"
DO, AGAIN = "Give the folder of a LeRobotDataset in format v2.1 or v3.0.", "Download it again."
PICTURES = VIDEO, IMAGE = ("video", "image")  # types of features
PLACE = re.compile(r"\{(\w+)(?::0(\d)d)?\}")  # in a template of paths
ALWAYS = ("episode_index", "timestamp")  # columns of every table


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
            features, self._old = dict(info["features"]), {"v2": True, "v3": False}[info["codebase_version"][:2]]
            self._fps, self._chunk = float(info["fps"]), int(info.get("chunks_size", 1000))
            self._templates = str(info["data_path"]), str(info.get("video_path"))
            self._kinds = {key: str(feature["dtype"]) for key, feature in features.items()}
            shapes = {key: tuple(map(int, feature["shape"])) for key, feature in features.items()}
            if not (
                self._fps > 0 and self._chunk > 0 and all(0 < side < MAX_SIDE for of in shapes.values() for side in of)
            ):
                raise ValueError(shapes)
        except (KeyError, TypeError, ValueError, AttributeError):
            raise UserError("these are not the facts of a LeRobotDataset that is read", path / INFO, DO) from None
        chosen = chosen_keys(keys, [key for key in features if key.startswith("observation")], path)
        self.fields = {}
        for key in chosen:
            kind, shape = self._kinds[key], shapes[key]
            if kind in PICTURES and len(shape) == 3:
                size = shape[1:] if shape[0] == 3 != shape[2] else shape
                sides = shrunk_sides(size, resize_of(resize, key, picture=True))
                self.fields[key] = (PICTURE, (*sides, 3))
            elif re.fullmatch(r"float\d+|u?int\d+|bool", kind):
                self.fields[key] = (NUMBERS, shape or (1,))
            else:
                fault = f"{key} is {kind} {shape}, neither pictures nor numbers"
                raise UserError(fault, path / INFO, "Choose others by --key.")
        self.columns = [key for key, kind in self._kinds.items() if kind not in PICTURES and shapes[key] == (1,)]
        self._episodes = self._read_episodes([key for key in chosen if self._kinds[key] == VIDEO])
        self.names = [str(episode.number) for episode in self._episodes]
        self.lengths = [episode.length for episode in self._episodes]
        self._last: tuple[Path, dict[str, NDArray[Any]]] | None = None  # the table read last

    def _read_episodes(self, videos: Sequence[str]) -> list[Episode]:
        """What ``meta/`` says of each episode."""
        list_ = self.path / EPISODES.with_suffix(".jsonl")
        if self._old:
            rows = list(json_lines(read_text(list_, "the list of episodes is", DO).split("\n")))
        else:
            rows = [
                row for file in sorted((self.path / EPISODES).glob("*/*.parquet")) for row in _table(file).to_pylist()
            ]
        episodes = []
        try:
            for row in rows:
                number, length = int(row["episode_index"]), int(row["length"])
                begins = {key: 0.0 if self._old else float(row[f"videos/{key}/from_timestamp"]) for key in videos}
                files = {}
                for key in ("", *videos):
                    head = f"videos/{key}" if key else "data"
                    parts = ("chunk_index", "file_index")
                    place = {"episode_index": number, "episode_chunk": number // self._chunk}
                    place = place if self._old else {part: int(row[f"{head}/{part}"]) for part in parts}
                    files[key] = _filled(self._templates[bool(key)], {"video_key": key, **place})
                if number < 0 or length < 1 or not all(map(math.isfinite, begins.values())):
                    raise ValueError(row)
                episodes.append(Episode(number, length, files, begins))
        except (KeyError, TypeError, ValueError, OverflowError):
            raise UserError("the list of episodes is malformed", self.path / EPISODES, DO) from None
        if not episodes or len({episode.number for episode in episodes}) < len(episodes):
            raise UserError("the list of episodes is empty, or has one twice", self.path / EPISODES, DO)
        return episodes

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
            read = _columns(file, sorted({*ALWAYS, *self.columns, *plain}))
            try:
                self._last = file, {key: np.array(values.to_pylist()) for key, values in read.items()}
            except ValueError:
                raise UserError("a column of the table has rows of different lengths", file, AGAIN) from None
        columns = self._last[1]
        if columns[name].dtype.kind not in "biuf":
            raise UserError(f"the column {name!r} is not numbers", file, "Choose another.")
        return columns[name][self._rows(episode, columns["episode_index"], file)]

    def _rows(self, episode: int, owners: NDArray[Any], file: Path) -> NDArray[np.int64]:
        """Where in a table an episode's frames are."""
        rows = np.flatnonzero(owners == self._episodes[episode].number)
        if len(rows) != self.lengths[episode]:
            fault = f"episode {self.names[episode]} has {len(rows)} frames, {self.lengths[episode]} are listed"
            raise UserError(fault, file, AGAIN)
        return rows

    def fill(self, frames: Mapping[int, Frames], every: int) -> None:
        rows = {episode: kept(self.lengths[episode], every) for episode in sorted(frames)}
        for key, (_, shape) in self.fields.items():
            kind, by_file = self._kinds[key], dict[Path, list[int]]()
            for episode in rows:
                by_file.setdefault(self._file(episode, key if kind == VIDEO else ""), []).append(episode)
            for file, episodes in by_file.items():
                if kind in PICTURES:
                    read = self._read_video if kind == VIDEO else self._read_images
                    read(file, key, {episode: rows[episode] for episode in episodes}, frames)
                    continue
                for episode in episodes:
                    values = self.column(episode, key)[rows[episode]]
                    if values[0].size != math.prod(shape):
                        raise UserError(f"{key} has the shape {values.shape[1:]}, not {shape}", file, AGAIN)
                    frames[episode][key][:] = values.reshape(-1, *shape)

    def _read_video(
        self, file: Path, key: str, rows: Mapping[int, NDArray[np.int64]], frames: Mapping[int, Frames]
    ) -> None:
        order = sorted(rows, key=lambda episode: self._episodes[episode].begins[key])
        begins = [self._episodes[episode].begins[key] for episode in order]
        times = [begin + self.column(at, "timestamp")[rows[at]] for begin, at in zip(begins, order, strict=True)]
        places = [(episode, row) for episode in order for row in range(len(rows[episode]))]

        def keep(number: int, picture: NDArray[np.uint8]) -> None:
            episode, row = places[number]
            store(frames[episode], key, row, picture, file)

        read_frames(file, np.concatenate(times).tolist(), 0.5 / self._fps, keep)

    def _read_images(
        self, file: Path, key: str, rows: Mapping[int, NDArray[np.int64]], frames: Mapping[int, Frames]
    ) -> None:
        table = _columns(file, [*ALWAYS, key])
        owners = np.array(table["episode_index"].to_pylist())
        for episode, numbers in rows.items():
            for row, place in enumerate(self._rows(episode, owners, file)[numbers].tolist()):
                store(frames[episode], key, row, _decoded(table[key][place].as_py(), file), file)


def _filled(template: str, values: Mapping[str, object]) -> str:
    """A path by a template such as ``file-{file_index:03d}``; other formats could ask for more than values."""
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


def _columns(file: Path, names: Sequence[str]) -> dict[str, Any]:
    """Columns of a table; a missing one is a ``UserError``."""
    table = _table(file, names)
    if missing := [name for name in names if name not in table.column_names]:
        raise UserError(f"the table has no column {missing[0]!r}", file, AGAIN)
    return {name: table[name] for name in names}


def _table(file: Path, names: Sequence[str] | None = None) -> Any:
    """A parquet file's table; one that is truncated, damaged or larger than memory is a ``UserError``."""
    pyarrow, parquet = needed("pyarrow"), needed("pyarrow.parquet")
    with open_file(file, "the table is", AGAIN) as raw:
        try:
            opened = parquet.ParquetFile(raw)
            groups = [opened.metadata.row_group(group) for group in range(opened.metadata.num_row_groups)]
            require_memory(sum(group.total_byte_size for group in groups), file)
            return opened.read(columns=names and list(names), use_threads=False)
        except (pyarrow.ArrowException, *DAMAGED):
            raise UserError("the table is truncated or damaged", file, AGAIN) from None
