"""Damage for ``tests.attacks.fuzz``: bytes, values of JSON, TOML and tables, headers of weights, parts of HDF5."""

from __future__ import annotations

import io
import json
import random
from collections.abc import Iterator
from typing import Any

import h5py
import numpy as np

Rng = random.Random
Place = tuple[Any, Any]  # a list or an object, and a key of it
ODD = ["", " ", "x" * 300, "\n", "ünï", "NaN", "1,2", "../x", "module:object", 0, -1, 2, 7, 10_000, 0.5, -0.5,
       float("nan"), float("inf"), None, True, [], {}, [[]], {"a": {}}, [1, "a", None]]  # fmt: skip


def bytes_changed(data: bytes, rng: Rng) -> bytes:
    """One to four small changes anywhere, or a cut."""
    changed = bytearray(data)
    for _ in range(rng.choice((1, 1, 2, 4))):
        if not changed:
            break
        at = rng.randrange(len(changed)) if rng.random() < 0.5 else rng.randrange(min(len(changed), 2048))
        size = rng.choice((1, 8, 64, 512))
        kind = rng.randrange(5)
        if kind == 0:
            changed[at] ^= 1 << rng.randrange(8)
        elif kind == 1:
            changed[at] = rng.choice((0, 0x7F, 0x80, 0xFF, 0x22, 0x7B, 0x5B))
        elif kind == 2:
            del changed[at : at + size]
        elif kind == 3:
            changed[at:at] = changed[at : at + size]
        else:
            del changed[at:]
    return bytes(changed)


def tree_changed(tree: Any, rng: Rng) -> Any:
    """One to three values of a JSON value replaced, removed, added or renamed."""
    tree = json.loads(json.dumps(tree))
    for _ in range(rng.choice((1, 1, 2, 3))):
        places = list(_places(tree))
        if not places:
            return rng.choice(ODD)
        holder, key = rng.choice(places)
        odd = json.loads(json.dumps(rng.choice(ODD)))  # a copy: it may be changed in turn
        kind = rng.randrange(6)
        if kind <= 2:
            holder[key] = odd
        elif kind == 3:
            del holder[key]
        elif isinstance(holder, dict):
            holder[f"{key}_"] = holder.pop(key) if kind == 4 else odd
        else:
            holder.append(odd)
    return tree


def _places(tree: Any) -> Iterator[Place]:
    keys = tree if isinstance(tree, dict) else range(len(tree)) if isinstance(tree, list) else ()
    for key in keys:
        yield tree, key
        yield from _places(tree[key])


def json_changed(data: bytes, rng: Rng) -> bytes:
    """Bytes or values of a JSON file."""
    if rng.random() < 0.3:
        return bytes_changed(data, rng)
    return json.dumps(tree_changed(json.loads(data), rng)).encode()


def table_changed(data: bytes, rng: Rng) -> bytes:
    """Bytes or cells of a CSV file."""
    if rng.random() < 0.5:
        return bytes_changed(data, rng)
    rows = [line.split(",") for line in data.decode().splitlines()]
    row = rng.choice(rows)
    row[rng.randrange(len(row))] = str(rng.choice(ODD))
    return "\n".join(",".join(cells) for cells in rows).encode() + b"\n"


def toml_changed(data: bytes, rng: Rng) -> bytes:
    """Bytes, a value or a key of a TOML file."""
    if rng.random() < 0.3:
        return bytes_changed(data, rng)
    lines = data.decode().splitlines()
    at = rng.choice([number for number, line in enumerate(lines) if "=" in line])
    key, _, value = lines[at].partition(" = ")
    odd = json.dumps(rng.choice(ODD)).replace("NaN", "nan").replace("Infinity", "inf")
    lines[at] = rng.choice((f"{key} = {odd}", f"{key} = {odd}", f"{key}_ = {value}", ""))
    return "\n".join(lines).encode()


def weights_changed(data: bytes, rng: Rng) -> bytes:
    """Bytes of a safetensors file, values or types of its header, or the length that it says to have."""
    kind, size = rng.random(), int.from_bytes(data[:8], "little")
    if kind < 0.3:
        return bytes_changed(data, rng)
    if kind < 0.4:
        length = rng.choice((0, 1, size - 1, size + 1, 2**31, 2**63, 2**64 - 1))
        return length.to_bytes(8, "little") + data[8:]
    header = json.loads(data[8 : 8 + size])
    text = json.dumps(tree_changed(header, rng)).encode()
    if kind < 0.7:  # another type of as many bytes
        text = json.dumps(header).replace("F32", rng.choice(("I32", "U32"))).encode()
    return len(text).to_bytes(8, "little") + text + data[8 + size :]


def hdf5_changed(data: bytes, rng: Rng) -> bytes:
    """Bytes of an HDF5 file, an attribute, or a dataset that becomes another."""
    if rng.random() < 0.4:
        return bytes_changed(data, rng)
    stored = io.BytesIO(data)
    with h5py.File(stored, "r+") as file:
        names: list[str] = []
        file.visit(names.append)
        if file.attrs and rng.random() < 0.4:
            odd = rng.choice(ODD)
            file.attrs[rng.choice(sorted(file.attrs))] = odd if isinstance(odd, int | float) else json.dumps(odd)
        else:
            _replace(file, rng.choice(names), rng)
    return stored.getvalue()


def _replace(file: h5py.File, name: str, rng: Rng) -> None:
    """Put nothing, fewer states, other shapes, types or values in a dataset's place."""
    values = np.atleast_1d(file[name][()]) if isinstance(file[name], h5py.Dataset) else np.zeros(3)
    others: list[Any] = [
        None, values[:0], values[: len(values) // 2], 1, values[..., None], np.full(values.shape, -1),
        np.full(values.shape, 0.5), np.full(values.shape[:1], np.nan), "a text", h5py.Empty("u1"),
    ]  # fmt: skip
    del file[name]
    other = rng.choice(others)
    if other is not None:
        file[name] = other
