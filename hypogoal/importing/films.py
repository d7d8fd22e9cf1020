"""Frames of films, by PyAV (``hypogoal[lerobot]``): of the first moving stream, turned as players turn it."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from hypogoal.core.errors import UserError
from hypogoal.core.files import AGAIN, reading
from hypogoal.data import Integers
from hypogoal.importing.episodes import Array
from hypogoal.importing.pictures import SCALE

SUFFIXES = (".mp4", ".m4v", ".mov", ".mkv", ".webm", ".avi")


@contextmanager
def _opened(path: Path) -> Iterator[tuple[Any, Any]]:
    """A film and its first moving stream; pictures of a cover do not move."""
    with reading(path):
        import av

        cover = av.stream.Disposition.attached_pic
        with path.open("rb") as file, av.open(file) as container:  # not the path: it may be a pattern
            streams = [stream for stream in container.streams.video if not stream.disposition & cover]
            if not streams:
                raise ValueError("no moving pictures")
            yield container, streams[0]


def count_frames(path: Path) -> int:
    """How many frames a film shows, from its index: nothing is decoded."""
    with _opened(path) as (container, stream):
        return sum(packet.size > 0 and not packet.is_discard for packet in container.demux(stream))


def frames_in(
    path: Path,
    rows: Integers,
    rate: float = 0.0,
    begin: float = 0.0,
) -> Iterator[Array]:
    """The frames with some rising numbers, uint8 (H, W, 3); one that is missing is a ``UserError``.

    With a ``rate`` in frames a second, a frame's number is its time from ``begin`` on, in seconds, times the rate.
    """
    missing = set(rows.tolist())
    with _opened(path) as (container, stream):
        if rate:
            first = begin + rows[0] / rate
            container.seek(int(first / stream.time_base), stream=stream)  # to the key frame before
        for count, frame in enumerate(container.decode(stream)):
            number = round((frame.time - begin) * rate) if rate else count
            if number in missing:
                missing.remove(number)
                yield _upright(frame, path)
            if not missing:
                return
    fault = f"the film lacks {len(missing)} of {len(rows)} frames that are listed"
    raise UserError(fault, path, AGAIN)


def _upright(frame: Any, path: Path) -> Array:
    """A frame as a player shows it, uint8 (H, W, 3)."""
    first, *others = frame.format.components
    if first.bits > 8 and not others:
        fault = f"the film is grey, of {first.bits} bits, of which 8 would be left"
        raise UserError(fault, path, SCALE)
    picture = frame.to_ndarray(format="rgb24")
    for data in frame.side_data:
        if data.type.name == "DISPLAYMATRIX":
            picture = _turned(picture, np.frombuffer(data, np.int32))
    return picture


def _turned(picture: Array, matrix: Array) -> Array:
    """A picture by the display matrix: where one column to the right leads, then one row down, as x, y, 0 each."""
    right_x, right_y, _, down_x, down_y = np.sign(matrix[:5])
    if right_x:
        return picture[::down_y, ::right_x]
    return picture.swapaxes(0, 1)[::right_y, ::down_x]
