"""Pictures: from a file's bytes to a picture, folders of them, and frames of films.

A folder has ``positive/``, ``negative/``, ``unlabelled/`` and, for evaluation, ``heldout/positive/`` and
``heldout/negative/``. The folders within these are groups: of ``positive/monday/`` and ``negative/monday/`` all
pictures are held out, or none.

Films are read by PyAV (``hypogoal[lerobot]``): the first moving stream, turned as players turn it.
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

FORMATS = ("PNG", "JPEG", "BMP", "GIF", "WEBP", "TIFF", "PPM", "AVIF")  # for PostScript, Pillow runs a program
SUFFIXES = {".mpo"}  # that is JPEG
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
DEEP = re.compile("[^R];16|65535")  # in the arguments of Pillow's decoders, whose mode says 8 bits of most such files
SHOWN = "Write or download it again; 'ffmpeg -i FILM -crf 0 NEW.mkv' keeps what can be shown of a film."
SHORT = "hypogoal: {} ends earlier than it says, as if it was cut off: what is left is taken"
LACKING, MICROSECONDS = 0.5, 1_000_000  # what may be missing, in seconds
SCALE = "Write it as PNG of 8 bits, its values scaled to 0..255, on a background."


def picture_of(data: bytes, where: Path) -> Array:
    """The picture in a file of any of ``FORMATS``, uint8 (H, W, 3), or (H, W, 1) if it is grey; ``where`` it is from.

    It is turned as viewers turn it; of several pictures in one file it is the first; of 16 bits a channel the upper 8
    are taken. A ``UserError``: transparent pixels, 16 bits whose upper ones are unused, other depths, no picture.
    """
    quiet = warnings.catch_warnings(action="ignore")
    with reading(where, SCALE), quiet:
        try:
            opened = PIL.Image.open(io.BytesIO(data), formats=FORMATS)
        except PIL.UnidentifiedImageError:
            raise ValueError(f"it is none of {', '.join(FORMATS)}, or of a kind that Pillow does not read") from None
        is_deep = any(DEEP.search(str(tile.args)) for tile in opened.tile)
        if isinstance(opened, TiffImageFile):
            # Some of these Pillow reads otherwise: 12 bits, 0 as white, each colour for itself, signs.
            tags = opened.tag_v2
            bits = {*tags.get(BITSPERSAMPLE, (1,))}
            is_white = tags.get(PHOTOMETRIC_INTERPRETATION, 0) == 0
            is_apart = tags.get(PLANAR_CONFIGURATION) == 2 and (is_white or bits != {8})
            if is_apart or (is_white and 16 in bits) or 12 in bits or 2 in tags.get(SAMPLEFORMAT, ()):
                raise ValueError("it is a TIFF of 12 bits, with signs, with 0 as white in 16, or of planes")
        opened.load()  # in a PNG the orientation may follow the pixels
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
    """The pictures of one sub-goal, in the order of their names, an episode each."""
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
    """The picture in a file."""
    data = file.read_bytes()
    return [picture_of(data, file)]


@contextmanager
def _opened(path: Path) -> Iterator[tuple[Any, Any]]:
    """A film and its first moving stream; pictures of a cover do not move."""
    with reading(path, SHOWN):
        import av

        cover = av.stream.Disposition.attached_pic
        with path.open("rb") as file, av.open(file) as container:  # not the path: it may be a pattern
            streams = [stream for stream in container.streams.video if not stream.disposition & cover]
            if not streams:
                raise ValueError("no moving pictures")
            yield container, streams[0]


def count_frames(path: Path) -> int:
    """How many frames a film shows, from its index: nothing is decoded. It is told if the film was to go on."""
    shown = listed = 0
    end = 0.0
    with _opened(path) as (container, stream):
        for packet in container.demux():
            if packet.dts is None and not packet.size:  # behind the last
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
    """The frames with some rising numbers, uint8 (H, W, 3); one that is missing is a ``UserError``.

    With a ``rate`` in frames a second, a frame's number is its time from ``begin`` on, in seconds, times the rate.
    """
    wanted = set(rows.tolist())
    missing = wanted.copy()
    with _opened(path) as (container, stream):
        if rate:
            first = begin + rows[0] / rate
            container.seek(int(first / stream.time_base), stream=stream)  # to the key frame before
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
    """A frame as a player shows it, uint8 (H, W, 3)."""
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
    """A picture by the display matrix: where one column to the right leads, then one row down, as x, y, 0 each."""
    right_x, right_y, _, down_x, down_y = np.sign(matrix[:5])
    if right_x:
        return picture[::down_y, ::right_x]
    return picture.swapaxes(0, 1)[::right_y, ::down_x]
