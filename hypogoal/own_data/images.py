"""A folder of images: ``positive/``, ``negative/``, ``unlabelled/``, and ``heldout/`` with the first two in it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hypogoal.core.errors import UserError
from hypogoal.own_data.parts import Parts

SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".gif", ".webp")


def read_images(folder: Path) -> Parts:
    """The images of one sub-goal, in the order of their names; grey where all are, else red, green and blue.

    Args:
        folder: see above; ``heldout`` may be missing.

    Raises:
        UserError: a folder is missing or empty, an image cannot be read, or they are of different sizes.
    """
    wanted = {name: _files(folder / name) for name in ("positive", "negative", "unlabelled")}
    heldout = folder / "heldout"
    if heldout.is_dir():
        wanted |= {f"heldout/{name}": _files(heldout / name) for name in ("positive", "negative")}
    colour = not all(_is_grey(file) for files in wanted.values() for file in files)
    read = {name: _read(files, colour) for name, files in wanted.items()}
    sizes = {images.shape[1:3]: name for name, images in read.items()}
    if len(sizes) > 1:
        text = ", ".join(f"{name} {height} x {width}" for (height, width), name in sizes.items())
        raise UserError("the images are of different sizes", text, "Make them all one size.")
    parts = [_labelled(read["positive"], read["negative"])]
    if heldout.is_dir():
        parts.append(_labelled(read["heldout/positive"], read["heldout/negative"]))
    return Parts(*parts[0], read["unlabelled"], *(parts[1] if len(parts) > 1 else ()))


def _labelled(positive: NDArray[np.uint8], negative: NDArray[np.uint8]) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    return np.concatenate([positive, negative]), np.arange(len(positive) + len(negative)) < len(positive)


def _files(folder: Path) -> list[Path]:
    do = "Put images into positive/, negative/ and unlabelled/, and, for evaluation, into heldout/positive/ and so on."
    if not folder.is_dir():
        raise UserError("no such folder", folder, do)
    files = sorted(file for file in folder.iterdir() if file.suffix.lower() in SUFFIXES and file.name[0] != ".")
    if not files:
        raise UserError(f"no images ({', '.join(SUFFIXES)})", folder, do)
    return files


def _is_grey(file: Path) -> bool:
    from PIL import Image

    try:
        with Image.open(file) as image:
            return image.mode in ("1", "L")
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError):
        raise UserError("this is no image, or a damaged one", file, "Remove it, or write it again.") from None


def _read(files: list[Path], colour: bool) -> NDArray[np.uint8]:
    """uint8 (N, H, W, 1 or 3)."""
    from PIL import Image

    images: list[NDArray[np.uint8]] = []
    for file in files:
        try:
            with Image.open(file) as image:
                values = np.asarray(image.convert("RGB" if colour else "L"), dtype=np.uint8)
        except (OSError, ValueError, SyntaxError, Image.DecompressionBombError):
            raise UserError("this is no image, or a damaged one", file, "Remove it, or write it again.") from None
        if images and values.shape[:2] != images[0].shape[:2]:
            (height, width), (other_height, other_width) = values.shape[:2], images[0].shape[:2]
            what = f"the image is {height} x {width}, others are {other_height} x {other_width}"
            raise UserError(what, file, "Make them all one size.")
        images.append(values.reshape(*values.shape[:2], -1))
    return np.stack(images)
