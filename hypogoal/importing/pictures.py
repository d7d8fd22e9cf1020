"""Pictures: from a file's bytes to a picture, and folders of them.

A folder has ``positive/``, ``negative/``, ``unlabelled/`` and, for evaluation, ``heldout/positive/`` and
``heldout/negative/``. The folders within these are groups: of ``positive/monday/`` and ``negative/monday/`` all
pictures are held out, or none.
"""

from __future__ import annotations

import contextlib
import io
import warnings
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from hypogoal.core.errors import UserError
from hypogoal.importing.files import files_of, reading
from hypogoal.importing.parts import Array, Given, Parts
from hypogoal.importing.taken import Taking, channels_of, stacked

if TYPE_CHECKING:
    from PIL.Image import Image

FORMATS = ("PNG", "JPEG", "BMP", "GIF", "WEBP", "TIFF", "PPM", "AVIF")  # for PostScript, Pillow runs a program
SUFFIXES = (
    ".png", ".apng", ".jpg", ".jpeg", ".jfif", ".jpe", ".mpo", ".bmp", ".gif", ".webp", ".tif", ".tiff", ".ppm", ".pgm",
    ".pbm", ".avif",
)  # fmt: skip
ARRAY = ".npy"  # a state that no format of pictures holds, such as a stack of four frames
GREY = ("1", "L")
COLOURED = ("P", "RGB", "RGBX", "CMYK", "YCbCr", "HSV")
TWO = ("positive", "negative")
DO = "Remove it, or write it again."
PLACES = "Put some into positive/, negative/ and unlabelled/, and to judge by into heldout/positive/ etc."


def picture_of(data: bytes, where: Path) -> Array:
    """The picture in a file of any of ``FORMATS``, uint8 (H, W, 3), or (H, W, 1) if it is grey; ``where`` it is from.

    It is turned as viewers turn it; of several pictures in one file it is the first; of 16 bits a channel the upper 8
    are taken. A ``UserError``: transparent pixels, 16 bits whose upper ones are unused, 32 bits, no picture.
    """
    import PIL.Image
    import PIL.ImageOps

    quiet = warnings.catch_warnings(action="ignore")
    with reading(where, DO), quiet, PIL.Image.open(io.BytesIO(data), formats=FORMATS) as opened:
        deep = any(";16" in str(tile.args) for tile in opened.tile)  # Pillow's mode says 8 bits of most such files
        opened.load()  # in a PNG the orientation may follow the pixels
        upright: Image = opened
        with contextlib.suppress(Exception):  # viewers ignore damaged EXIF
            upright = PIL.ImageOps.exif_transpose(opened)
        values = _bytes_of(upright, where)
    if deep and 0 < values.max() < 128:
        do = "Scale the values to 0..255 and write it with 8 bits."
        raise UserError("of the picture's 16 bits a channel the upper ones are unused", where, do)
    return values.reshape(*values.shape[:2], -1)


def _bytes_of(image: Image, where: Path) -> Array:
    """The values of an opaque picture, uint8 (H, W) or (H, W, 3)."""
    if image.has_transparency_data:
        if np.asarray(image.convert("RGBA"))[..., 3].min() < 255:
            raise UserError("the picture is transparent in places", where, "Put it on a background.")
        return np.asarray(image.convert("RGB"))
    if image.mode.startswith("I;16"):
        return (np.asarray(image) >> 8).astype(np.uint8)
    if image.mode not in (*GREY, *COLOURED):
        do = "Scale it to 0..255 and write it with 8 bits."
        raise UserError(f"the picture has the mode {image.mode}, neither 8 nor 16 bits a channel", where, do)
    return np.asarray(image.convert("L" if image.mode in GREY else "RGB"))


def read_pictures(folder: Path, taking: Taking, left: Counter[str]) -> Parts:
    """The pictures of one sub-goal, in the order of their names; ``left`` counts other files by suffix."""
    channels = {}

    def given(place: str, kinds: tuple[str, ...]) -> Given:
        names: list[str] = []
        states: list[Array] = []
        groups = []
        for kind in kinds:
            files = files_of(folder / place / kind, (*SUFFIXES, ARRAY), left)
            if not files:
                raise UserError("there are no pictures here", folder / place / kind, PLACES)
            for file in files:
                names.append(file.relative_to(folder).as_posix())
                group = file.relative_to(folder / place / kind).parent.as_posix()
                groups.append(names[-1] if group == "." else group)
                values = _state(file)
                channels.update(channels_of(values, ""))
                states.append(taking.one(values, "", str(file)))
        labels = [name.startswith(f"{place}/{TWO[0]}/".removeprefix("/")) for name in names]
        observations = {"": stacked(states, names)}
        return Given(observations, names, np.array(labels), np.array(groups) if set(groups) - set(names) else None)

    labelled, unlabelled = given("", TWO), given("", ("unlabelled",))
    heldout = given("heldout", TWO) if (folder / "heldout").is_dir() else None
    return Parts(labelled, unlabelled, heldout, channels=channels)


def _state(file: Path) -> Array:
    """The picture in a file, or the array, as it is."""
    with reading(file, DO):
        if file.suffix.lower() == ARRAY:
            return np.asarray(np.load(file, allow_pickle=False))
        return picture_of(file.read_bytes(), file)
