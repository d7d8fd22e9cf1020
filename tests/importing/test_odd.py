"""Pictures, recordings and numbers of odd kinds, drawn by seed: each is read right or refused (Spec B6, G2).

What is right is known from how each was drawn, not from how it is read.
"""

from __future__ import annotations

import io
import struct
import zlib
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from PIL import Image

from hypogoal.core.errors import UserError
from hypogoal.importing.pictures import picture_of
from hypogoal.importing.recordings import read_robomimic
from hypogoal.importing.states import Frames, frames_of
from hypogoal.importing.taken import as_numbers, together

COLOURS = {1: 0, 2: 4, 3: 2, 4: 6}  # PNG's colour type, by channels
LENGTH = 6  # of an episode


def turned(picture: np.ndarray, orientation: int) -> np.ndarray:
    """How a picture is stored that viewers turn by this EXIF orientation."""
    picture = picture.swapaxes(0, 1) if orientation > 4 else picture
    return {
        1: picture, 2: picture[:, ::-1], 3: picture[::-1, ::-1], 4: picture[::-1], 5: picture, 6: picture[::-1],
        7: picture[::-1, ::-1], 8: picture[:, ::-1],
    }[orientation]  # fmt: skip


def png(values: np.ndarray, depth: int, orientation: int, palette: np.ndarray | None = None) -> bytes:
    """A PNG, of any depth and number of channels, after its specification."""
    values = turned(values, orientation)
    height, width, channels = values.shape
    lines = []
    for row in values.reshape(height, -1):
        bits = "".join(format(value, f"0{depth}b") for value in row.tolist())
        bits += "0" * (-len(bits) % 8)
        lines.append(b"\0" + int(bits, 2).to_bytes(len(bits) // 8, "big"))
    kind = 3 if palette is not None else COLOURS[channels]
    exif = b"II" + struct.pack("<HIHHHIHHI", 42, 8, 1, 0x0112, 3, 1, orientation, 0, 0)
    chunks = [(b"IHDR", struct.pack(">IIBBBBB", width, height, depth, kind, 0, 0, 0)), (b"eXIf", exif)]
    chunks += [(b"PLTE", palette.tobytes())] if palette is not None else []
    chunks += [(b"IDAT", zlib.compress(b"".join(lines))), (b"IEND", b"")]
    written = b"\x89PNG\r\n\x1a\n"
    for name, data in chunks:
        written += struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))
    return written


def drawn_png(rng: np.random.Generator) -> tuple[bytes, np.ndarray | None]:
    """A PNG of any depth, and what it shows; None if it must be refused."""
    channels = int(rng.integers(1, 5))
    depth = int(rng.choice((1, 2, 4, 8, 16) if channels == 1 else (8, 16)))
    size, orientation = tuple(rng.integers(1, 24, 2)), int(rng.integers(1, 9))
    if channels == 1 and depth < 16 and rng.random() < 0.4:
        palette = rng.integers(0, 256, (1 << depth, 3), dtype=np.uint8)
        values = rng.integers(0, 1 << depth, (*size, 1))
        return png(values, depth, orientation, palette), palette[values[..., 0]]
    most = 1 << (12 if depth == 16 and rng.random() < 0.3 else depth)
    values = rng.integers(0, most, (*size, channels))
    wanted = values >> 8 if depth == 16 else values * 255 // ((1 << depth) - 1)
    if channels in (2, 4):
        opaque = rng.random() < 0.7
        values[..., -1] = (1 << depth) - 1 if opaque else values[..., -1] // 2
        wanted = wanted[..., :-1].repeat(3 if channels == 2 else 1, 2) if opaque else None
    if depth == 16 and wanted is not None and 0 < wanted.max() < 128:
        wanted = None
    return png(values, depth, orientation), wanted


def drawn_other(rng: np.random.Generator) -> tuple[bytes, np.ndarray | None]:
    """A picture of another format or mode, perhaps one of several in a file, and what it shows."""
    size = tuple(rng.integers(1, 24, 2))
    grey, colours = (rng.integers(0, 256, (*size, channels), dtype=np.uint8) for channels in (1, 3))
    alpha = np.full((*size, 1), 255, np.uint8) if rng.random() < 0.6 else grey
    opaque = bool((alpha == 255).all())
    kind, values, wanted = {
        0: ("BMP", colours, colours),
        1: ("TIFF", colours, colours),
        2: ("TIFF", grey[..., 0], grey),
        3: ("TIFF", (grey[..., 0] * np.uint16(257)), grey if not 0 < grey.max() < 128 else None),
        4: ("TIFF", grey[..., 0].astype(np.float32), None),
        5: ("TIFF", grey[..., 0].astype(np.int32), None),
        6: ("WEBP", np.concatenate([colours, alpha], 2), colours if opaque else None),
        7: ("GIF", grey[..., 0], grey),
        8: ("PPM", colours, colours),
        9: ("TIFF", np.concatenate([colours, alpha], 2), colours if opaque else None),
        10: ("TIFF", grey[..., 0] > 127, (grey > 127) * 255),
    }[int(rng.integers(11))]
    exif, orientation = Image.Exif(), int(rng.integers(1, 9)) if kind == "WEBP" else 1
    exif[0x0112] = orientation
    file, image = io.BytesIO(), Image.fromarray(np.ascontiguousarray(turned(values, orientation)))
    several = kind in ("TIFF", "GIF", "WEBP") and rng.random() < 0.3
    more: dict[str, Any] = {"save_all": True, "append_images": [image.rotate(180)] * 2} if several else {}
    image.save(file, kind, **more, **({"lossless": True, "exact": True, "exif": exif} if kind == "WEBP" else {}))
    data = file.getvalue()
    if rng.random() < 0.1:
        return data[: int(rng.integers(1, 12))], None
    return data, wanted


def told(call: Callable[[], Any]) -> Any:
    """What a call returns, or the line with which it refuses."""
    try:
        return call()
    except UserError as error:
        return str(error)


def outcome_of_picture(seed: int) -> str:
    rng = np.random.default_rng(seed)
    data, wanted = (drawn_png if seed % 2 else drawn_other)(rng)
    seen = told(lambda: picture_of(data, Path("x.png")))
    assert isinstance(seen, str) == (wanted is None), (seed, seen)
    if isinstance(seen, str):
        return "refused"
    shown = np.broadcast_to(wanted, seen.shape)  # a palette of greys may have become coloured
    np.testing.assert_array_equal(seen, shown, str(seed))
    return "right"


def test_odd_pictures() -> None:
    outcomes = Counter(outcome_of_picture(seed) for seed in range(300))
    assert min(outcomes["right"], outcomes["refused"]) > 50


def drawn_key(rng: np.random.Generator) -> tuple[Any, Any]:
    """The frames (T, ...) of a key, and what they are taken for: None if that must be refused, a text if left out."""
    picture = rng.integers(0, 256, (LENGTH, 20, 24, 3), dtype=np.uint8)
    rows = rng.normal(size=(LENGTH, 4))
    rare = {
        "channels first": (picture.transpose(0, 3, 1, 2), None),
        "stack": (picture[:, None].repeat(2, 1), None),
        "depth": (picture[..., 0].astype(np.uint16) * 9, None),
        "integers like a picture": (picture.astype(np.int64), None),
        "not finite": (np.where(rows > 0.5, np.nan, rows) + np.array([np.inf, 0, 0, 0]), None),
        "too large": (rows * 1e39, None),
        "stamps": (1_790_000_000_000_000_000 + 33_000_000 * np.arange(LENGTH)[:, None], None),
        "complex": (rows * 1j, "left"),
        "text": (np.array(["open"] * LENGTH, dtype=h5py.string_dtype()), "left"),
        "another length": (rows[:-1], rows[:-1]),
        "empty": (rows[:, :0], None),
    }
    common = {
        "picture": (picture, picture),
        "grey": (picture[..., 0], picture[..., :1]),
        "numbers": (rows, rows),
        "one number": (rows[:, 0], rows[:, :1]),
        "float16": (rows.astype(np.float16).reshape(LENGTH, 2, 2), rows.astype(np.float16).reshape(LENGTH, 2, 2)),
        "truths": (rows > 0, rows > 0),
        "bytes": (picture[:, 0, :7, 0], picture[:, 0, :7, 0]),
        "integers": (np.arange(LENGTH)[:, None] - 3, np.arange(LENGTH)[:, None] - 3),
    }
    kinds = rare if rng.random() < 0.15 else common
    return kinds[str(rng.choice([*kinds]))]


def outcome_of_recording(seed: int, folder: Path) -> str:
    """Several keys, some in groups, in a file of three episodes and more."""
    rng, path = np.random.default_rng(seed), folder / f"{seed}.hdf5"
    names = [str(name) for name in rng.choice(["a", "b/x", "b/y", "c d", "ä", "e.f"], int(rng.integers(1, 5)), False)]
    drawn = {name: drawn_key(rng) for name in names}
    with h5py.File(path, "w") as file:
        for episode in range(int(rng.integers(3, 6))):
            for name, (values, _) in drawn.items():
                file[f"data/demo_{episode}/obs/{name}"] = values
            file[f"data/demo_{episode}/rewards"] = (np.arange(LENGTH) > 2) * 1.0
    wanted = {name: taken for name, (_, taken) in drawn.items() if not isinstance(taken, str)}
    lengths = {len(values) for name, (values, _) in drawn.items() if name in wanted}
    refused = lengths != {LENGTH} or any(taken is None for taken in wanted.values())

    def read() -> tuple[Frames, dict[str, np.ndarray], Counter[str]]:
        left: Counter[str] = Counter()
        frames = frames_of(path, read_robomimic(path, (), left), left)
        return frames, {key: together(seen, frames.table["name"], key) for key, seen in frames.seen.items()}, left

    seen = told(read)
    assert isinstance(seen, str) == refused, (seed, seen)
    if refused:
        return "refused"
    frames, states, left = seen
    for key, values in wanted.items():
        name = key.replace("/", ".") if len(wanted) > 1 else ""
        right = np.concatenate([values] * (len(frames.table) // LENGTH))
        np.testing.assert_allclose(states[name], right, rtol=1e-6, err_msg=str(seed))
    assert bool(left) == (len(wanted) < len(names))
    return "right"


def test_odd_recordings(tmp_path: Path) -> None:
    outcomes = Counter(outcome_of_recording(seed, tmp_path) for seed in range(60))
    assert min(outcomes["right"], outcomes["refused"]) > 10


def outcome_of_cast(seed: int) -> str:
    """Numbers whose last column float32 may not hold."""
    rng = np.random.default_rng(seed)
    rows, columns = int(rng.integers(20, 200)), int(rng.integers(1, 6))
    values = rng.normal(size=(rows, columns)) * 10.0 ** rng.integers(-25, 25, columns)
    last = np.argsort(rng.normal(size=rows))
    kind = str(rng.choice(["plain", "offset", "stamps", "large", "small", "nan", "whole", "half", "few"]))
    if kind in ("plain", "offset"):
        values[:, -1] = last * 1e-3 + (4e6 if kind == "offset" else 4e2)
    if kind in ("large", "small", "nan"):
        values[int(rng.integers(rows)), -1] = {"large": -1e39, "small": 1e-60, "nan": np.nan}[kind]
    if kind == "few":  # flags in a column of large numbers
        values[:, -1] = 1e9 * (last % 2)
    given: np.ndarray = values
    if kind in ("stamps", "whole"):
        given = (last[:, None] * 33_000_000 + 1_790_000_000_000_000_000) if kind == "stamps" else last[:, None] * 1_000
    if kind == "half":
        given = (values / np.abs(values).max()).astype(np.float16)
    lost = kind in ("offset", "stamps", "large", "small", "nan")
    cast = told(lambda: as_numbers(given, "these"))
    assert isinstance(cast, str) == lost, (seed, kind, cast)
    if isinstance(cast, str):
        assert f"1 columns, such as {given.shape[1] - 1}" in cast
        return "refused"
    np.testing.assert_allclose(cast, given, rtol=1e-6)
    for column in range(given.shape[1]):
        assert len(np.unique(cast[:, column])) == len(np.unique(given[:, column]))
    return "right"


def test_odd_casts() -> None:
    outcomes = Counter(outcome_of_cast(seed) for seed in range(200))
    assert min(outcomes["right"], outcomes["refused"]) > 50
