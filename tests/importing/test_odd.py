"""Pictures and numbers of odd kinds: each is read right or refused (Spec B6, G2).

What is right is known from how each was drawn, not from how it is read.
"""

import io
import struct
import zlib
from collections import Counter
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from PIL import Image

from hypogoal.core.errors import UserError
from hypogoal.importing.pictures import picture_of
from hypogoal.importing.recordings import read_robomimic
from hypogoal.importing.states import frames_of, together

LENGTH = 6  # of an episode


def turned(picture: np.ndarray, orientation: int) -> np.ndarray:
    """How a picture is stored that viewers turn by this EXIF orientation."""
    picture = picture.swapaxes(0, 1) if orientation > 4 else picture
    return {
        1: picture, 2: picture[:, ::-1], 3: picture[::-1, ::-1], 4: picture[::-1], 5: picture, 6: picture[::-1],
        7: picture[::-1, ::-1], 8: picture[:, ::-1],
    }[orientation]  # fmt: skip


def deep_png(values: np.ndarray) -> bytes:
    """A PNG of 16 bits a channel, which Pillow does not write; ``values`` uint16 (H, W, 3)."""
    height, width, _ = values.shape
    lines = b"".join(b"\0" + row.astype(">u2").tobytes() for row in values)
    written = b"\x89PNG\r\n\x1a\n"
    header = struct.pack(">IIBBBBB", width, height, 16, 2, 0, 0, 0)
    for name, data in ((b"IHDR", header), (b"IDAT", zlib.compress(lines)), (b"IEND", b"")):
        written += struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))
    return written


def tiff(values: np.ndarray, depth: int = 8, colours: int = 2, planes: int = 1, signs: int = 1) -> bytes:
    """A TIFF of one strip a plane, which Pillow writes of some kinds only; the rest are numbers of its standard."""
    height, width, channels = values.shape
    whole = values.astype(np.uint8 if depth == 8 else "<u2")
    parts = [whole.tobytes()] if planes == 1 else [whole[..., channel].tobytes() for channel in range(channels)]
    places = [8 + len(parts[0]) * number for number in range(len(parts))]
    tags = {
        256: [width], 257: [height], 258: [depth] * channels, 259: [1], 262: [colours], 273: places, 277: [channels],
        278: [height], 279: [len(part) for part in parts], 284: [planes], 339: [signs] * channels,
    }  # fmt: skip
    body, listed = b"".join(parts), b""
    for tag, value in tags.items():
        word = value[0] if len(value) == 1 else 8 + len(body)
        body += struct.pack(f"<{len(value)}I", *value) if len(value) > 1 else b""
        listed += struct.pack("<HHII", tag, 4, len(value), word)
    return struct.pack("<2sHI", b"II", 42, 8 + len(body)) + body + struct.pack("<H", len(tags)) + listed + bytes(4)


def stored(image: np.ndarray | Image.Image, kind: str = "PNG", **more: Any) -> bytes:
    if isinstance(image, np.ndarray):
        image = Image.fromarray(np.ascontiguousarray(image))
    file = io.BytesIO()
    image.save(file, kind, **more)
    return file.getvalue()


def with_orientation(number: int) -> bytes:
    exif = Image.Exif()
    exif[0x0112] = number
    return stored(turned(COLOURED, number), exif=exif)


def with_palette() -> bytes:
    """Its indices are GREY's shades, and their colours PALETTE."""
    image = Image.new("P", (7, 9))
    image.putdata(GREY.ravel().tolist())
    image.putpalette(PALETTE.ravel().tolist())
    return stored(image)


COLOURED = np.random.default_rng(0).integers(0, 256, (9, 7, 3), dtype=np.uint8)
PALETTE = np.random.default_rng(1).integers(0, 256, (256, 3), dtype=np.uint8)
GREY = COLOURED[..., :1]
DEEP = COLOURED * np.uint16(257)
OPAQUE = np.append(COLOURED, np.full_like(GREY, 255), axis=2)
CLEAR = np.append(COLOURED, GREY, axis=2)
SEVERAL = {"save_all": True, "append_images": [Image.fromarray(COLOURED[::-1])] * 2}
ODD: list[tuple[bytes, np.ndarray | None]] = [
    *((with_orientation(number), COLOURED) for number in (2, 6, 7)),
    (with_palette(), PALETTE[GREY[..., 0]]),
    (deep_png(DEEP), COLOURED),
    (stored(COLOURED, "BMP"), COLOURED),
    (stored(COLOURED, "PPM"), COLOURED),
    (stored(COLOURED, "TIFF", **SEVERAL), COLOURED),
    (stored(DEEP[..., 0]), GREY),
    (stored(GREY[..., 0] > 127, "TIFF"), (GREY > 127) * 255),
    (stored(GREY[..., 0] > 127), (GREY > 127) * 255),
    (stored(GREY[..., 0], "GIF"), GREY),
    (stored(OPAQUE), COLOURED),
    (stored(OPAQUE, "WEBP", lossless=True), COLOURED),
    (tiff(COLOURED), COLOURED),
    (tiff(COLOURED, planes=2), COLOURED),
    (tiff(255 - GREY, colours=0), GREY),
    (tiff(GREY * np.uint16(257), 16, 1), GREY),
    (b"P5 7 9 85\n" + (GREY // 3).tobytes(), GREY // 3 * 3),
    (b"P5 7 9 65535\n" + (GREY * np.uint16(257)).astype(">u2").tobytes(), GREY),
    # What must be refused: 12 bits, 12 of 16, 0 as white in 16, planes of 16, signs, 32 bits, clear pixels, a cut file.
    (tiff(GREY, 12, 1), None),
    (tiff(GREY * np.uint16(257), 16, 0), None),
    (tiff(DEEP, 16, planes=2), None),
    (tiff(GREY, colours=1, signs=2), None),
    (b"P5 7 9 65535\n" + (GREY * np.uint16(16)).astype(">u2").tobytes(), None),
    (b"P6 7 9 65535\n" + (COLOURED * np.uint16(16)).astype(">u2").tobytes(), None),
    (deep_png(DEEP >> 4), None),
    (stored(DEEP[..., 0] >> 4, "TIFF"), None),
    (stored(GREY[..., 0].astype(np.float32), "TIFF"), None),
    (stored(GREY[..., 0].astype(np.int32), "TIFF"), None),
    (stored(CLEAR), None),
    (stored(CLEAR, "WEBP", lossless=True), None),
    (stored(COLOURED, "BMP")[:11], None),
]


@pytest.mark.parametrize(("data", "shown"), ODD)
def test_odd_pictures(data: bytes, shown: np.ndarray | None) -> None:
    if shown is None:
        with pytest.raises(UserError):
            picture_of(data, Path("x.png"))
        return
    seen = picture_of(data, Path("x.png"))
    np.testing.assert_array_equal(seen, np.broadcast_to(shown, seen.shape))  # a palette of greys may become coloured


PICTURE = np.random.default_rng(0).integers(0, 256, (LENGTH, 20, 24, 3), dtype=np.uint8)
ROWS = np.random.default_rng(1).normal(size=(LENGTH, 4))
# The frames (T, ...) of a key, and what they are taken for: None if that must be refused, a text if they are left out.
KEYS: dict[str, tuple[Any, Any]] = {
    "channels first": (PICTURE.transpose(0, 3, 1, 2), None),
    "stack": (PICTURE[:, None].repeat(2, 1), None),
    "depth": (PICTURE[..., 0].astype(np.uint16) * 9, None),
    "integers like a picture": (PICTURE.astype(np.int64), None),
    "not finite": (np.where(ROWS > 0.5, np.nan, ROWS), None),
    "too large": (ROWS * 1e39, None),
    "too small": (np.where(ROWS > 0.5, 1e-60, ROWS), None),
    "stamps": (1_790_000_000_000_000_000 + 33_000_000 * np.arange(LENGTH)[:, None], None),
    "steps too small for their size": (4e6 + 1e-3 * np.arange(LENGTH)[:, None], None),
    "empty": (ROWS[:, :0], None),
    "complex": (ROWS * 1j, "left"),
    "text": (np.array(["open"] * LENGTH, dtype=h5py.string_dtype()), "left"),
    "picture": (PICTURE, PICTURE),
    "grey": (PICTURE[..., 0], PICTURE[..., :1]),
    "numbers": (ROWS, ROWS),
    "one number": (ROWS[:, 0], ROWS[:, :1]),
    "float16": (ROWS.astype(np.float16).reshape(LENGTH, 2, 2), ROWS.astype(np.float16).reshape(LENGTH, 2, 2)),
    "truths": (ROWS > 0, ROWS > 0),
    "bytes": (PICTURE[:, 0, :7, 0], PICTURE[:, 0, :7, 0]),
    "integers": (np.arange(LENGTH)[:, None] - 3, np.arange(LENGTH)[:, None] - 3),
    "flags of a large number": (1e9 * (np.arange(LENGTH)[:, None] % 2), 1e9 * (np.arange(LENGTH)[:, None] % 2)),
}


@pytest.mark.parametrize("kind", KEYS)
def test_odd_keys_of_a_recording(tmp_path: Path, kind: str) -> None:
    """Beside another key, in a group of its own."""
    values, wanted = KEYS[kind]
    path, left = tmp_path / "x.hdf5", Counter[str]()
    with h5py.File(path, "w") as file:
        for episode in range(3):
            file[f"data/demo_{episode}/obs/plain"] = ROWS
            file[f"data/demo_{episode}/obs/b/ä x"] = values
            file[f"data/demo_{episode}/rewards"] = (np.arange(LENGTH) > 2) * 1.0

    def read() -> dict[str, np.ndarray]:
        frames = frames_of(path, read_robomimic(path, ()), left)
        return {key: together(seen, frames.table["name"], key) for key, seen in frames.seen.items()}

    if wanted is None:
        with pytest.raises(UserError):
            read()
        return
    states = read()
    assert bool(left) == isinstance(wanted, str)
    if not isinstance(wanted, str):
        np.testing.assert_allclose(states["b.ä x"], np.concatenate([wanted] * 3), rtol=1e-6)
