"""HDF5 files: read whole or refused, and written whole or not at all."""

from __future__ import annotations

import contextlib
import io
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from hypogoal.core.arrays import Array
from hypogoal.core.errors import UserError
from hypogoal.core.files import reading, replacing

RECOLLECT = "Collect it again."
COLUMN_CHUNK = 1 << 16  # values of labels or of an origin in a chunk
ANEW = "Bring all files that it is made of, or write it again, whole."


@contextlib.contextmanager
def opened(path: Path, do: str = RECOLLECT, subject: str = "the data file") -> Iterator[Any]:
    """Open an HDF5 file for reading. Raises ``UserError`` if anything cannot be read within the context."""
    import h5py

    with reading(path, do, subject), h5py.File(path, "r", locking="best-effort") as file:
        yield file


@contextlib.contextmanager
def create_hdf5(path: Path) -> Iterator[Any]:
    """Give a new HDF5 file, which is built in memory and written when the context ends.

    On a full disk the HDF5 library crashes the process (a segmentation fault, h5py 3.16), but writing the finished
    bytes ourselves raises a normal ``OSError``.
    """
    import h5py

    with h5py.File(path.name, "w", driver="core", backing_store=False) as file:
        yield file
        file.flush()
        image = file.id.get_file_image()
    with replacing(path) as fresh:
        fresh.write_bytes(image)


def whole(data: Any) -> Any:
    """Return the HDF5 dataset ``data``. Raises ``UserError`` if some of its values are not stored.

    HDF5 reads other values in place of those that are not stored. Values are not stored where chunks or arrays were
    never written, or where raw files or parts of a virtual dataset are gone.
    """
    is_whole = data.id.get_storage_size() > 0 or not data.size
    if data.chunks:
        counts = np.ceil(np.divide(data.shape, data.chunks))
        is_whole = data.id.get_num_chunks() == counts.prod()
    for name, offset, size in data.external or ():
        is_whole &= Path(name).stat().st_size >= offset + min(size, data.nbytes)
    if data.is_virtual:
        is_whole = _is_covered(data)
    if not is_whole:
        raise UserError(f"{data.name} lacks values, for which HDF5 would give others", data.file.filename, ANEW)
    return data


def _is_covered(data: Any) -> bool:
    """Return whether the parts of a virtual dataset leave no gap in it. Raises ``UserError`` if a part lacks values."""
    import h5py

    whole_file = Path(data.file.filename)
    with h5py.File(io.BytesIO(), "w") as scratch:
        covered = scratch.create_dataset("covered", data.shape, bool)
        for target, file, name, source in data.virtual_sources():
            path = whole_file if file == "." else whole_file.parent / file
            with opened(path, ANEW, "a part of the recording") as part:
                ones = np.ones(whole(part[name]).shape, bool)
                source.set_extent_simple(ones.shape)
                covered.id.write(source, target, ones)
        return bool(np.all(covered))


def fixed(text: str) -> Array:
    """Return a text as a UTF-8 string of fixed length.

    HDF5 stores a string of fixed length in place, but a string of variable length in its global heap.
    """
    import h5py

    data = text.encode()
    return np.array(data, dtype=h5py.string_dtype("utf-8", max(1, len(data))))


def plain(attribute: Any) -> Any:
    """Return an attribute as a Python str, int, float or bool."""
    value = np.asarray(attribute).item()
    return value.decode() if isinstance(value, bytes) else value


def store(group: Any, name: str, values: Array) -> None:
    """Write observations compressed, and other values with checksums, because a flipped label would still be valid."""
    filters = {}
    count = len(values)
    if count and name == "observations":
        chunk = (min(64, count), *values.shape[1:])
        filters = {"chunks": chunk, "compression": "gzip", "compression_opts": 1}
    elif count:
        chunk = (min(COLUMN_CHUNK, count),)
        filters = {"chunks": chunk, "fletcher32": True}
    group.create_dataset(name, data=values, **filters)
