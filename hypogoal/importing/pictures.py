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
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from hypogoal.core.errors import UserError
from hypogoal.importing.files import files_of, reading
from hypogoal.importing.parts import Given, Parts
from hypogoal.importing.taken import stacked, taken_one

if TYPE_CHECKING:
    from PIL.Image import Image

FORMATS = ("PNG", "JPEG", "BMP", "GIF", "WEBP", "TIFF", "PPM", "AVIF")  # for PostScript, Pillow runs a program
SUFFIXES = (
    ".png", ".apng", ".jpg", ".jpeg", ".jfif", ".jpe", ".mpo", ".bmp", ".gif", ".webp", ".tif", ".tiff", ".ppm", ".pgm",
    ".pbm", ".avif",
)  # fmt: skip
ARRAY = ".npy"  # a state that no format of pictures holds, such as a stack of four frames
GREY = ("1", "L")
COLOURED = ("P", "RGB", "RGBX", "CMYK", "YCbCr", "HSV", "LA", "PA", "RGBA", "La", "RGBa")
DO = "Remove it, or write it again."


def picture_of(data: bytes, where: Path) -> NDArray[np.uint8]:
    """The picture in a file of any of ``FORMATS``, uint8 (H, W, 3), or (H, W, 1) if it is grey; ``where`` it is from.

    It is turned as viewers turn it; of several pictures in one file it is the first; of 16 bits a channel the upper 8
    are taken. A ``UserError``: transparent pixels, 16 bits whose upper ones are unused, 32 bits, no picture.
    """
    import PIL.Image
    import PIL.ImageOps

    with (
        reading(where, DO),
        warnings.catch_warnings(action="ignore"),
        PIL.Image.open(io.BytesIO(data), formats=FORMATS) as opened,
    ):
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


def _bytes_of(image: Image, where: Path) -> NDArray[np.uint8]:
    """The values of an opaque picture, uint8 (H, W) or (H, W, 3)."""
    if image.has_transparency_data:
        if np.asarray(image.convert("RGBA"))[..., 3].min() < 255:
            do = "Put it on a background, as the agent sees it."
            raise UserError("the picture is transparent in places", where, do)
        return np.asarray(image.convert("RGB"))
    if image.mode.startswith("I;16"):
        return (np.asarray(image) >> 8).astype(np.uint8)
    if image.mode not in (*GREY, *COLOURED):
        do = "Scale it to 0..255 and write it with 8 bits."
        raise UserError(f"the picture has the mode {image.mode}, neither 8 nor 16 bits a channel", where, do)
    return np.asarray(image.convert("L" if image.mode in GREY else "RGB"))


def read_pictures(folder: Path, *, side: int = 0, stack: bool = False) -> tuple[Parts, Counter[str]]:
    """The pictures of one sub-goal, in the order of their names, and how many other files there are, by suffix.

    ``side`` and ``stack``: see :func:`taken_one`; smaller pictures may be of one size where large ones are not.
    """
    left: Counter[str] = Counter()

    def given(kinds: tuple[str, ...]) -> Given:
        states: list[NDArray[Any]] = []
        files: list[Path] = []
        counts = []
        for kind in kinds:
            some = files_of(folder / kind, (*SUFFIXES, ARRAY), left)
            if not some:
                do = "Put some into positive/, negative/ and unlabelled/, and to judge by into heldout/positive/ etc."
                raise UserError("there are no pictures here", folder / kind, do)
            states += [taken_one(_state(file), str(file), side, stack) for file in some]
            files += some
            counts.append(len(some))
        names = [file.relative_to(folder).as_posix() for file in files]
        labels = np.arange(len(files)) < counts[0] if len(kinds) == 2 else None
        return Given(stacked(states, names), names, labels, _groups(names, kinds[0].count("/") + 1))

    parts = [given(("positive", "negative")), given(("unlabelled",))]
    if (folder / "heldout").is_dir():
        parts.append(given(("heldout/positive", "heldout/negative")))
    return Parts(*parts), left


def _groups(names: list[str], depth: int) -> NDArray[Any] | None:
    """The folder of each picture below the first ``depth`` ones, (N,); None if all are outside of such folders.

    A picture outside is a group of its own.
    """
    folders = ["/".join(name.split("/")[depth:-1]) for name in names]
    return np.array([folder or name for folder, name in zip(folders, names, strict=True)]) if any(folders) else None


def _state(file: Path) -> NDArray[Any]:
    """The picture in a file, or the array, as it is."""
    with reading(file, DO):
        if file.suffix.lower() == ARRAY:
            return np.asarray(np.load(file, allow_pickle=False))
        return picture_of(file.read_bytes(), file)
