"""Readers of pictures, from files, folders and films.

A folder has ``positive/``, ``negative/``, ``unlabelled/`` and, for evaluation, ``heldout/positive/`` and
``heldout/negative/``. A folder within these folders is a group. For example, either all pictures in
``positive/monday/`` and ``negative/monday/`` are held out, or none of them.

PyAV (``hypogoal[lerobot]``) reads the first moving stream of a film, whose frames are turned as players turn them.
"""

import io
import re
import warnings
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import PIL.Image
import PIL.ImageOps
from PIL.TiffImagePlugin import (
    BITSPERSAMPLE,
    PHOTOMETRIC_INTERPRETATION,
    PLANAR_CONFIGURATION,
    SAMPLEFORMAT,
    TiffImageFile,
)

from hypogoal.core.arrays import Array, Ints
from hypogoal.core.errors import UserError
from hypogoal.core.files import reading
from hypogoal.core.progress import say
from hypogoal.importing.states import HELDOUT, LABELLED, UNLABELLED, Episode, files_of

FORMATS = ("PNG", "JPEG", "BMP", "GIF", "WEBP", "TIFF", "PPM", "AVIF")  # no PostScript: for it Pillow runs a program
SUFFIXES = {".mpo"}  # an MPO file begins with a JPEG
for suffix, name in PIL.Image.registered_extensions().items():
    if name in FORMATS:
        SUFFIXES.add(suffix)
POSITIVE = "positive"
PLACES = {
    POSITIVE: LABELLED,
    "negative": LABELLED,
    "unlabelled": UNLABELLED,
    "heldout/positive": HELDOUT,
    "heldout/negative": HELDOUT,
}
FILMS = (".mp4", ".m4v", ".mov", ".mkv", ".webm", ".avi")
# Tells 16 bits a channel by the arguments of Pillow's decoders, because Pillow's mode says 8 bits of most such files.
DEEP = re.compile("[^R];16|65535")
SHOWN = "Write or download it again; 'ffmpeg -i FILM -crf 0 NEW.mkv' keeps what can be shown of a film."
SHORT = "hypogoal: {} ends earlier than it says, as if it was cut off: what is left is taken"
LACKING, MICROSECONDS = 0.5, 1_000_000  # how much of a film may be missing, in seconds; microseconds of a second
SCALE = "Write it as PNG of 8 bits, its values scaled to 0..255, on a background."


def picture_of(data: bytes, where: Path) -> Array:
    """Return the picture in ``data``, the bytes of a file, uint8 (H, W, 3), or (H, W, 1) if it is grey.

    ``where`` is the file's path. The picture is turned as viewers turn it. If the file has several pictures, the first
    is taken. If a channel has 16 bits, the upper 8 are taken. Raises ``UserError`` if ``data`` are no picture of
    ``FORMATS``, if pixels are transparent, if a channel has 16 bits whose upper bits are unused, or another depth.
    """
    quiet = warnings.catch_warnings(action="ignore")
    with reading(where, SCALE), quiet:
        try:
            opened = PIL.Image.open(io.BytesIO(data), formats=FORMATS)
        except PIL.UnidentifiedImageError:
            raise ValueError(f"it is none of {', '.join(FORMATS)}, or of a kind that Pillow does not read") from None
        is_deep = any(DEEP.search(str(tile.args)) for tile in opened.tile)
        if isinstance(opened, TiffImageFile):
            # Pillow gives wrong pixels for some TIFFs with 12 bits, with 0 as white, with a plane per colour or with
            # signs.
            tags = opened.tag_v2
            bits = {*tags.get(BITSPERSAMPLE, (1,))}
            is_white = tags.get(PHOTOMETRIC_INTERPRETATION, 0) == 0
            is_apart = tags.get(PLANAR_CONFIGURATION) == 2 and (is_white or bits != {8})
            if is_apart or (is_white and 16 in bits) or 12 in bits or 2 in tags.get(SAMPLEFORMAT, ()):
                raise ValueError("it is a TIFF of 12 bits, with signs, with 0 as white in 16, or of planes")
        opened.load()  # because in a PNG the orientation may follow the pixels
        image = PIL.ImageOps.exif_transpose(opened)
        alpha = image.convert("RGBA").getchannel("A")
        is_clear = np.asarray(alpha) < 255
        if image.has_transparency_data and is_clear.any():
            raise ValueError("it is transparent in places")
        is_pgm = image.mode == "I" and opened.format == "PPM"
        if image.mode.startswith("I;16") or is_pgm:
            values = (np.asarray(image) >> 8).astype(np.uint8)
        elif image.mode in ("I", "F"):
            raise ValueError("it has 32 bits a channel")
        else:
            kind = "L" if image.mode in ("1", "L") else "RGB"
            values = np.asarray(image.convert(kind))
        if is_deep and values.max() < 128:
            raise ValueError("of its 16 bits a channel the upper ones are unused")
    return values.reshape(*values.shape[:2], -1)


def read_pictures(folder: Path, sub_goal: str, left: Counter[str]) -> Iterator[Episode]:
    """Read the pictures of one sub-goal, in the order of their names, each as an episode of its own."""
    for place, role in PLACES.items():
        label = np.array([place.endswith(POSITIVE)])
        for file in files_of(folder / place, SUFFIXES, left):
            name = file.relative_to(folder).as_posix()
            group = file.relative_to(folder / place).parent.as_posix()
            seen = {"": partial(_state, file)}
            yield Episode(
                name,
                1,
                seen,
                {sub_goal: label},
                role,
                group.removeprefix("."),
            )


def _state(file: Path, _: Ints) -> list[Array]:
    """Return the picture in a file, as a list."""
    data = file.read_bytes()
    return [picture_of(data, file)]


@contextmanager
def _opened(path: Path) -> Iterator[tuple[Any, Any]]:
    """Open a film and give it with its first moving stream. The picture of a cover is a stream that does not move."""
    with reading(path, SHOWN):
        import av

        cover = av.stream.Disposition.attached_pic
        with path.open("rb") as file, av.open(file) as container:  # PyAV would read some paths as patterns
            streams = [stream for stream in container.streams.video if not stream.disposition & cover]
            if not streams:
                raise ValueError("no moving pictures")
            yield container, streams[0]


def count_frames(path: Path) -> int:
    """Count the frames that a film shows, by its index, without decoding.

    The user is told if the film ends earlier than it says.
    """
    shown = listed = 0
    end = 0.0
    with _opened(path) as (container, stream):
        for packet in container.demux():
            if packet.dts is None and not packet.size:  # the empty packet after the last one
                continue
            end = max(end, packet.time_base * ((packet.pts or packet.dts or 0) + packet.duration))
            if packet.stream == stream:
                listed += 1
                shown += packet.size > 0 and not packet.is_discard
        length = (container.duration or 0) / MICROSECONDS
        if stream.frames > listed or length > end + LACKING:
            say(SHORT.format(path), err=True)
    return shown


def frames_in(
    path: Path,
    rows: Ints,
    rate: float = 0.0,
    begin: float = 0.0,
) -> Iterator[Array]:
    """Read the frames of a film with the numbers ``rows``, which rise, uint8 (H, W, 3) each.

    Without a ``rate`` frames are counted from 0. With a ``rate`` in frames a second, a frame's number is its time after
    ``begin``, in seconds, times the rate. Raises ``UserError`` if a frame is missing.
    """
    wanted = set(rows.tolist())
    missing = wanted.copy()
    with _opened(path) as (container, stream):
        if rate:
            first = begin + rows[0] / rate
            container.seek(int(first / stream.time_base), stream=stream)  # to the key frame before the first frame
        for count, frame in enumerate(container.decode(stream)):
            number = round((frame.time - begin) * rate) if rate else count
            if number in wanted and number not in missing:
                raise ValueError(f"two frames are number {number} by their times")
            if number in missing:
                missing.remove(number)
                yield _upright(frame, path)
            if not missing:
                return
    raise UserError(f"the film lacks {len(missing)} of {len(rows)} frames that are listed", path, SHOWN)


def _upright(frame: Any, path: Path) -> Array:
    """Return a frame as a player shows it, uint8 (H, W, 3). Raises ``UserError`` if it cannot be shown so."""
    first, *others = frame.format.components
    if first.bits > 8 and not others:
        raise UserError(f"the film is grey, of {first.bits} bits, of which 8 would be left", path, SCALE)
    if frame.is_corrupt:
        raise UserError("the film is damaged", path, SHOWN)
    if others and others[-1].is_alpha and frame.to_ndarray(format="rgba")[..., 3].min() < 255:
        raise UserError("the film is transparent in places", path, SCALE)
    picture = frame.to_ndarray(format="rgb24")
    for data in frame.side_data:
        if data.type.name == "DISPLAYMATRIX":
            picture = _turned(picture, np.frombuffer(data, np.int32))
    return picture


def _turned(picture: Array, matrix: Array) -> Array:
    """Return a picture turned by a display matrix.

    The matrix says where one column to the right leads, then where one row down leads, each as x, y, 0.
    """
    right_x, right_y, _, down_x, down_y = np.sign(matrix[:5])
    if right_x:
        return picture[::down_y, ::right_x]
    return picture.swapaxes(0, 1)[::right_y, ::down_x]
