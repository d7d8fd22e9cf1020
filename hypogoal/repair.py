"""What can be saved of a data file that was cut off: ``hypogoal verify --repair`` (Spec G2).

A file is cut off when a copy, a disk or ``collect`` stopped half-way. Its groups were written one after the other, so
those in front are whole. They are copied to a fresh file; the original is kept beside it.
"""

from __future__ import annotations

import io
import json
import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hypogoal.core.errors import UserError
from hypogoal.core.files import parse_json, require_file
from hypogoal.core.hdf5 import (
    Busy,
    Foreign,
    attribute,
    check_dataset,
    create_hdf5,
    find,
    read_array,
    set_attribute,
    walk,
)
from hypogoal.core.preflight import free_disk, human
from hypogoal.dataset import ATTRIBUTES, open_dataset, write_column, write_observations

SIGNATURE = b"\x89HDF\r\n\x1a\n"
END_AT = {0: 40, 1: 44, 2: 28, 3: 28}  # where a superblock of each version says how long the file is
MOST_END = 1 << 46
Part = dict[str, NDArray[Any]]  # a group's arrays by name


@dataclass(frozen=True)
class Repaired:
    """What became of a file: the parts that were saved and lost, and where the original is."""

    kept: tuple[str, ...]
    lost: tuple[str, ...]
    original: Path


def repair(path: Path) -> Repaired:
    """Put the whole groups of a cut-off data file in its place; the file as it was becomes ``NAME.damaged``.

    Raises:
        UserError: the file is whole, is no HDF5, its beginning is damaged, or no labelled group in it is whole.
        Busy: another program writes it, or it may not be read.
    """
    size = require_file(path, "the data file is", "Give a data file.")
    opens = _opens(path)
    if free_disk(path) < size:
        raise UserError(f"not enough disk: {human(size)} needed, {human(free_disk(path))} free", path, "Free some.")
    about, parts = _whole_parts(path, size)
    sub_goals = [name for name in about["sub_goals"] if f"labelled/{name}" in parts]
    if not sub_goals:
        raise UserError("no labelled group is whole, nothing can be saved", path, "Collect it again.")
    if all(name in parts for name in _expected(about["sub_goals"])) and opens:
        raise UserError("nothing to repair, every group is whole", path, "See 'hypogoal verify'.")
    lost = [name for name in _expected(about["sub_goals"]) if name not in parts]
    kept = [name for name in parts if name == "unlabelled" or name.partition("/")[2] in sub_goals]
    fresh = path.with_name(f".{path.name}.repaired-{os.getpid()}")
    try:
        _write(fresh, about, sub_goals, {name: parts[name] for name in kept}, lost)
        open_dataset(fresh).counts()
        original = _aside(path)
        path.rename(original)
        fresh.rename(path)
    finally:
        fresh.unlink(missing_ok=True)
    return Repaired(tuple(kept), tuple(lost), original)


def _whole_parts(path: Path, size: int) -> tuple[dict[str, Any], dict[str, Part]]:
    """The root's attributes, and the arrays of every group that lies in the first ``size`` bytes and can be read."""
    import h5py

    again = "Collect it again."
    with path.open("rb") as raw, _Padded(raw, _end(raw, size, path)) as padded:
        try:
            with h5py.File(padded, "r") as file:
                about = {name: attribute(file, name) for name in ATTRIBUTES}
                for name in ("sub_goals", "observation_shape"):
                    about[name] = parse_json(str(about[name]), path, f"the attribute {name!r} is", again)
                    if not isinstance(about[name], list):
                        raise Foreign(f"the attribute {name!r} is malformed")
                parts: dict[str, Part] = {}
                seen: dict[int, NDArray[Any]] = {}
                for name in _expected(list(map(str, about["sub_goals"]))):
                    try:
                        parts[name] = dict(_arrays(file, name, size, seen))
                    except Foreign:
                        continue
        except (OSError, RuntimeError, ValueError, KeyError, TypeError, Foreign) as error:
            raise UserError(
                f"nothing can be saved, the beginning of the file is damaged ({error})", path, again
            ) from None
    return about, parts


def _opens(path: Path) -> bool:
    try:
        open_dataset(path)
    except Busy:  # nothing is known to be wrong with it
        raise
    except UserError:
        return False
    return True


def _expected(sub_goals: list[str]) -> list[str]:
    return [*(f"labelled/{name}" for name in sub_goals), "unlabelled", *(f"heldout/{name}" for name in sub_goals)]


def _arrays(file: Any, group: str, size: int, seen: dict[int, NDArray[Any]]) -> Iterator[tuple[str, NDArray[Any]]]:
    """The arrays of a group, all of which must lie in the first ``size`` bytes; shared ones are read once.

    Raises:
        Foreign: one does not, or the group has no observations and (but for ``unlabelled``) labels for each.
    """
    import h5py

    found = find(file, group)
    if not isinstance(found, h5py.Group):
        raise Foreign(f"no group {group!r}")
    names = list(walk(found))
    needed = {"observations"} | (set() if group == "unlabelled" else {"labels"})
    if not needed <= {*names}:
        raise Foreign(f"{group!r} lacks {needed - {*names}}")
    counts = set()
    for name in names:
        dataset = find(found, name)
        address = h5py.h5o.get_info(dataset.id).addr
        if address not in seen:
            check_dataset(dataset, "uib")
            if _last_byte(dataset) > size:
                raise Foreign(f"{name!r} was cut off")
            seen[address] = read_array(found, name, "uib")
        counts.add(seen[address].shape[:1])
        yield name, seen[address]
    if len(counts) != 1:
        raise Foreign(f"{group!r} has arrays of different lengths")


def _last_byte(dataset: Any) -> int:
    """How far into its file a dataset's values reach."""
    if dataset.chunks is None:
        return int(dataset.id.get_offset() or 0) + int(dataset.id.get_storage_size())
    ends = [0]
    dataset.id.chunk_iter(lambda chunk: ends.append(chunk.byte_offset + chunk.size))
    return max(ends)


def _write(
    path: Path, about: Mapping[str, Any], sub_goals: list[str], parts: Mapping[str, Part], lost: list[str]
) -> None:
    written: dict[int, Any] = {}
    with create_hdf5(path) as file:
        for name, value in about.items():
            if value is not None and name not in ("sub_goals", "observation_shape", "lost", "complete"):
                set_attribute(file, name, value)
        set_attribute(file, "sub_goals", json.dumps(sub_goals))
        set_attribute(file, "observation_shape", json.dumps(about["observation_shape"]))
        set_attribute(file, "lost", json.dumps(lost))
        set_attribute(file, "complete", True)
        for group, arrays in parts.items():
            place = file.create_group(group)
            for name, values in arrays.items():
                if id(values) in written:
                    place[name] = written[id(values)]  # shared on disk, as it was
                elif name == "observations":
                    write_observations(place, values)
                else:
                    write_column(place, name, values.astype(np.bool_) if name == "labels" else values)
                written.setdefault(id(values), place[name])
    with path.open("rb") as file:
        os.fsync(file.fileno())


def _aside(path: Path) -> Path:
    """A free name beside ``path``."""
    for number in range(1, 1000):
        name = path.with_name(f"{path.name}.damaged" + (f"-{number}" if number > 1 else ""))
        if not name.exists():
            return name
    raise UserError("too many damaged files are kept here", path.parent, "Remove some.")


def _end(raw: Any, size: int, path: Path) -> int:
    """How long the file was meant to be, from its superblock."""
    head = raw.read(64)
    if head[:8] != SIGNATURE or len(head) < 64 or head[8] not in END_AT:
        raise UserError("not HDF5, nothing can be saved", path, "Collect it again.")
    end = int.from_bytes(head[END_AT[head[8]] :][:8], "little")
    return max(size, end) if end <= MOST_END else size


class _Padded(io.RawIOBase):
    """A file that goes on with zeros up to ``end``: HDF5 opens no file that is shorter than it should be."""

    def __init__(self, raw: Any, end: int):
        self._raw, self._end, self._at = raw, end, 0

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def tell(self) -> int:
        return self._at

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        self._at = offset + {os.SEEK_SET: 0, os.SEEK_CUR: self._at, os.SEEK_END: self._end}[whence]
        return self._at

    def readinto(self, buffer: Any) -> int:
        count = max(0, min(len(buffer), self._end - self._at))
        self._raw.seek(self._at)
        found = self._raw.read(count)
        buffer[: len(found)] = found
        buffer[len(found) : count] = bytes(count - len(found))
        self._at += count
        return count
