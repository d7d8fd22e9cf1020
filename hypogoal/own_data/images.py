"""A folder of images: ``positive/``, ``negative/``, ``unlabelled/``, and ``heldout/`` with the first two inside."""

from __future__ import annotations

import contextlib
import struct
import warnings
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from hypogoal.core.errors import UserError
from hypogoal.core.files import open_file
from hypogoal.domains.observations import CLEARLY, reading_of, shrunk_picture
from hypogoal.observations import PICTURE
from hypogoal.own_data.arrays import DAMAGED
from hypogoal.own_data.parts import STACKED, Parts

if TYPE_CHECKING:
    from PIL.Image import Image

SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".gif", ".webp")
FORMATS = ("PNG", "JPEG", "BMP", "GIF", "WEBP")  # whatever a file's name: for PostScript, PIL would run a program
MOST_PIXELS = 4096 * 4096  # of a state; a kilobyte can declare a thousand times as many
ARRAY = ".npy"  # a state that no image format holds, such as a stack of four frames
DO = "Remove it, or write it again."
GREY, COLOURED, TRANSPARENT = ("1", "L"), ("P", "RGB", "CMYK", "YCbCr"), ("LA", "PA", "RGBA")  # 8 bits per channel


def read_images(folder: Path, *, resize: int = 0, stack: bool = False) -> Parts:
    """The images of one sub-goal, in the order of their names; grey if all are, else red, green and blue.

    ``resize`` and ``stack``: see :func:`as_observations`; resizing may make different sizes equal. A folder that is
    missing (except ``heldout``) or empty, an unreadable image, and different sizes are a ``UserError``.
    """
    names = ["positive", "negative", "unlabelled"]
    if (folder / "heldout").is_dir():
        names += ["heldout/positive", "heldout/negative"]
    files = {name: _files(folder / name) for name in names}
    images = {name: _read(of_kind, resize, stack) for name, of_kind in files.items()}
    sizes = {_size(some[0]): name for name, some in images.items()}
    if len(sizes) > 1:
        text = ", ".join(f"{name} {size}" for size, name in sizes.items())
        raise UserError("the images differ in size", text, "Make them all one size.")
    channels = max(image.shape[2] for some in images.values() for image in some)
    read = [np.stack([image.repeat(channels // image.shape[2], axis=2) for image in some]) for some in images.values()]

    def name(field: str, row: int) -> str:
        kinds = {"observations": names[:2], "unlabelled": names[2:3], "heldout_observations": names[3:]}[field]
        file = [file for kind in kinds for file in files[kind]][row]
        return file.relative_to(folder).as_posix()

    heldout, heldout_labels = _labelled(*read[3:]) if read[3:] else (None, None)
    return Parts(*_labelled(*read[:2]), read[2], heldout, heldout_labels, name=name)


def _labelled(positive: NDArray[np.uint8], negative: NDArray[np.uint8]) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    return np.concatenate([positive, negative]), np.arange(len(positive) + len(negative)) < len(positive)


def _files(folder: Path) -> list[Path]:
    do = "Put images into positive/, negative/ and unlabelled/, and, for evaluation, into heldout/positive/ and so on."
    if not folder.is_dir():
        raise UserError("no such folder", folder, do)
    files = sorted(file for file in folder.glob("[!.]*") if file.suffix.lower() in (*SUFFIXES, ARRAY))
    if not files:
        raise UserError(f"no images ({', '.join(SUFFIXES)})", folder, do)
    return files


def read_image(file: Path, *, stack: bool = False) -> NDArray[np.uint8]:
    """One state, uint8 (H, W, C): an upright image, grey or in three colours, or the array of a ``.npy`` file.

    An image too large, of over 8 bits a channel, animated, partly transparent or unreadable is a ``UserError``.
    """
    import PIL.Image
    import PIL.ImageOps

    open_file(file, "the image is", DO).close()
    try:
        if file.suffix == ARRAY:
            values = np.load(file, mmap_mode="r", allow_pickle=False)
            if values.ndim < 3 or values.dtype != PICTURE or 0 in values.shape:
                raise UserError(f"a state is uint8 (H, W, C), not {values.dtype} {values.shape}", file, DO)
            reading = reading_of(values.shape, values.dtype)
            if not reading.axes or (reading.fault and not stack):
                do = f"{CLEARLY} {STACKED}" if reading.axes else CLEARLY
                raise UserError(f"states {reading.fault}", f"{file}, {values.dtype} {values.shape}", do)
            return np.array(reading.arranged(values[None])[0])
        quiet = warnings.catch_warnings(action="ignore")
        with quiet, open_file(file, "the image is", DO) as raw, PIL.Image.open(raw, formats=FORMATS) as image:
            if (pixels := image.width * image.height) > MOST_PIXELS:
                raise UserError(f"the image has {pixels:,} pixels, at most {MOST_PIXELS:,} are read", file, DO)
            if getattr(image, "is_animated", False):
                raise UserError("one file holds several pictures", file, "Write each as a file of its own.")
            image.load()  # in a PNG the orientation may follow the pixels
            upright: Image = image
            with contextlib.suppress(*DAMAGED, LookupError, AttributeError, struct.error):  # viewers ignore bad EXIF
                upright = PIL.ImageOps.exif_transpose(image)
            values = np.asarray(_opaque(upright, file).convert("L" if image.mode in GREY else "RGB"), dtype=np.uint8)
    except (*DAMAGED, LookupError, struct.error, PIL.Image.DecompressionBombError):
        raise UserError("this is not an image, or it is damaged", file, DO) from None
    return values.reshape(*values.shape[:2], -1)


def _opaque(image: Image, file: Path) -> Image:
    """The image without an alpha channel; a ``UserError`` if it is partly transparent or not of 8 bits."""
    if image.mode not in (*GREY, *COLOURED, *TRANSPARENT):
        do = "Scale it to 0..255 and write it again."
        raise UserError(f"the image has the mode {image.mode}, not 8 bits a channel", file, do)
    if image.mode in TRANSPARENT or "transparency" in image.info:
        if np.asarray(image.convert("RGBA"))[..., 3].min() < 255:
            raise UserError("the image is transparent in places", file, "Put it on a background, as the agent sees it.")
        return image.convert("RGB")
    return image


def _read(files: list[Path], resize: int, stack: bool) -> list[NDArray[np.uint8]]:
    """The images in some files, all of one size."""
    images: list[NDArray[np.uint8]] = []
    for file in files:
        image = read_image(file, stack=stack)
        images.append(shrunk_picture(image, resize) if resize else image)
        if _size(images[-1]) != _size(images[0]):
            fault = f"the image is {_size(images[-1])}, others are {_size(images[0])}"
            raise UserError(fault, file, "Make them all one size.")
    return images


def _size(image: NDArray[np.uint8]) -> str:
    """Height and width, and the number of channels unless it is 1 or 3."""
    return " x ".join(map(str, image.shape[: 2 if image.shape[2] in (1, 3) else 3]))
