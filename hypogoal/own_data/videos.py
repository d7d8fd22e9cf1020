"""Frames of mp4 files: decoded once, one after another, by PyAV (``hypogoal[lerobot]``)."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hypogoal.core.errors import UserError
from hypogoal.core.files import open_file
from hypogoal.dataset import PICTURE
from hypogoal.domains.observations import shrunk_sides
from hypogoal.own_data.arrays import DAMAGED
from hypogoal.own_data.images import MOST_PIXELS
from hypogoal.own_data.parts import Resize, resize_of
from hypogoal.own_data.recordings import Frames, Recording, kept, store

DO = "Record or download it again."
KEY, SUFFIX = "video", ".mp4"


def needed(module: str) -> Any:
    """A module of the extra ``hypogoal[lerobot]``; a ``UserError`` where it is not installed."""
    from importlib import import_module

    try:
        return import_module(module)
    except ImportError:
        do = "pip install 'hypogoal[lerobot]'"
        raise UserError(f"this needs {module.partition('.')[0]}, which is not installed", None, do) from None


def _opened(path: Path, work: Callable[[Any, Any], Any]) -> Any:
    """What ``work`` makes of an open mp4 file and its first video stream; a damaged file is a ``UserError``."""
    av = needed("av")
    with open_file(path, "the video is", DO) as raw:  # not the path: a format could name other files
        try:
            with av.open(raw, format="mp4") as container:
                stream = container.streams.video[0]
                if stream.width * stream.height > MOST_PIXELS:
                    raise UserError(f"the video has {stream.width} x {stream.height} pixels, too many", path, DO)
                return work(container, stream)
        except (av.FFmpegError, *DAMAGED, IndexError, AttributeError):
            raise UserError("this is no mp4 file, or it is damaged", path, DO) from None


def read_frames(
    path: Path, times: Sequence[float] | int, tolerance: float, keep: Callable[[int, NDArray[np.uint8]], None]
) -> None:
    """Call ``keep`` with the frame, uint8 (H, W, 3), for each of some rising ``times`` in seconds, by its number.

    An integer instead: so many frames, one after another. A time without a frame within ``tolerance`` is a
    ``UserError``.
    """

    def work(container: Any, stream: Any) -> None:
        count = times if isinstance(times, int) else len(times)
        done = 0
        for frame in container.decode(stream):
            if done == count:
                return
            if not isinstance(times, int):
                if frame.time is None or frame.time < times[done] - tolerance:
                    continue
                if frame.time > times[done] + tolerance:
                    break
            picture = frame.to_ndarray(format="rgb24")
            keep(done, picture)
            done += 1
        if done < count:
            at = f"frame {done}" if isinstance(times, int) else f"{times[done]:.3f} s"
            raise UserError(f"the video has no frame at {at}: its frames do not match the table", path, DO)

    _opened(path, work)


class Videos(Recording):
    """A folder of mp4 files, an episode each, named by the file."""

    columns = ()

    def __init__(self, path: Path, resize: Resize = 0):
        self.path = path
        self._files = sorted(path.glob(f"[!.]*{SUFFIX}"))
        self.names = [file.stem for file in self._files]
        seen = [_opened(file, _extent) for file in self._files]
        self.lengths = [length for *_, length in seen]
        if empty := [str(file) for file, length in zip(self._files, self.lengths, strict=True) if not length]:
            raise UserError("a video has no frames", empty[0], DO)
        sides = shrunk_sides(seen[0], resize_of(resize, KEY, picture=True))
        self.fields = {KEY: (PICTURE, (*sides, 3))}

    def column(self, episode: int, name: str) -> NDArray[Any]:
        raise NotImplementedError(name)

    def fill(self, frames: Mapping[int, Frames], every: int) -> None:
        for episode, places in frames.items():
            file, length = self._files[episode], self.lengths[episode]
            rows = {frame: row for row, frame in enumerate(kept(length, every).tolist())}

            def keep(
                number: int, picture: NDArray[np.uint8], rows: Any = rows, to: Any = places, at: Any = file
            ) -> None:
                if number in rows:
                    store(to, KEY, rows[number], picture, at)

            read_frames(file, length, 0.0, keep)


def _extent(container: Any, stream: Any) -> tuple[int, int, int]:
    """Height, width and number of frames of a video, without decoding."""
    packets: Iterator[Any] = container.demux(stream)
    return stream.height, stream.width, sum(packet.size > 0 for packet in packets)
