"""Frames of films, by PyAV (``hypogoal[lerobot]``): of the first moving stream, turned as players turn it."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from hypogoal.core.errors import UserError
from hypogoal.data import Integers
from hypogoal.importing.episodes import AGAIN
from hypogoal.importing.files import needed, reading
from hypogoal.importing.parts import Array

EXTRA = "lerobot"  # that brings PyAV
SUFFIXES = (".mp4", ".m4v", ".mov", ".mkv", ".webm", ".avi")


@contextmanager
def _opened(path: Path) -> Iterator[tuple[Any, Any]]:
    """A film and its first moving stream; pictures of a cover do not move."""
    av = needed("av", EXTRA)
    with reading(path, AGAIN), path.open("rb") as file, av.open(file) as container:  # not the path: it may be a pattern
        cover = av.stream.Disposition.attached_pic
        streams = [stream for stream in container.streams.video if not stream.disposition & cover]
        if not streams:
            raise UserError("the film has no moving pictures", path, AGAIN)
        yield container, streams[0]


def count_frames(path: Path) -> int:
    """How many frames a film shows, from its index: nothing is decoded."""
    with _opened(path) as (container, stream):
        return sum(packet.size > 0 and not packet.is_discard for packet in container.demux(stream))


def frames_at(path: Path, rows: Integers) -> Iterator[Array]:
    """The frames with some rising numbers, uint8 (H, W, 3)."""
    wanted = set(rows.tolist())
    number = -1
    with _opened(path) as (container, stream):
        for number, frame in enumerate(container.decode(stream)):
            if number in wanted:
                yield _upright(frame, path)
    if number < max(wanted):
        raise UserError(f"the film ends after {number + 1} frames, its index has more", path, AGAIN)


def frames_near(path: Path, times: Sequence[float], tolerance: float) -> Iterator[Array]:
    """The frames, uint8 (H, W, 3), at some rising times in seconds; one that is missing is a ``UserError``."""
    done = 0
    with _opened(path) as (container, stream):
        container.seek(int(max(0, times[0] - tolerance) / stream.time_base), stream=stream)  # to the key frame before
        for frame in container.decode(stream):
            if done == len(times) or frame.time > times[done] + tolerance:
                break
            if frame.time >= times[done] - tolerance:
                yield _upright(frame, path)
                done += 1
    if done < len(times):
        fault = f"the film has no frame at {times[done]:.3f} s: its frames do not match the table"
        raise UserError(fault, path, AGAIN)


def _upright(frame: Any, path: Path) -> Array:
    """A frame as a player shows it, uint8 (H, W, 3)."""
    [*components] = frame.format.components
    if len(components) == 1 and components[0].bits > 8:
        fault = f"the film is grey, of {components[0].bits} bits, of which 8 would be left"
        raise UserError(fault, path, "Leave it out.")
    picture = frame.to_ndarray(format="rgb24")
    for data in frame.side_data:
        if data.type.name == "DISPLAYMATRIX":
            picture = _turned(picture, np.frombuffer(bytes(data), np.int32).reshape(3, 3), path)
    return picture


def _turned(picture: Array, matrix: Array, path: Path) -> Array:
    """A picture by the display matrix: a row of it says where going one column to the right, or one row down, leads."""
    right, down = matrix[:2, :2]
    if right[1] or down[0]:
        picture, right, down = picture.swapaxes(0, 1), down, right
    if right[1] or down[0]:
        raise UserError("the film is turned by no right angle", path, "Turn it, or leave it out.")
    return picture[:: -1 if down[1] < 0 else 1, :: -1 if right[0] < 0 else 1]
