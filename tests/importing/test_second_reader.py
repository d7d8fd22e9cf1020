"""No import is wrong and unsaid: random files of each format, read a second time, slowly (Spec B6, G2).

Each is stored as it was drawn, or as FFmpeg decodes it, within the conversion that the docs name; or it is refused.
"""

import io
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
from PIL import Image

from hypogoal.core.errors import UserError
from hypogoal.importing.labels import SPANS, read_table
from hypogoal.importing.pictures import picture_of
from tests.importing.states import assembled

SOME = [10, pytest.param(300, marks=pytest.mark.slow)]
Random = np.random.Generator
TYPES = "?bBhHiIqQefdgFDmMUSO"  # NumPy's codes
Drawn = tuple[bytes, Any]  # a file, and what it shows: uint8 (H, W, C), None where that must be refused


def png(draw: Random) -> Drawn:
    """Every depth and type of colour that PNG has, with a palette, transparent colours, 12 bits in 16."""
    colour, depths = [(0, (1, 2, 4, 8, 16)), (2, (8, 16)), (3, (1, 2, 4, 8)), (4, (8, 16)), (6, (8, 16))][
        draw.integers(5)
    ]
    depth, channels = int(draw.choice(depths)), {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}[colour]
    height, width = draw.integers(5, 30, 2)
    used = int(draw.choice([depth, depth, 12])) if depth == 16 else depth
    values = draw.integers(0, 2**used, (height, width, channels))
    is_clear = colour in (4, 6) and draw.random() < 0.5
    if colour in (4, 6) and not is_clear:
        values[..., -1] = 2**depth - 1
    rows = values.reshape(height, -1)
    packed = np.unpackbits(rows.astype(">u2").view(np.uint8).reshape(height, -1, 2), axis=2)[..., -depth:]
    lines = np.packbits(packed.reshape(height, -1), axis=1)
    palette = draw.integers(0, 256, (2**depth, 3), dtype=np.uint8) if colour == 3 else np.zeros((0, 3), np.uint8)
    header = struct.pack(">IIBBBBB", width, height, depth, colour, 0, 0, 0)
    chunks = {b"IHDR": header, b"PLTE": palette.tobytes()}
    if colour == 3 and draw.random() < 0.3:
        chunks[b"tRNS"], is_clear = bytes(len(palette)), True
    chunks |= {b"IDAT": zlib.compress(np.insert(lines, 0, 0, axis=1).tobytes()), b"IEND": b""}
    data = b"\x89PNG\r\n\x1a\n"
    for name, part in chunks.items():
        if part or name != b"PLTE":
            data += struct.pack(">I", len(part)) + name + part + struct.pack(">I", zlib.crc32(name + part))
    shown = palette[values[..., 0]] if colour == 3 else shown_in(values[..., : 3 if channels > 2 else 1], depth)
    return data, None if is_clear or used < depth else shown


def shown_in(values: np.ndarray, depth: int) -> np.ndarray:
    """Values of a depth in 0..255: of 16 bits the upper 8."""
    scaled = values >> 8 if depth == 16 else values * 255 // (2**depth - 1)
    return scaled.astype(np.uint8)


def tiff(draw: Random) -> Drawn:
    """Both orders of bytes, strips and tiles, planes, 0 as white, signs, 4 to 16 bits, as its authors published it."""
    order = draw.choice(["<", ">"])
    depth, channels, planar = (int(draw.choice(some)) for some in ((4, 8, 12, 16), (1, 3), (1, 1, 2)))
    white = channels == 1 and draw.random() < 0.3
    signed = draw.random() < 0.1
    height, width, tile = 20, 2 * int(draw.integers(3, 20)), 16 * int(draw.integers(2))
    values = draw.integers(0, 2**depth, (height, width, channels))
    planes = np.split(values, channels, axis=2) if planar == 2 else [values]
    parts = []
    for plane in planes:
        for top in range(0, height, tile or height):
            for left in range(0, width, tile or width):
                part = plane[top : top + (tile or height), left : left + (tile or width)]
                missing = [(0, tile - part.shape[0]), (0, tile - part.shape[1]), (0, 0)] if tile else [(0, 0)] * 3
                part = np.pad(part, missing)
                bits = part.astype(">u2").reshape(len(part), -1, 1).view(np.uint8)
                row_bits = np.unpackbits(bits, axis=2)[..., -depth:].reshape(len(part), -1)
                whole = part.astype(f"{order}u2").tobytes()
                parts.append(whole if depth == 16 else np.packbits(row_bits, axis=1).tobytes())
    tags: dict[int, Any] = {
        256: [width], 257: [height], 258: [depth] * channels, 259: [1],
        262: [0 if white else 1 if channels == 1 else 2],
        277: [channels], 284: [planar], 339: [2 if signed else 1] * channels,
    }  # fmt: skip
    sizes = [len(part) for part in parts]
    tags |= {322: [tile], 323: [tile], 324: sizes, 325: sizes} if tile else {273: sizes, 278: [height], 279: sizes}
    begin = 8 + 2 + 12 * len(tags) + 4
    extra_size = sum(4 * len(value) for value in tags.values() if len(value) > 1)
    tags[324 if tile else 273] = (begin + extra_size + np.cumsum([0, *sizes[:-1]])).tolist()
    listed, extra = b"", b""
    for tag, value in sorted(tags.items()):
        body = struct.pack(f"{order}{len(value)}I", *value)
        if len(value) > 1:
            extra, body = extra + body, struct.pack(f"{order}I", begin + len(extra))
        listed += struct.pack(f"{order}HHI", tag, 4, len(value)) + body
    head = (b"II" if order == "<" else b"MM") + struct.pack(f"{order}HIH", 42, 8, len(tags))
    shown = shown_in(2**depth - 1 - values if white else values, depth)
    return head + listed + bytes(4) + extra + b"".join(parts), None if signed else shown


def netpbm(draw: Random) -> Drawn:
    """PGM and PPM of any greatest value; of 16 bits, some with 12 used."""
    channels, most = int(draw.choice([1, 3])), int(draw.choice([1, 100, 255, 4095, 65535]))
    used = 4095 if most == 65535 and draw.random() < 0.5 else most
    values = draw.integers(0, used + 1, (12, 17, channels))
    stored = values.astype(">u2" if most > 255 else np.uint8)
    data = b"P%d 17 12 %d\n" % (5 if channels == 1 else 6, most) + stored.tobytes()
    return data, None if used < most else values * 255 / most


def saved(draw: Random) -> Drawn:
    """By Pillow, without loss: BMP, GIF, WebP and TIFF, compressed or not, in modes of all kinds."""
    kind = str(draw.choice(["BMP", "GIF", "WEBP", "TIFF"]))
    mode = str(draw.choice(["1", "L", "P", "RGB", *(["RGBA"] if kind in ("WEBP", "TIFF") else [])]))
    shape = (15, 22, {"RGB": 3, "RGBA": 4}.get(mode, 1))
    values = draw.integers(0, 256, shape, dtype=np.uint8)
    opaque = mode != "RGBA" or draw.random() < 0.5
    if mode == "RGBA" and opaque:
        values[..., 3] = 255
    if mode == "P":
        image = Image.fromarray(values[..., 0])
        image.putpalette(draw.integers(0, 256, 768, dtype=np.uint8).tobytes())
    else:
        image = Image.fromarray(np.squeeze(values))
        image = image.convert("1", dither=0) if mode == "1" else image
    more = {"WEBP": {"lossless": True}, "TIFF": {"compression": draw.choice(["raw", "tiff_lzw", "tiff_deflate"])}}
    file = io.BytesIO()
    image.save(file, kind, **more.get(kind, {}))
    shown = values[..., :3] if mode != "P" else np.asarray(image.convert("RGB"))
    shown = np.where(values > 127, 255, 0) if mode == "1" else shown
    if kind == "GIF" and mode == "RGB":
        shown = by_ffmpeg(file.getvalue())  # of 256 colours
    return file.getvalue(), shown if opaque else None


def lossy(draw: Random) -> Drawn:
    """JPEG and WebP, grey or coloured: FFmpeg's pixels."""
    kind = str(draw.choice(["JPEG", "WEBP"]))
    small = draw.integers(0, 256, (4, 5, int(draw.choice([1, 3]))), dtype=np.uint8)
    image = Image.fromarray(np.squeeze(small.repeat(16, 0).repeat(16, 1)))
    file = io.BytesIO()
    image.save(file, kind, quality=int(draw.integers(60, 100)))
    return file.getvalue(), by_ffmpeg(file.getvalue())


def by_ffmpeg(data: bytes) -> np.ndarray:
    with av.open(io.BytesIO(data)) as container:
        return next(container.decode(video=0)).to_ndarray(format="rgb24")


@pytest.mark.parametrize("count", [100, SOME[1]])
@pytest.mark.parametrize("draw_file", [png, tiff, netpbm, saved, lossy])
def test_pictures_are_as_drawn_or_refused(draw_file: Callable[[Random], Drawn], count: int) -> None:
    near = 10 if draw_file is lossy else 1  # of one rounding, or of two decoders' colours
    taken = 0
    for seed in range(count):
        data, shown = draw_file(np.random.default_rng(seed))
        try:
            seen = picture_of(data, Path("x")).astype(float)
        except UserError:
            continue
        assert shown is not None, f"{seed}: taken, and must not be"
        assert np.abs(seen - shown)[8::16, 8::16].max(initial=0) <= near, seed
        assert lossy is draw_file or np.abs(seen - shown).max() <= near, seed
        taken += 1
    assert taken > count / 5


@pytest.mark.parametrize("count", SOME)
def test_arrays_are_as_written_or_refused(count: int) -> None:
    """Of every type of NumPy, in both orders of bytes and of axes, by one key or two, with labels of any kind."""
    taken = 0
    for seed in range(count):
        draw = np.random.default_rng(seed)
        dtype = np.dtype(TYPES[seed % len(TYPES)])
        shape = [(6,), (2, 3), (), (24, 20, 3), (24, 20), (3, 24, 20)][draw.integers(6)]
        size = draw.choice([1, 1, 300, 2**24, 1e39])
        with np.errstate(all="ignore"):
            values = (draw.normal(size=(60, *shape)) * size).astype(np.float64)
            values = draw.integers(0, 256, values.shape).astype(dtype) if dtype.kind in "uSUO" else values
            values = values.astype(np.int64).astype(dtype) if dtype.kind in "mM" else values.astype(dtype)
        values = values.astype(dtype.newbyteorder(">")) if draw.random() < 0.5 else np.asfortranarray(values)
        labels = (np.arange(60) % 2).astype(draw.choice([np.int8, np.float64, np.bool_]))
        rows = {"observations": values[:30], "unlabelled": values[30:50], "heldout_observations": values[50:]}
        given = {"labels": labels[:30], "heldout_labels": labels[50:]}
        extra = draw.normal(size=(60, 2)).astype(np.float32)
        key = str(draw.choice(["", "/a", "/a/b"]))
        for (name, part), begin in zip(rows.items(), (0, 30, 50), strict=True):
            given |= {f"{name}{key}": part}
            given |= {f"{name}/other": extra[begin : begin + len(part)]} if key else {}
        try:
            collected, said = assembled(given)
        except UserError:
            continue
        stored = collected.labelled.observations
        if key and not said:
            np.testing.assert_array_equal(stored["other"], extra[:30])
            stored = stored[key[1:].replace("/", ".")]
        if said and dtype.kind not in "iufb":
            continue
        wanted = values[:30].astype(np.uint8 if dtype == np.uint8 and len(shape) > 1 else np.float32)
        np.testing.assert_array_equal(stored, wanted.reshape(stored.shape), err_msg=str(seed))
        np.testing.assert_array_equal(collected.labelled.labels[:, 0], labels[:30].astype(bool))
        taken += 1
    assert taken > count / 6


@pytest.mark.parametrize("count", SOME)
def test_tables_are_as_written_or_refused(tmp_path: Path, count: int) -> None:
    """Of labels: columns in any order, more of them, quoted, with a byte order mark, other ends of lines, a hole."""
    path = tmp_path / "labels.csv"
    for seed in range(count):
        draw = np.random.default_rng(seed)
        names = draw.permutation([*SPANS, "note"]).tolist()
        rows = []
        for number in range(3):
            begin = int(draw.integers(9))
            rows.append({"episode": f"0{number}", "from": begin, "to": begin + 2, "note": 'a "b", c'})
        hole = draw.random() < 0.2
        lines = [",".join(names)]
        for row in rows:
            cells = ['"' + str(row[name]).replace('"', '""') + '"' for name in names]
            lines.append(",".join(cells[: 3 if hole else 4]))
        end = str(draw.choice(["\n", "\r\n"]))
        path.write_bytes((end.join(lines) + end).encode(str(draw.choice(["utf-8", "utf-8-sig"]))))
        try:
            table = read_table(path, SPANS)
        except UserError:
            assert hole, seed
            continue
        if hole and names[3] == "episode":  # the name is empty: no episode has it
            rows = [row | {"episode": ""} for row in rows]
        wanted = [[row[name] for name in SPANS] for row in rows]
        assert table[[*SPANS]].to_numpy().tolist() == wanted, seed
