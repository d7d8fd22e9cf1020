"""Frames of mp4 files: decoded once, one after another, by PyAV (``hypogoal[lerobot]``)."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hypogoal.core.errors import UserError
from hypogoal.core.files import open_file
from hypogoal.domains.observations import shrunk_sides
from hypogoal.observations import PICTURE, Observations
from hypogoal.own_data.arrays import DAMAGED
from hypogoal.own_data.images import MOST_PIXELS
from hypogoal.own_data.parts import Resize, resize_of
from hypogoal.own_data.recordings import Recording, chosen_keys, kept

DO = "Record or download it again."
KEY, SUFFIX = "video", ".mp4"


def needed(module: str) -> Any:
    """A module of the extra ``hypogoal[lerobot]``; a ``UserError`` where it is not installed."""
    try:
        return import_module(module)
    except ImportError:
        do = "pip install 'hypogoal[lerobot]'"
        raise UserError(f"this needs {module.partition('.')[0]}, which is not installed", None, do) from None


@contextmanager
def _opened(path: Path) -> Iterator[tuple[Any, Any]]:
    """An mp4 file and its first video stream; whatever is damaged is a ``UserError``."""
    av = needed("av")
    with open_file(path, "the video is", DO) as raw:  # not the path: a format could name other files
        try:
            with av.open(raw, format="mp4") as container:
                stream = container.streams.video[0]
                if stream.width * stream.height > MOST_PIXELS:
                    raise UserError(f"the video has {stream.width} x {stream.height} pixels, too many", path, DO)
                yield container, stream
        except (av.FFmpegError, *DAMAGED, IndexError, AttributeError):
            raise UserError("this is no mp4 file, or it is damaged", path, DO) from None


def read_frames(
    path: Path, times: Sequence[float], tolerance: float, keep: Callable[[int, NDArray[np.uint8]], None]
) -> None:
    """Call ``keep`` with the frame, uint8 (H, W, 3), of each of some rising ``times`` in seconds, by its number.

    A time without a frame within ``tolerance`` is a ``UserError``.
    """
    done = 0
    with _opened(path) as (container, stream):
        for frame in container.decode(stream):
            if done == len(times) or (frame.time is not None and frame.time > times[done] + tolerance):
                break
            if frame.time is not None and frame.time >= times[done] - tolerance:
                keep(done, frame.to_ndarray(format="rgb24"))
                done += 1
    if done < len(times):
        fault = f"the video has no frame at {times[done]:.3f} s: its frames do not match the table"
        raise UserError(fault, path, DO)


class Videos(Recording):
    """A folder of mp4 files, an episode each, named by the file."""

    def __init__(self, path: Path, keys: Sequence[str] = (), resize: Resize = 0):
        self.path = path
        chosen_keys(keys, [KEY], path)
        self._files = sorted(path.glob(f"[!.]*{SUFFIX}"))
        self.names = [file.stem for file in self._files]
        self._times: list[list[float]] = []
        for file in self._files:
            with _opened(file) as (container, stream):
                shown = [part for part in container.demux(stream) if part.pts is not None and not part.is_discard]
                if not shown:
                    raise UserError("the video has no frames", file, DO)
                self._times.append(sorted(float(packet.pts * packet.time_base) for packet in shown))
                size = stream.height, stream.width
        self.lengths = [len(times) for times in self._times]
        self.fields = {KEY: (PICTURE, (*shrunk_sides(size, resize_of(resize, KEY, picture=True)), 3))}

    def fill(self, states: Mapping[int, Observations], every: int) -> None:
        for episode, rows in states.items():
            file, times = self._files[episode], self._times[episode]

            def keep(row: int, picture: NDArray[np.uint8], rows: Observations = rows, file: Path = file) -> None:
                self.store(rows, row, KEY, picture, file)

            read_frames(file, [times[frame] for frame in kept(len(times), every)], 1e-6, keep)
