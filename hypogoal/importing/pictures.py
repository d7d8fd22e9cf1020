"""Pictures: from a file's bytes to a picture, and folders of them.

A folder has ``positive/``, ``negative/``, ``unlabelled/`` and, for evaluation, ``heldout/positive/`` and
``heldout/negative/``. The folders within these are groups: of ``positive/monday/`` and ``negative/monday/`` all
pictures are held out, or none.
"""

import io
import warnings
from collections import Counter
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np
import PIL.Image
import PIL.ImageOps

from hypogoal.core.files import reading
from hypogoal.data import Integers
from hypogoal.importing.episodes import HELDOUT, LABELLED, UNLABELLED, Array, Episode, files_of

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
SCALE = "Scale the values to 0..255 and write it with 8 bits, on a background."


def picture_of(data: bytes, where: Path) -> Array:
    """The picture in a file of any of ``FORMATS``, uint8 (H, W, 3), or (H, W, 1) if it is grey; ``where`` it is from.

    It is turned as viewers turn it; of several pictures in one file it is the first; of 16 bits a channel the upper 8
    are taken. A ``UserError``: transparent pixels, 16 bits whose upper ones are unused, 32 bits, no picture.
    """
    quiet = warnings.catch_warnings(action="ignore")
    with reading(where, SCALE), quiet, PIL.Image.open(io.BytesIO(data), formats=FORMATS) as opened:
        deep = any(";16" in str(tile.args) for tile in opened.tile)  # Pillow's mode says 8 bits of most such files
        opened.load()  # in a PNG the orientation may follow the pixels
        image = PIL.ImageOps.exif_transpose(opened)
        alpha = image.convert("RGBA").getchannel("A")
        is_clear = np.asarray(alpha) < 255
        if image.has_transparency_data and is_clear.any():
            raise ValueError("it is transparent in places")
        if image.mode in ("I", "F"):
            raise ValueError("it has 32 bits a channel")
        if image.mode.startswith("I;16"):
            values = (np.asarray(image) >> 8).astype(np.uint8)
        else:
            kind = "L" if image.mode in ("1", "L") else "RGB"
            values = np.asarray(image.convert(kind))
        if deep and 0 < values.max() < 128:
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


def _state(file: Path, _: Integers) -> list[Array]:
    """The picture in a file."""
    data = file.read_bytes()
    return [picture_of(data, file)]
