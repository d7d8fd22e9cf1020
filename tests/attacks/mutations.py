"""Damage and malice for ``tests.attacks.fuzz``: bytes, JSON and TOML values, safetensors headers, HDF5 structures."""

from __future__ import annotations

import json
import random
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from hypogoal.data import fixed

Rng = random.Random
# Files that a system calls regular, and that never end, wait, or have another size than they say.
ENDLESS = ("/proc/self/pagemap", "/proc/kmsg", "/proc/self/mem", "/proc/kcore", "/sys/kernel/notes", "/dev/zero")
# Types of tensors, and how many bytes an element of each takes; those of four bits take half a one.
TYPES = {"F32": 4, "I64": 8, "F16": 2, "BF16": 2, "F64": 8, "C64": 8, "BOOL": 1, "U8": 1, "I8": 1, "I16": 2, "U16": 2,
         "I32": 4, "U32": 4, "U64": 8, "F8_E4M3": 1, "F8_E5M2": 1, "F8_E8M0": 1, "F8_E4M3FNUZ": 1, "F8_E5M2FNUZ": 1,
         "F4": 1, "F6_E2M3": 1, "F6_E3M2": 1}  # fmt: skip


def odd_values(outside: Path) -> list[Any]:
    """Values that a program may trip over; ``outside`` is where nothing must be written."""
    deep: Any = 0
    for _ in range(500):
        deep = [deep]
    paths = [
        "../../../outside/x",
        str(outside / "x"),
        "..",
        ".",
        "/",
        "a/../../outside/x",
        "a\\b",
        "~",
        *ENDLESS,
        "{run}",
        "{run}/../x",
        "a\0b",
    ]
    texts = [
        "",
        " ",
        "x" * 5000,
        "\ud800",
        "\x1b[2J",
        "\n",
        "<script>",
        "ünï",
        "1e999",
        "NaN",
        "os:system",
        "true",
        "1,2,3",
        "3/4 (2/s, 1.2.3 s left)",
        f"3/4 (2/s, {'9' * 400} h left)",
        "[" * 100_000,
    ]
    numbers = [
        10**400,
        -(10**20),
        0,
        -1,
        1,
        2,
        7,
        2**16,
        2**31,
        2**53,
        2**63,
        2**64,
        10**30,
        0.5,
        1e308,
        float("nan"),
        float("inf"),
    ]
    return [*paths, *texts, *numbers, None, True, False, [], {}, [[]], {"a": {}}, [1, "a", None], deep, ["x"] * 300]


def bytes_changed(data: bytes, rng: Rng) -> bytes:
    """One to eight small changes anywhere, and at times a cut."""
    changed = bytearray(data)
    for _ in range(rng.choice((1, 1, 1, 2, 4, 8))):
        if not changed:
            break
        at = rng.randrange(len(changed)) if rng.random() < 0.5 else rng.randrange(min(len(changed), 2048))
        what = rng.randrange(6)
        if what == 0:
            changed[at] ^= 1 << rng.randrange(8)
        elif what == 1:
            changed[at] = rng.choice((0, 1, 0x7F, 0x80, 0xFF, 0x22, 0x7B, 0x5B))
        elif what == 2:
            size = rng.choice((1, 2, 4, 8))
            changed[at : at + size] = rng.choice((0, 1, 2**31, 2**63 - 1, 2**64 - 1)).to_bytes(8, "little")[:size]
        elif what == 3:
            del changed[at : at + rng.choice((1, 8, 64, 512))]
        elif what == 4:
            changed[at:at] = changed[at : at + rng.choice((1, 8, 64, 512))]
        else:
            del changed[at:]
    return bytes(changed)


def tree_changed(tree: Any, rng: Rng, odd: list[Any]) -> Any:
    """One to three values replaced, removed, added or renamed anywhere in a JSON value."""
    tree = json.loads(json.dumps(tree))
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        places = list(_places(tree))
        if not places:
            return _one_of(odd, rng)
        holder, key = rng.choice(places)
        what = rng.randrange(8)
        if what <= 4:
            holder[key] = _one_of(odd, rng)
        elif what == 5:
            del holder[key]
        elif what == 6 and isinstance(holder, dict):
            holder[str(rng.choice(odd))[:6000]] = holder.pop(key)
        elif isinstance(holder, dict):
            holder[str(rng.choice(odd))[:6000]] = _one_of(odd, rng)
        else:
            holder.append(_one_of(odd, rng))
    return _one_of(odd, rng) if rng.random() < 0.02 else tree


def _one_of(odd: list[Any], rng: Rng) -> Any:
    """A copy: what is put into a tree may be changed there, and must not be found changed in the next case."""
    return json.loads(json.dumps(rng.choice(odd)))


def _places(tree: Any) -> Any:
    if isinstance(tree, dict):
        for key in tree:
            yield tree, key
            yield from _places(tree[key])
    elif isinstance(tree, list) and len(tree) < 50:
        for index in range(len(tree)):
            yield tree, index
            yield from _places(tree[index])


def json_changed(data: bytes, rng: Rng, odd: list[Any]) -> bytes:
    """Bytes or values of a JSON file."""
    if rng.random() < 0.3:
        return bytes_changed(data, rng)
    return json.dumps(tree_changed(json.loads(data), rng, odd)).encode()


def safetensors_changed(data: bytes, rng: Rng, odd: list[Any]) -> bytes:
    """Bytes, the header's values, or its length alone."""
    what = rng.random()
    if what < 0.3:
        return bytes_changed(data, rng)
    size = int.from_bytes(data[:8], "little")
    if what > 0.95:  # of another type, as many bytes
        tensors = json.loads(data[8 : 8 + size])
        for name in rng.sample([*tensors], min(len(tensors), rng.choice((1, 1, 3)))):
            tensor, kind = tensors[name], rng.choice([*TYPES])
            begin, end = tensor.get("data_offsets", (0, 0))
            tensor |= {"dtype": kind, "shape": [(end - begin) // TYPES[kind]]} if "dtype" in tensor else {}
        text = json.dumps(tensors).encode()
        return len(text).to_bytes(8, "little") + text + data[8 + size :]
    header = (
        json.dumps(tree_changed(json.loads(data[8 : 8 + size]), rng, odd)).encode()
        if what < 0.9
        else data[8 : 8 + size]
    )
    length = len(header) if what < 0.9 else rng.choice((0, 1, size - 1, size + 1, 2**31, 2**40, 2**63, 2**64 - 1))
    return length.to_bytes(8, "little") + header + data[8 + size :]


def toml_of(tree: Any, rng: Rng) -> str:
    """TOML text of tables, with dates, times and inline tables strewn in."""
    lines: list[str] = []
    for stage, table in tree.items() if isinstance(tree, dict) else ():
        if not isinstance(table, dict):
            lines.insert(0, f"{_toml(stage, rng)} = {_toml(table, rng)}")
            continue
        lines.append(f"[{_toml(stage, rng)}]")
        lines += [f"{_toml(key, rng)} = {_toml(value, rng)}" for key, value in table.items()]
    return "\n".join(lines) + "\n"


def _toml(value: Any, rng: Rng) -> str:
    if rng.random() < 0.02:
        return rng.choice(
            ("1979-05-27T07:32:00Z", "07:32:00", "1979-05-27", "{a = 1}", "0x7f", "nan", "'''x'''", "9" * 5000)
        )
    if isinstance(value, bool) or value is None:
        return "true" if value else "false"
    if isinstance(value, dict):
        return "{" + ", ".join(f"{_toml(k, rng)} = {_toml(v, rng)}" for k, v in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(_toml(item, rng) for item in value) + "]"
    if isinstance(value, float):
        return repr(value)
    return json.dumps(value)


def hdf5_changed(path: Path, rng: Rng, odd: list[Any], secret: Path) -> None:
    """Change an HDF5 file in place: an attribute or a dataset replaced by something it should not be."""
    with h5py.File(path, "r+") as file:
        for _ in range(rng.choice((1, 1, 2))):
            if rng.random() < 0.3:
                _attribute(file, rng, odd)
            else:
                names: list[str] = []
                file.visit(names.append)
                _replace(file, rng.choice(names), rng, secret)


def _attribute(file: Any, rng: Rng, odd: list[Any]) -> None:
    name = rng.choice(sorted(file.attrs))
    text = json.dumps(rng.choice(odd))
    value = rng.choice(odd)
    kinds: list[Callable[[], Any]] = [
        lambda: text,
        lambda: fixed(text),
        lambda: (
            fixed(json.dumps(tree_changed(json.loads(file.attrs[name]), rng, odd)))
            if isinstance(file.attrs[name], bytes) and name != "domain"
            else 3
        ),
        lambda: np.zeros(1000),
        lambda: file.ref,
        lambda: h5py.Empty("f8"),
        lambda: np.array([(1, 2.0)], dtype=[("a", "i4"), ("b", "f8")]),
        lambda: value if isinstance(value, (int, float)) and abs(value) < 2**63 else "x" * 60_000,
        lambda: np.array(["a", "b"], dtype=h5py.string_dtype()),
        lambda: b"\xff\xfe",
    ]
    made = rng.choice(kinds)()
    del file.attrs[name]
    if rng.random() < 0.9:
        file.attrs[name] = made


def _replace(file: Any, name: str, rng: Rng, secret: Path) -> None:
    shape = getattr(file[name], "shape", (4,)) or (4,)
    huge = (2**40, *shape[1:])
    makers: list[Callable[[], Any]] = [
        lambda: file.create_dataset(name, shape=huge, dtype="u1"),
        lambda: file.create_dataset(name, shape=huge, dtype="u1", chunks=(64, *shape[1:]), compression="gzip"),
        lambda: file.create_dataset(
            name, shape=(2**14, 2**12), dtype="u1", chunks=(2**14, 2**12), compression="gzip", data=None
        ),
        lambda: file.create_dataset(
            name, data=np.zeros((2**12, 2**12), "u1"), chunks=(2**12, 2**12), compression="gzip"
        ),
        lambda: file.create_dataset(name, shape=shape, dtype=h5py.ref_dtype),
        lambda: file.create_dataset(name, shape=shape, dtype=h5py.string_dtype()),
        lambda: file.create_dataset(name, shape=shape, dtype=h5py.vlen_dtype(np.uint8)),
        lambda: file.create_dataset(name, shape=shape, dtype=[("a", "u1"), ("b", "u1")]),
        lambda: file.create_dataset(name, data=np.full(shape[:1], rng.choice((np.nan, 1e300, -1)))),
        lambda: file.create_dataset(name, data=rng.choice((0, -1, 2**62))),
        lambda: file.create_dataset(name, shape=(0, *shape[1:]), dtype="u1"),
        lambda: file.create_dataset(name, data=h5py.Empty("u1")),
        lambda: file.create_dataset(name, shape=shape, dtype="u1", external=[(str(secret), 0, h5py.h5f.UNLIMITED)]),
        lambda: file.create_dataset(name, shape=(shape[0], 7), dtype="u1", compression="lzf"),
        lambda: file.create_dataset(name, shape=shape, dtype="u1", chunks=True, scaleoffset=0),
        lambda: file.create_virtual_dataset(name, _virtual(shape, secret)),
        lambda: file.create_group(f"{name}/observations/labels/origin"),
        lambda: file.__setitem__(name, h5py.SoftLink(rng.choice(("/", f"/{name}", "/unlabelled/observations")))),
        lambda: file.__setitem__(name, h5py.ExternalLink(str(secret), "/")),
        lambda: file.__setitem__(name, file["/"]),
        lambda: None,
    ]
    maker = rng.choice(makers)
    del file[name]
    maker()


def _virtual(shape: tuple[int, ...], secret: Path) -> Any:
    layout = h5py.VirtualLayout(shape=shape, dtype="u1")
    layout[...] = h5py.VirtualSource(str(secret), "x", shape=shape)
    return layout
