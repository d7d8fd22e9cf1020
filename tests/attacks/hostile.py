"""Files for ``tests.attacks.attacks`` that are made to hurt whoever reads them: each kind by name, and who reads it."""

from __future__ import annotations

import io
import json
import os
import random
import shutil
import struct
import tomllib
import zipfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from tests.attacks.fuzz import OWN, PRESET, resigned
from tests.attacks.mutations import bytes_changed, toml_of

Rng = random.Random
Makers = dict[str, Callable[[Path], object]]
SHAPE = (4, 5, 3)
TRAINED = ("data", "ensemble", "sequential", "options", "meta", "ppo", "dqn")  # the stages of a whole run


@dataclass(frozen=True)
class Made:
    """A hostile file: what was done to it, its size in bytes, who reads it, and how what they write may be called."""

    name: str
    size: int
    commands: list[list[object]]
    outputs: tuple[str, ...] = ("made", ".made")


def size_of(path: Path) -> int:
    """The bytes of a file, or of all files of a folder."""
    return sum(file.lstat().st_size for file in [path, *path.rglob("*")] if file.is_file() or file.is_symlink())


def chosen(makers: Makers, case: int) -> tuple[str, Callable[[Path], object]]:
    """The makers in turn."""
    name = [*makers][case % len(makers)]
    return name, makers[name]


# Images.


def png(width: int, height: int, rows: bytes, *more: tuple[bytes, bytes], depth: int = 8, colour: int = 2) -> bytes:
    """A PNG whose compressed rows are ``rows``."""
    head = struct.pack(">IIBBBBB", width, height, depth, colour, 0, 0, 0)
    parts = [(b"IHDR", head), *more, (b"IDAT", rows), (b"IEND", b"")]
    made = (struct.pack(">I", len(d)) + k + d + struct.pack(">I", zlib.crc32(k + d)) for k, d in parts)
    return b"\x89PNG\r\n\x1a\n" + b"".join(made)


def zeros(size: int) -> bytes:
    """So many zeros, deflated: the same piece again and again."""
    packer = zlib.compressobj(9, wbits=-15)
    piece = packer.compress(bytes(2**20)) + packer.flush(zlib.Z_FULL_FLUSH)
    last = packer.compress(bytes(size % 2**20)) + packer.flush()
    return b"\x78\xda" + piece * (size // 2**20) + last + struct.pack(">I", size % 65_521 << 16 | 1)  # Adler-32


def picture(value: int = 0, kind: str = "PNG", **options: Any) -> bytes:
    """A small image as a person would have it."""
    import PIL.Image

    made = io.BytesIO()
    PIL.Image.fromarray(np.full((8, 8, 3), value, np.uint8)).save(made, kind, **options)
    return made.getvalue()


def several(kind: str) -> bytes:
    """An animation."""
    import PIL.Image

    made = io.BytesIO()
    frames = [PIL.Image.fromarray(np.full((8, 8, 3), value, np.uint8)) for value in range(0, 250, 10)]
    frames[0].save(made, kind, save_all=True, append_images=frames[1:])
    return made.getvalue()


EPS = b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 8 8\n%%EndComments\nshowpage\n%%EOF\n"
SVG = b"<svg xmlns='http://www.w3.org/2000/svg' width='8' height='8'><image href='file:///etc/passwd'/></svg>"
PPM = b"P6 8 8 255\n" + bytes(192)


def written(data: bytes) -> Callable[[Path], object]:
    """A maker of an image's bytes."""
    return lambda file: file.write_bytes(data)


def many(file: Path, count: int, data: bytes) -> None:
    """So many images."""
    for number in range(count):
        (file.parent / f"{number}.png").write_bytes(data)


IMAGES: Makers = {
    "huge and one bit deep": lambda f: f.write_bytes(png(13_000, 13_000, zeros(13_000 * 1626), depth=1, colour=0)),
    "huge palette": lambda f: f.write_bytes(
        png(13_000, 13_000, zeros(13_000 * 13_001), (b"PLTE", bytes(768)), colour=3)
    ),
    "huge RGB": lambda f: f.write_bytes(png(13_000, 13_000, zeros(13_000 * 39_001))),
    "a thousand large ones": lambda f: many(f, 60, png(5000, 5000, zeros(5000 * 15_001))),
    "huger than it is": lambda f: f.write_bytes(png(2**31 - 1, 2**31 - 1, zeros(100))),
    "more rows than declared": lambda f: f.write_bytes(png(8, 8, zeros(2**29))),
    "cut off": lambda f: f.write_bytes(picture()[:40]),
    "cut off in its data": lambda f: f.write_bytes(picture(3)[:-20]),
    "SVG": written(SVG),
    "EPS": written(EPS),
    "PPM": written(PPM),
    "HTML": written(b"<html>"),
    "empty": written(b""),
    "TIFF": lambda f: f.write_bytes(picture(0, "TIFF")),
    "an animated GIF": lambda f: f.write_bytes(several("GIF")),
    "an animated PNG": lambda f: f.write_bytes(several("PNG")),
    "an animated WebP": lambda f: f.write_bytes(several("WEBP")),
    "a bomb in iCCP": lambda f: f.write_bytes(png(8, 8, zeros(200), (b"iCCP", b"p\0\0" + zeros(2**30)))),
    "a bomb in zTXt": lambda f: f.write_bytes(png(8, 8, zeros(200), (b"zTXt", b"c\0\0" + zeros(2**30)))),
    "bombs in iTXt": lambda f: f.write_bytes(
        png(8, 8, zeros(200), *[(b"iTXt", b"c\0\1\0\0\0" + zeros(2**20 - 1))] * 80)
    ),
    "10,000 chunks": lambda f: f.write_bytes(png(8, 8, zeros(200), *[(b"tEXt", b"a\0b")] * 10_000)),
    "a link to a device": lambda f: f.symlink_to("/dev/zero"),
    "a link to a terminal": lambda f: f.symlink_to("/dev/stdin"),
    "a link to itself": lambda f: f.symlink_to(f),
    "a link out of the folder": lambda f: f.symlink_to("/etc/passwd"),
    "a pipe": os.mkfifo,
    "a folder": Path.mkdir,
    "a name with control signs": lambda f: (f.parent / "\x1b[2J\x1b]0;x\x07\n.png").write_bytes(b"x"),
    "a name that is no UTF-8": lambda f: (f.parent / "\udcff.png").write_bytes(b"x"),
    "100,000 files": lambda f: many(f, 100_000, picture()),
    "an array with code": lambda f: np.save(f.with_suffix(".npy"), np.array([{}]), allow_pickle=True),
    "an array of terabytes": lambda f: f.with_suffix(".npy").write_bytes(npy("|u1", (2**20, 2**20, 3), b"x")),
    "an array of too many": lambda f: f.with_suffix(".npy").write_bytes(npy("|u1", (10**30, 1, 1), b"x")),
    "an array of a negative size": lambda f: f.with_suffix(".npy").write_bytes(npy("|u1", (-1, 8, 3), b"x")),
    "an array of no header": lambda f: f.with_suffix(".npy").write_bytes(b"\x93NUMPY\x01\x00\xff\xff{"),
    "bad EXIF": lambda f: f.with_suffix(".jpg").write_bytes(
        picture(0, "JPEG", exif=b"Exif\0\0MM\0*\xff\xff\xff\xff" + b"x" * 99)
    ),
    "a malformed MPO": lambda f: f.with_suffix(".jpg").write_bytes(
        picture(0, "JPEG").replace(b"\xff\xdb", b"\xff\xe2\0\x0aMPF\0xxxx\xff\xdb", 1)
    ),
    "a BMP of compressed lies": lambda f: f.with_suffix(".bmp").write_bytes(
        b"BM" + struct.pack("<IHHIIiiHHIIiiII", 99, 0, 0, 54, 40, 30_000, 30_000, 1, 8, 1, 9, 0, 0, 0, 0) + bytes(2000)
    ),
}


def images(box: Any, rng: Rng, case: int) -> Made:
    """A folder of images with a hostile one in a place of its own or of a good one."""
    folder: Path = box.case / "goal"
    for number, kind in enumerate(("positive", "negative", "unlabelled")):
        (folder / kind).mkdir(parents=True)
        for more in range(3):
            (folder / kind / f"good-{more}.png").write_bytes(picture(10 * number + more))
    changed = case >= len(IMAGES) and rng.random() < 0.6
    if changed:
        kind = rng.choice(("PNG", "JPEG", "GIF", "WEBP", "BMP"))
        name = f"changed {kind}"
        (folder / "negative" / f"x.{kind.lower()}").write_bytes(bytes_changed(picture(0, kind), rng))
    else:
        name, make = chosen(IMAGES, case)
        place = rng.choice(("positive", "negative", "unlabelled"))
        if rng.random() < 0.3:
            shutil.rmtree(folder / place)
            (folder / place).mkdir()
        make(folder / place / "0.png")
    return Made(name, size_of(folder), imported(box, folder))


def imported(box: Any, source: Path, *more: object) -> list[list[object]]:
    """What reads own states."""
    return [["import", source, "--out", box.case / "made.h5", *more]]


# Arrays.


def npy(dtype: str, shape: tuple[int, ...], data: bytes, header: str = "") -> bytes:
    """An array file whose header says what it likes."""
    text = (header or f"{{'descr': '{dtype}', 'fortran_order': False, 'shape': {shape}, }}").encode() + b"\n"
    return b"\x93NUMPY\x02\0" + struct.pack("<I", len(text)) + text + data


def good(**changed: bytes) -> dict[str, bytes]:
    """The members of an honest ``.npz`` file."""
    arrays: dict[str, Any] = {
        "observations": np.arange(20 * 60, dtype=np.uint16).astype(np.uint8).reshape(20, *SHAPE),
        "labels": np.arange(20) % 2,
        "unlabelled": np.full((6, *SHAPE), 7, np.uint8),
    }
    made = {}
    for name, values in arrays.items():
        buffer = io.BytesIO()
        np.save(buffer, values)
        made[f"{name}.npy"] = buffer.getvalue()
    return made | changed


def zipped(members: dict[str, bytes], method: int = zipfile.ZIP_DEFLATED) -> bytes:
    """Files in a zip file."""
    made = io.BytesIO()
    with zipfile.ZipFile(made, "w", method) as archive:
        for name, data in members.items():
            archive.writestr(name, data)
    return made.getvalue()


def bomb(size: int, method: int) -> bytes:
    """A zip file whose unlabelled states are ``size`` zeros."""
    made = io.BytesIO()
    with zipfile.ZipFile(made, "w", method) as archive:
        for name, data in good().items():
            if name != "unlabelled.npy":
                archive.writestr(name, data)
        with archive.open("unlabelled.npy", "w", force_zip64=True) as member:
            member.write(npy("|u1", (size // 60, *SHAPE), b""))
            for _ in range(0, size // 60 * 60, 60 * 2**18):
                member.write(bytes(60 * 2**18))
    return made.getvalue()


def with_flag(data: bytes, offset: int, value: int, local: int) -> bytes:
    """A zip file with a field of 16 bits changed in every entry of its directory, and in the local heads."""
    changed = bytearray(data)
    for mark, place in ((b"PK\x01\x02", offset), (b"PK\x03\x04", local)):
        at = changed.find(mark)
        while at >= 0:
            struct.pack_into("<H", changed, at + place, value)
            at = changed.find(mark, at + 4)
    return bytes(changed)


def declared(data: bytes, size: int) -> bytes:
    """A zip file whose directory says that each entry has ``size`` bytes."""
    changed = bytearray(data)
    at = changed.find(b"PK\x01\x02")
    while at >= 0:
        struct.pack_into("<I", changed, at + 24, size)
        at = changed.find(b"PK\x01\x02", at + 4)
    return bytes(changed)


def pickled() -> bytes:
    """An array of Python objects, which would be code."""
    made = io.BytesIO()
    np.save(made, np.array([{}]), allow_pickle=True)
    return made.getvalue()


U = "unlabelled.npy"
ARRAYS: Makers = {
    "pickled": lambda f: f.write_bytes(zipped(good(**{U: pickled()}))),
    "a pickle": written(b"\x80\x04\x95\x10\0\0\0\0\0\0\0\x8c\x02os\x8c\x06system\x93."),
    "a bomb of deflate": lambda f: f.write_bytes(bomb(250 * 2**20, zipfile.ZIP_DEFLATED)),
    "a bomb of bzip2": lambda f: f.write_bytes(bomb(3 * 2**30, zipfile.ZIP_BZIP2)),
    "a bomb of LZMA": lambda f: f.write_bytes(bomb(2**28, zipfile.ZIP_LZMA)),
    "terabytes in a header": lambda f: f.write_bytes(zipped(good(**{U: npy("|u1", (2**40, *SHAPE), b"x")}))),
    "gigabytes in a header": lambda f: f.write_bytes(zipped(good(**{U: npy("|u1", (2**27, *SHAPE), b"x")}))),
    "too many in a header": lambda f: f.write_bytes(zipped(good(**{U: npy("|u1", (10**30,), b"x")}))),
    "an overflowing header": lambda f: f.write_bytes(zipped(good(**{U: npy("|u1", (2**32, 2**32), b"x")}))),
    "a negative size": lambda f: f.write_bytes(zipped(good(**{U: npy("|u1", (-1, *SHAPE), b"x")}))),
    "elements of gigabytes": lambda f: f.write_bytes(zipped(good(**{U: npy("|V2000000000", (4,), b"x")}))),
    "elements of nothing": lambda f: f.write_bytes(zipped(good(**{U: npy("|V0", (2**50,), b"x")}))),
    "a deep header": lambda f: f.write_bytes(zipped(good(**{U: npy("", (), b"", "(" * 9000)}))),
    "a header of code": lambda f: f.write_bytes(zipped(good(**{U: npy("", (), b"", "__import__('os').abort()")}))),
    "a header that is no text": lambda f: f.write_bytes(zipped(good(**{U: npy("", (), b"", "\ud7ff\0'")}))),
    "a header without a shape": lambda f: f.write_bytes(zipped(good(**{U: npy("", (), b"", "{'descr': '|u1'}")}))),
    "a shape of texts": lambda f: f.write_bytes(
        zipped(good(**{U: npy("", (), b"", "{'descr': '|u1', 'fortran_order': False, 'shape': ('a',)}")}))
    ),
    "records": lambda f: f.write_bytes(
        zipped(good(**{U: npy("", (), b"x" * 9, "{'descr': [('a', '<i8')], 'fortran_order': False, 'shape': (1,)}")}))
    ),
    "names that climb": lambda f: f.write_bytes(zipped(good(**{"../../outside/x.npy": b"x", "/tmp/x": b"y"}))),
    "a name twice": lambda f: f.write_bytes(zipped(good(observations=good()[U]))),
    "a name with control signs": lambda f: f.write_bytes(zipped(good(**{"\x1b[2J\n.npy": b"x"}))),
    "a long name": lambda f: f.write_bytes(zipped(good(**{"x" * 60_000: b"x"}))),
    "encrypted": lambda f: f.write_bytes(with_flag(zipped(good()), 8, 1, 6)),
    "of a method that nobody knows": lambda f: f.write_bytes(with_flag(zipped(good()), 10, 99, 8)),
    "of a later zip version": lambda f: f.write_bytes(with_flag(zipped(good()), 6, 255, 4)),
    "smaller than it says": lambda f: f.write_bytes(declared(zipped(good()), 2**31)),
    "larger than it says": lambda f: f.write_bytes(declared(zipped(good()), 10)),
    "an array with a zip file behind it": lambda f: f.write_bytes(good()[U] + zipped(good())),
    "a zip file behind rubbish": lambda f: f.write_bytes(b"x" * 1000 + zipped(good())),
    "60,000 entries": lambda f: f.write_bytes(zipped(good(**{f"{n}.npy": b"" for n in range(60_000)}))),
    "a damaged stream": lambda f: f.write_bytes(zipped(good()).replace(b"\xed", b"\x07").replace(b"\x63", b"\xff")),
    "a damaged stream of LZMA": lambda f: f.write_bytes(zipped(good(), zipfile.ZIP_LZMA).replace(b"\0\0", b"\xff\x01")),
    "a damaged stream of bzip2": lambda f: f.write_bytes(zipped(good(), zipfile.ZIP_BZIP2).replace(b"h9", b"h3")),
    "a pipe": os.mkfifo,
    "a device": lambda f: f.symlink_to("/dev/zero"),
    "sub-goals that climb": lambda f: np.savez(f, **loaded(), sub_goals=np.array(["../../outside/x"])),
    "sub-goals of control signs": lambda f: np.savez(f, **loaded(), sub_goals=np.array(["\x1b[2J"])),
    "sub-goals that are no text": lambda f: np.savez(f, **loaded(), sub_goals=np.array(["\ud800"])),
    "a name of the file that is no UTF-8": lambda f: renamed(f),
    "labels that are NaN": lambda f: np.savez(f, **loaded(labels=np.full(20, np.nan))),
    "labels of dates": lambda f: np.savez(f, **loaded(labels=np.zeros(20, "M8[s]"))),
    "labels of 10^5 sub-goals": lambda f: np.savez_compressed(f, **loaded(labels=np.zeros((20, 10**5), np.uint8))),
    "observations of no size": lambda f: np.savez(f, **loaded(observations=np.zeros((20, 0, 5, 3), np.uint8))),
    "observations of 2^20 a side": lambda f: np.savez_compressed(
        f, **loaded(observations=np.zeros((20, 2**20, 1, 1), np.uint8), unlabelled=np.zeros((2, 2**20, 1, 1), np.uint8))
    ),
    "big-endian": lambda f: np.savez(f, **loaded(observations=np.zeros((20, *SHAPE), ">u4"))),
}


def loaded(**changed: Any) -> dict[str, Any]:
    """The arrays of an honest file."""
    return {name[:-4]: np.load(io.BytesIO(data)) for name, data in good().items()} | changed


def renamed(file: Path) -> None:
    """An honest file whose name is no UTF-8."""
    file.with_name("own\udcff.npz").write_bytes(zipped(good()))


def arrays(box: Any, rng: Rng, case: int) -> Made:
    """A ``.npz`` file, or a folder of ``.npy`` files."""
    file: Path = box.case / "own.npz"
    if case >= len(ARRAYS) and rng.random() < 0.6:
        name = "changed"
        file.write_bytes(bytes_changed(zipped(good(), rng.choice((0, 8, 12, 14))), rng))
        if rng.random() < 0.3:
            name, folder = "changed, unpacked", box.case / "own"
            folder.mkdir()
            for member, data in good().items():
                (folder / member).write_bytes(bytes_changed(data, rng))
            return Made(name, size_of(folder), imported(box, folder))
    else:
        name, make = chosen(ARRAYS, case)
        make(file)
    file = next(path for path in box.case.iterdir() if path.name.startswith("own"))
    return Made(
        name,
        file.lstat().st_size,
        imported(box, file, "--sub-goal", "one") if "sub" not in name else imported(box, file),
    )


# Minari.


def episodes(file: Any, count: int = 5) -> None:
    """Honest episodes."""
    for number in range(count):
        values = np.arange(10 * 60, dtype=np.uint16).reshape(10, *SHAPE).astype(np.uint8) | number + 1
        values[::2] = 0  # in these the sub-goal does not hold, says numpy.any
        file[f"episode_{number}/observations"] = values


def replaced(name: str, make: Callable[[Any, str], object]) -> Callable[[Any], object]:
    """Something else in place of a part of an HDF5 file."""

    def change(file: Any) -> None:
        if name in file:
            del file[name]
        make(file, name)

    return change


def space(bound: object) -> str:
    """A space as Minari tells it."""
    return json.dumps({"type": "Box", "dtype": "uint8", "shape": bound})


def linked(file: Any, count: int) -> None:
    """One episode of 200 MB, 200 kB on the disk, under many names."""
    states = np.zeros((3_500_000, *SHAPE), "u1")
    file.create_dataset("big", data=states, chunks=(50_000, *SHAPE), compression="gzip")
    for number in range(10, count):
        file[f"episode_{number}/observations"] = file["big"]


def groups(file: Any, count: int, name: str = "episode_{}") -> None:
    """So many empty groups."""
    for number in range(10, count):
        file.create_group(name.format(number))


EPISODE = "episode_1/observations"
EPISODES: dict[str, Callable[[Any], object]] = {
    "of other shapes": replaced(EPISODE, lambda f, n: f.create_dataset(n, data=np.zeros((10, 3, 3, 3), "u1"))),
    "of other ranks": replaced(EPISODE, lambda f, n: f.create_dataset(n, data=np.zeros((10, 4), "u1"))),
    "one number": replaced(EPISODE, lambda f, n: f.create_dataset(n, data=np.uint8(3))),
    "nothing": replaced(EPISODE, lambda f, n: f.create_dataset(n, data=h5py.Empty("u1"))),
    "a group": replaced(EPISODE, lambda f, n: f.create_group(f"{n}/x")),
    "dictionaries": replaced("episode_0/observations", lambda f, n: f.create_group(f"{n}/image")),
    "missing": replaced(EPISODE, lambda f, n: None),
    "links": replaced(EPISODE, lambda f, n: f.__setitem__(n, h5py.SoftLink("/episode_0/observations"))),
    "texts": replaced(EPISODE, lambda f, n: f.create_dataset(n, data=["a"] * 10)),
    "NaN": replaced(EPISODE, lambda f, n: f.create_dataset(n, data=np.full((10, *SHAPE), np.nan))),
    "half floats": replaced(EPISODE, lambda f, n: f.create_dataset(n, data=np.ones((10, *SHAPE), "f2"))),
    "terabytes": replaced(EPISODE, lambda f, n: f.create_dataset(n, shape=(2**40, *SHAPE), dtype="u1")),
    "one, 1,000 times": lambda f: linked(f, 1010),
    "100,000 of them": lambda f: groups(f, 100_000),
    "an odd number": lambda f: f.__setitem__("episode_²/observations", f[EPISODE]),
    "a long number": lambda f: f.__setitem__(f"episode_{'9' * 190}/observations", f[EPISODE]),
    "a cycle": lambda f: f.__setitem__("episode_9", f["/"]),
    "none": lambda f: [f.__delitem__(name) for name in [*f]],
    "of no states": lambda f: [replaced(f"episode_{n}/observations", _empty)(f) for n in range(5)],
}
METADATA: dict[str, object] = {
    "a list": [],
    "a text": "x",
    "another format": {"data_format": "arrow"},
    "a format that is a list": {"data_format": [1] * 1000},
    "a format of control signs": {"data_format": "\x1b[2J\n"},
    "a space that is a number": {"observation_space": 3},
    "a space of texts": {"observation_space": space("abc")},
    "a space of lists": {"observation_space": space([[1], {}, 3])},
    "a deep space": {"observation_space": "[" * 10**6},
    "a space in a space": {"observation_space": json.dumps({"subspaces": []})},
}


def _empty(file: Any, name: str) -> None:
    file.create_dataset(name, data=np.zeros((0, *SHAPE), "u1"))


def minari(box: Any, rng: Rng, case: int) -> Made:
    """A Minari dataset: hostile metadata, episodes that are not what they should be, or a changed file."""
    folder: Path = box.case / "episodes"
    (folder / "data").mkdir(parents=True)
    main, about = folder / "data" / "main_data.hdf5", folder / "data" / "metadata.json"
    about.write_text(json.dumps({"data_format": "hdf5", "observation_space": space(list(SHAPE))}))
    with h5py.File(main, "w") as file:
        episodes(file)
    kinds = [*EPISODES, *METADATA]
    name = kinds[case] if case < len(kinds) else rng.choice(("changed", "a structure", "metadata"))
    if name in EPISODES:
        with h5py.File(main, "a") as file:
            EPISODES[name](file)
    elif name in METADATA:
        about.write_text(json.dumps(METADATA[name]))
    elif name == "changed":
        main.write_bytes(bytes_changed(main.read_bytes(), rng))
    elif name == "metadata":
        name, text = hostile_json(about.read_bytes(), rng, rng.randrange(100))
        about.write_bytes(text)
    else:
        name, change = rng.choice([*STRUCTURES.items()])
        with h5py.File(main, "a") as file:
            del file[EPISODE]
            change(file, EPISODE, box.outside / "secret")
    return Made(name, size_of(folder), imported(box, folder, "--label", "one=numpy:any", "--key", ""))


# What libraries would read in the current folder, in the home folder, or where the environment leads.

SETTINGS = b"text.usetex: True\ntext.latex.preamble: \\input{/etc/passwd}\nfigure.dpi: 100000\nsavefig.bbox: tight\n"
LYING: Makers = {
    "settings": lambda f: f.write_bytes(SETTINGS),
    "no text": lambda f: f.write_bytes(bytes(range(256)) * 99),
    "nothing": lambda f: f.touch(),
    "a pipe": os.mkfifo,
    "a folder": Path.mkdir,
    "a device": lambda f: f.symlink_to("/dev/zero"),
    "a file of the kernel": lambda f: f.symlink_to("/proc/self/pagemap"),
    "a link to itself": lambda f: f.symlink_to(f),
}
LIES = (
    *(f"{place}matplotlibrc" for place in ("", ".matplotlib/", ".config/matplotlib/")),
    ".config/matplotlib/stylelib/a.mplstyle", "libc.so.6", "libm.so.6", "libstdc++.so.6", "libgcc_s.so.1",
    "libpython3.11.so.1.0", "numpy.py", "matplotlib.py", "sitecustomize.py", "usercustomize.py", "setup.cfg",
    "pyproject.toml", "pydistutils.cfg", ".env", "ale.cfg", "fonts.conf", "arrays.h5", "terminations.h5", "visited.h5",
    "manifest.json", "sweep.json", "hypogoal.toml", "demo.toml",
)  # fmt: skip


def around(folder: Path, rng: Rng) -> dict[str, str]:
    """Fill a folder, from which a command is started, and which is its home; returns its environment."""
    for name in rng.sample(LIES, rng.choice((3, 8, len(LIES)))):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        if not os.path.lexists(folder / name):
            rng.choice([*LYING.values()])(folder / name)
    places = {"MATPLOTLIBRC": str(folder), "MPLCONFIGDIR": str(folder / ".config/matplotlib")}
    places |= {"MPLBACKEND": rng.choice(("nonsense", "module://no", "WebAgg", "TkAgg", "svg"))}
    return {"HOME": str(folder), **{name: places[name] for name in rng.sample([*places], rng.randrange(4))}}


# HDF5.

Change = Callable[[Any, str, Path], object]


def external(file: Any, name: str, secret: Path) -> None:
    """Values that lie in another file."""
    file.create_dataset(name, shape=(7, *SHAPE), dtype="u1", external=[(str(secret), 0, h5py.h5f.UNLIMITED)])


def virtual(file: Any, name: str, secret: Path) -> None:
    """Values that are views of another file, or of this one."""
    layout = h5py.VirtualLayout(shape=(7, *SHAPE), dtype="u1")
    layout[...] = h5py.VirtualSource(str(secret), "x", shape=(7, *SHAPE))
    file.create_virtual_dataset(name, layout)


def itself(file: Any, name: str, _secret: Path) -> None:
    """A view of itself."""
    layout = h5py.VirtualLayout(shape=(7, *SHAPE), dtype="u1")
    layout[...] = h5py.VirtualSource(".", name, shape=(7, *SHAPE))
    file.create_virtual_dataset(name, layout)


def cycles(file: Any, name: str, _secret: Path) -> None:
    """Groups that hold each other, ten times each."""
    place = file.require_group(name.rpartition("/")[0])
    for number in range(10):
        place[f"again-{number}"] = file["/"]


def small_chunks(file: Any, name: str, _secret: Path) -> None:
    """Chunks of one byte each, of which few are there."""
    made = file.create_dataset(
        name, shape=(16_000_000,), chunks=(1,), dtype="u1", compression="gzip", fletcher32=True, fillvalue=3
    )
    made[:16_000] = 1


def one_byte_chunks(file: Any, name: str, _secret: Path) -> None:
    """Chunks of one byte each that are all there."""
    file.create_dataset(name, data=np.ones(60_000, "u1"), chunks=(1,))


def lying_chunks(file: Any, name: str, _secret: Path) -> None:
    """A million chunks, one of which is there; the index says that it is as large as all of them."""
    made = file.create_dataset(name, shape=(2**20, 1, 1, 1), dtype="u1", chunks=(1, 1, 1, 1), shuffle=True)
    made.id.write_direct_chunk((0, 0, 0, 0), bytes(2**20))


def huge_chunk(file: Any, name: str, _secret: Path) -> None:
    """A few states in a chunk of a gigabyte."""
    file.create_dataset(name, data=np.zeros((7, *SHAPE), "u1"), chunks=(2**24, *SHAPE), maxshape=(None, *SHAPE))


def committed(file: Any, name: str, _secret: Path) -> None:
    """A type that has a name of its own."""
    file["named"] = np.dtype("u1")
    file.create_dataset(name, shape=(7, *SHAPE), dtype=file["named"])


def typed(dtype: Any) -> Change:
    """Another type."""
    return lambda file, name, secret: file.create_dataset(name, shape=(7, *SHAPE), dtype=dtype)


def put(file: Any, name: str, kind: Any, settings: Any = None) -> None:
    """A dataset of a type, and with settings, that h5py's own way does not make."""
    made = h5py.h5d.create(file.id, None, kind, h5py.h5s.create_simple((7, *SHAPE)), settings)
    h5py.h5o.link(made, file.id, name.encode())


def attributed(make: Callable[[Any], Any]) -> Change:
    """An attribute of the root, and of the dataset, that is something else."""

    def change(file: Any, name: str, _secret: Path) -> None:
        file.create_dataset(name, data=np.zeros((7, *SHAPE), "u1"))
        for place in (file, file[name]):
            for key in [*file.attrs][:3]:
                place.attrs.pop(key, None)
                place.attrs[key] = make(file)

    return change


def filtered(number: int) -> Change:
    """A filter that this library does not have, told to be optional."""

    def change(file: Any, name: str, _secret: Path) -> None:
        settings = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        settings.set_chunk((7, *SHAPE))
        settings.set_filter(number, h5py.h5z.FLAG_OPTIONAL, (1, 2, 3))
        put(file, name, h5py.h5t.STD_U8LE, settings)

    return change


STRUCTURES: dict[str, Change] = {
    "external link": lambda f, n, s: f.__setitem__(n, h5py.ExternalLink(str(s), "/x")),
    "external link to a device": lambda f, n, s: f.__setitem__(n, h5py.ExternalLink("/dev/zero", "/")),
    "external link to itself": lambda f, n, s: f.__setitem__(n, h5py.ExternalLink(f.filename, n)),
    "soft link to itself": lambda f, n, s: f.__setitem__(n, h5py.SoftLink(n)),
    "external storage": external,
    "virtual": virtual,
    "virtual, of itself": itself,
    "object references": typed(h5py.ref_dtype),
    "region references": typed(h5py.regionref_dtype),
    "a compound": typed([("a", "u1"), ("b", "f8")]),
    "an enumeration": typed(h5py.enum_dtype({"a": 0, "b": 1}, basetype="u1")),
    "opaque": typed(h5py.opaque_dtype("M8[s]")),
    "arrays": typed(np.dtype(("u1", (3, 2)))),
    "of variable length": typed(h5py.vlen_dtype(np.uint8)),
    "texts": typed(h5py.string_dtype()),
    "a committed type": committed,
    "times": lambda f, n, s: put(f, n, h5py.h5t.UNIX_D32LE),
    "bit fields": lambda f, n, s: put(f, n, h5py.h5t.STD_B8LE),
    "complex": typed("c16"),
    "floats of 16 bits": typed("f2"),
    "the wrong end first": typed(">u8"),
    "attributes that are references": attributed(lambda f: f.ref),
    "attributes that are regions": attributed(lambda f: f["/"].ref),
    "attributes of variable length": attributed(lambda f: "x" * 60_000),
    "attributes that are nothing": attributed(lambda f: h5py.Empty("f8")),
    "attributes that are compounds": attributed(lambda f: np.array([(1, 2)], dtype=[("a", "i4"), ("b", "i4")])),
    "hard links in cycles": cycles,
    "100,000 groups": lambda f, n, s: groups(f, 100_010, "g{}"),
    "groups in groups": lambda f, n, s: f.create_group("a/" * 1000 + n),
    "chunks of one byte, few there": small_chunks,
    "chunks of one byte": one_byte_chunks,
    "chunks that are not there, says no index": lying_chunks,
    "a chunk of a gigabyte": huge_chunk,
    "a fill value that is not there": lambda f, n, s: f.create_dataset(n, shape=(2**30,), dtype="u1", fillvalue=7),
    "a filter nobody has": filtered(4242),
    "a filter that loads a plugin": filtered(32015),
    "no dimensions": lambda f, n, s: f.create_dataset(n, data=np.uint8(3)),
    "32 dimensions": lambda f, n, s: f.create_dataset(n, shape=(1,) * 32, dtype="u1"),
}


def _block(path: Path, size: int) -> None:
    path.write_bytes(b"#!/bin/sh\n".ljust(size, b"\0") + path.read_bytes())


def _poke(path: Path, at: int, value: bytes) -> None:
    data = bytearray(path.read_bytes())
    data[at : at + len(value)] = value
    path.write_bytes(data)


def _swmr(path: Path) -> None:
    """The same in a file of the latest format, which a writer has not closed."""
    copy = path.with_name("copy")
    with h5py.File(path) as old, h5py.File(copy, "w", libver="latest") as new:
        for name in old:
            old.copy(name, new)
        for name, value in old.attrs.items():
            new.attrs.create(name, value, dtype=old.attrs.get_id(name).dtype)
    copy.replace(path)
    _poke(path, 11, b"\x05")


BYTES: Makers = {
    "a user block": lambda f: _block(f, 512),
    "a user block of 2^20": lambda f: _block(f, 2**20),
    "a user block of no power of two": lambda f: _block(f, 513),
    "SWMR flags": _swmr,
    "an earlier superblock version": lambda f: _poke(f, 8, b"\x09"),
    "offsets of 3 bytes": lambda f: _poke(f, 13, b"\x03"),
    "an end beyond the file": lambda f: _poke(f, 40, b"\xff" * 7 + b"\0"),
    "a root beyond the file": lambda f: _poke(f, 64, b"\xff" * 6 + b"\0\0"),
    "two files in one": lambda f: f.write_bytes(f.read_bytes() * 2),
    "cut in half": lambda f: f.write_bytes(f.read_bytes()[: f.stat().st_size // 2]),
}


def _hdf5(path: Path, name: str, box: Any, rng: Rng, case: int) -> str:
    """Make an HDF5 file hostile; returns how."""
    kinds = [*STRUCTURES, *BYTES]
    kind = kinds[case % len(kinds)]
    if kind in BYTES:
        BYTES[kind](path)
    else:
        with h5py.File(path, "a") as file:
            if name in file and not kind.startswith(("100,000", "groups", "hard")):
                del file[name]
            STRUCTURES[kind](file, name, box.outside / "secret")
    return kind


def data_files(box: Any, rng: Rng, case: int) -> Made:
    """A data file."""
    path: Path = box.case / "data.h5"
    shutil.copy(box.ready("data") / "data.h5", path)
    with h5py.File(path) as file:
        places: list[str] = []
        file.visititems(lambda name, item: places.append(name) if isinstance(item, h5py.Dataset) else None)
    place = rng.choice(sorted(places))
    kind = _hdf5(path, place, box, rng, case)
    copy = box.case / "made-again.h5"
    shutil.copy(path, copy)
    few = ("--set", "steps=2", "--set", "workers=1", "--set", "members=2", "-q")
    commands: list[list[object]] = [
        ["verify", path],
        ["show", path],
        ["train-ensemble", path, "--out", box.case / "made", *few],
        ["export", path, "--out", box.case / "made.npz"],
    ]
    return Made(f"{kind} at {place}", size_of(path), commands)


def stored_arrays(box: Any, rng: Rng, case: int) -> Made:
    """An HDF5 file within an artefact of a whole run, whose manifest agrees with it."""
    where, name, place = rng.choice(
        (("evaluation", "arrays.h5", ""), ("meta", "terminations.h5", "0"), ("options", "visited.h5", "observations"))
    )
    folder: Path = box.case / "run"
    shutil.copytree(box.ready(*TRAINED, evaluated=True), folder)
    path = folder / where / name
    with h5py.File(path) as file:
        places: list[str] = []
        file.visititems(lambda name, item: places.append(name) if isinstance(item, h5py.Dataset) else None)
    kind = _hdf5(path, place if place in places else rng.choice(sorted(places) or ["x"]), box, rng, case)
    resigned(folder / where, name)
    commands: list[list[object]] = [["verify", folder / where], ["show", folder / where]]
    if where == "evaluation":
        shutil.rmtree(folder / "report")
        commands.append(["report", folder, "-q"])
    else:
        commands.append(["evaluate", folder, "--out", box.case / "made", "-q"])
    return Made(f"{kind} in {where}/{name}", size_of(path), commands, ("made", ".made", "run/report", "run/.report"))


# Texts.


def hostile_json(text: bytes, rng: Rng, case: int, most: int = 2**20) -> tuple[str, bytes]:
    """JSON that is too deep, too wide, ambiguous or not text at all, made of an honest text; and how.

    Args:
        text: an object, or several of them on a line each.
        rng: which key or line.
        case: which of the kinds.
        most: about how many bytes.
    """
    lines = text.splitlines(keepends=True) if text.count(b"\n{") else [text]
    at = rng.randrange(len(lines))
    tree = json.loads(lines[at])
    key = rng.choice(sorted(tree)) if isinstance(tree, dict) and tree else "x"
    rest = {name: value for name, value in tree.items() if name != key} if isinstance(tree, dict) else {}
    head = json.dumps(rest).rstrip("}").encode() + (b", " if rest else b"") + json.dumps(key).encode() + b": "
    deep = most // 2
    kinds: dict[str, Callable[[], bytes]] = {
        "deep lists": lambda: head + b"[" * deep + b"]" * deep + b"}",
        "deep lists, open": lambda: b"[" * most,
        "deep objects": lambda: head + b'{"":' * (most // 5) + b"0" + b"}" * (most // 5) + b"}",
        "deep, but less": lambda: head + b"[" * 900 + b"]" * 900 + b"}",
        "many keys": lambda: head + b"{" + b",".join(b'"%d":0' % n for n in range(most // 10)) + b"}}",
        "many keys beside": lambda: head + b"0," + b",".join(b'"%d":0' % n for n in range(most // 10)) + b"}",
        "many empty lists": lambda: head + b"[" + b"[]," * (most // 3) + b"0]}",
        "the same key": lambda: (
            head
            + json.dumps(tree.get(key) if isinstance(tree, dict) else 0).encode()
            + b"".join(b',"%s": %s' % (json.dumps(key)[1:-1].encode(), v) for v in (b"0", b"{}", b'"x"', b"null"))
            + b"}"
        ),
        "10^5 digits": lambda: head + b"9" * 10**5 + b"}",
        "10^5 digits after the point": lambda: head + b"0." + b"9" * 10**5 + b"}",
        "an exponent": lambda: head + b"1e" + b"9" * 10**5 + b"}",
        "4,000 digits": lambda: head + b"9" * 4000 + b"}",
        "half a surrogate pair": lambda: head + b'"\\ud800"}',
        "half a surrogate pair for a key": lambda: head + b'{"\\udc00": 1}}',
        "a BOM": lambda: b"\xef\xbb\xbf" + lines[at],
        "UTF-16": lambda: lines[at].decode().encode("utf-16"),
        "UTF-32": lambda: lines[at].decode().encode("utf-32"),
        "NUL bytes": lambda: bytes(len(lines[at])),
        "a NUL byte": lambda: head + b'"a\0b"}',
        "a NUL in a text": lambda: head + b'"a\\u0000b"}',
        "a long text": lambda: head + b'"' + b"x" * most + b'"}',
        "a long key": lambda: head + b'{"' + b"x" * most + b'": 1}}',
        "control signs": lambda: head + b'"\\u001b[2J\\u001b]0;x\\u0007\\r\\n"}',
        "lines of Unicode": lambda: head + '"a\u2028b\u0085c"}'.encode(),
        "no UTF-8": lambda: head + b'"\xff\xfe"}',
        "nothing": lambda: b"",
        "spaces": lambda: b" " * most,
        "null": lambda: b"null",
        "a number": lambda: b"7",
        "NaN": lambda: head + b"NaN}",
        "Infinity": lambda: head + b"-Infinity}",
        "minus zero": lambda: head + b"-0}",
        "a list in its place": lambda: head + b"[]}",
        "an object in its place": lambda: head + b"{}}",
        "true in its place": lambda: head + b"true}",
        "10^7 lines": lambda: b"{}\n" * (most // 3),
    }
    kind = [*kinds][case % len(kinds)]
    lines[at] = kinds[kind]() + (b"\n" if text.endswith(b"\n") else b"")
    return f"{kind} at {key}", b"".join(lines)


def _sweep(box: Any) -> Path:
    """The folder of a sweep that was begun, with the records of its first cell."""
    from hypogoal.experiments.planning import make_plan
    from hypogoal.experiments.records import write_plan
    from hypogoal.experiments.toml_file import read_toml

    run: Path = box.case / "sweep"
    own = box.case / "own.toml"
    own.write_text(OWN, encoding="utf-8")
    write_plan(run, make_plan(read_toml(own), run))
    (run / "logs").mkdir()
    (run / "logs" / "data.log").write_text("started\n")
    (run / "logs" / "data.json").write_text(
        json.dumps({"attempts": 1, "seconds": 2.0, "code": 2, "started": 0.0, "host": "here"})
    )
    (run / "slurm").mkdir()
    (run / "slurm" / "jobs.json").write_text(json.dumps([{"id": "1", "cells": ["data"]}]))
    (run / "run.json").write_text(json.dumps({"finished": True}))
    return run


def texts(box: Any, rng: Rng, case: int) -> Made:
    """A JSON file of a run, of a sweep or of what was begun."""
    target = ("manifest", "metrics", "sweep.json", "logs/data.json", "run.json", "slurm/jobs.json", "begun", "log",
              "layout")[case % 9]  # fmt: skip
    most = 2**20 if rng.random() < 0.7 else 15 * 2**20
    kind = case // 9 + rng.randrange(40)
    if target == "begun":
        out: Path = box.case / "made"
        shutil.copytree(box.ready("ppo") / "ppo", box.case / ".made.partial" / "files")
        (box.case / ".made.partial" / "checkpoint").mkdir()
        (box.case / ".made.partial" / "checkpoint" / "stage.safetensors").write_bytes(b"x")
        path = box.case / ".made.partial" / "begun.json"
        path.write_text(json.dumps({"identity": {"kind": "baseline", "config": {}}, "command": ["hypogoal"]}))
        commands = [["train-baseline", "doorkey", "--out", out, "--set", "steps=10", "-q", "--resume"]]
    elif target in ("manifest", "metrics", "log", "layout"):
        run = box.case / "run"
        shutil.copytree(box.ready(*TRAINED, evaluated=True), run)
        part, name = {
            "manifest": (rng.choice(("ensemble", "options", "meta", "ppo", "evaluation")), "manifest.json"),
            "metrics": ("evaluation", "metrics.json"),
            "log": (rng.choice(("ensemble", "meta")), "metrics.jsonl"),
            "layout": ("meta", "layout.json"),
        }[target]
        path = run / part / name
        commands = [["verify", run / part], ["show", run / part], ["show", run]]
        if part == "evaluation":
            shutil.rmtree(run / "report")
            commands += [["report", run, "-q"]]
        elif rng.random() < 0.5:
            commands += [["evaluate", run, "--out", box.case / "made", "-q"]]
    else:
        run = _sweep(box)
        path = run / target
        commands = [
            ["sweep", "--out", run, "--status"],
            ["sweep", "--out", run, "--gather"],
            ["sweep", "--out", run, "--cancel"],
        ]
    name, data = hostile_json(path.read_bytes(), rng, kind, most)
    path.write_bytes(data)
    if target in ("metrics", "log", "layout"):
        resigned(path.parent, path.name)
    outputs = ("made", ".made", "run/report", "run/.report", "sweep/results.csv", "sweep/run.json")
    return Made(f"{name} in {target}", path.stat().st_size, commands, outputs)


def hostile_toml(tree: dict[str, Any], rng: Rng, case: int) -> tuple[str, bytes]:
    """TOML that is too deep, too wide, ambiguous or not text at all; and how."""
    honest = toml_of(tree, random.Random(1)).encode()
    many = 2**20
    kinds: dict[str, Callable[[], bytes]] = {
        "deep lists": lambda: b"x = " + b"[" * 10**5 + b"]" * 10**5,
        "deep tables": lambda: b"x = " + b"{a=" * 10**5 + b"1" + b"}" * 10**5,
        "a deep key": lambda: b"a." * 300_000 + b"a = 1",
        "a deep table": lambda: b"[" + b"a." * 300_000 + b"a]\nx = 1",
        "a deep key in a stage": lambda: honest + b"\n[run]\n" + b"a." * 300_000 + b"a = 1",
        "deep tables, many": lambda: b"".join(b"[" + b"a." * 500 + b"x%d]\n" % n for n in range(900)),
        "many keys": lambda: b"".join(b"k%d = 1\n" % n for n in range(80_000)),
        "many keys of a table": lambda: honest + b"".join(b"k%d = 1\n" % n for n in range(60_000)),
        "many tables": lambda: b"".join(b"[[x]]\n" for n in range(many // 6)),
        "many tables of a stage": lambda: b"".join(b"[run.k%d]\n" % n for n in range(60_000)),
        "the same key": lambda: honest + b"\nsteps = 1\nsteps = 2\n",
        "the same table": lambda: honest + b"\n[collect]\n[collect]\n",
        "10^5 digits": lambda: b"[collect]\nseed = " + b"9" * 10**5,
        "10^5 digits of hexadecimals": lambda: b"[run]\nlayout_seeds = [0x" + b"f" * 10**5 + b"]",
        "10^5 digits after the point": lambda: b"[train-meta]\nclip = 0." + b"9" * 10**5,
        "an exponent": lambda: b"[train-meta]\nclip = 1e" + b"9" * 10**4,
        "a date": lambda: b"[run]\nseeds = 9999-99-99T99:99:99Z",
        "half a surrogate pair": lambda: b'[collect]\nregime = "\\ud800"',
        "beyond Unicode": lambda: b'[collect]\nregime = "\\Uffffffff"',
        "control signs": lambda: b'[collect]\n"\\u001b[2J" = "\\u001b]0;x\\u0007"',
        "a BOM": lambda: b"\xef\xbb\xbf" + honest,
        "UTF-16": lambda: honest.decode().encode("utf-16"),
        "NUL bytes": lambda: bytes(len(honest)),
        "a NUL byte": lambda: honest + b"\0",
        "no UTF-8": lambda: honest + b'\n"\xff" = 1',
        "a long text": lambda: b'[collect]\nregime = "' + b"x" * (many - 100) + b'"',
        "a long key": lambda: b"[collect]\n" + b"x" * (many - 100) + b" = 1",
        "a long range": lambda: b'[run]\nlayout_seeds = "0-999999999999"',
        "larger than is read": lambda: b"#" * (many + 1),
        "a long comment": lambda: b"#" * (many - 10),
        "quotes": lambda: b"x = " + b"'" * (many - 100),
        "line ends": lambda: honest.replace(b"\n", b"\r"),
        "nothing": lambda: b"",
        "axes of many values": lambda: OWN.replace("210-211", "0-99999").encode(),
        "axes of all with all": lambda: OWN.replace("[0, 1]", '"0-9999"').replace("210-211", "0-9999").encode(),
        "ten axes": lambda: OWN.replace(
            "axes = {", "axes = { " + "".join(f"a{n} = '0-9', " for n in range(10)), 1
        ).replace('["seed"]', json.dumps(["seed", *(f"a{n}" for n in range(10))])).encode(),
        "a format of 10^4 digits": lambda: OWN.replace("format = 1", "format = " + "1" * 4000).encode(),
        "workers of 10^18": lambda: OWN.replace("workers = 2", f"workers = {10**18}").encode(),
        "names that climb": lambda: OWN.replace('"data"', '"../../outside/x"', 1).encode(),
        "names of control signs": lambda: OWN.replace('"data"', '"\\u001b[2J"', 1).encode(),
        "many cells": lambda: OWN.replace("]\n", "".join(
            f'  {{ name = "c{n}", command = "collect doorkey" }},\n' for n in range(10_000)) + "]\n").encode(),
        "a command of quotes": lambda: OWN.replace("collect doorkey", "collect doorkey '").encode(),
        "a command of 10^5 words": lambda: OWN.replace("collect doorkey", "collect doorkey" + " -q" * 10**5).encode(),
        "places within places": lambda: OWN.replace("{seed}", "{seed.__class__.__mro__}").encode(),
        "places of a thousand columns": lambda: OWN.replace("{seed}", "{seed:>9999999999}").encode(),
    }  # fmt: skip
    kind = [*kinds][case % len(kinds)]
    return kind, kinds[kind]()


def tables(box: Any, rng: Rng, case: int) -> Made:
    """A preset, and the same file as an experiment of one's own."""
    path: Path = box.case / "own.toml"
    kind, data = hostile_toml(PRESET if rng.random() < 0.5 else tomllib.loads(OWN), rng, case)
    path.write_bytes(data)
    commands: list[list[object]] = [
        ["sweep", path, "--out", box.case / "made", "--dry-run"],
        ["run", "doorkey", "--out", box.case / "made", "--preset", path, "--dry-run"],
        ["collect", "doorkey", "--out", box.case / "made.h5", "--preset", path, "--set", "heldout_layouts=1",
         "--set", "unlabelled_seeds=1", "-q"],
    ]  # fmt: skip
    return Made(kind, len(data), commands)
