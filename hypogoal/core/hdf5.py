"""HDF5 files that others wrote: declared sizes are compared with stored ones before anything is read (Spec G2).

HDF5 can point out of its file (external links, external storage, virtual datasets), load code (plugin filters) and
declare terabytes in a kilobyte. None of this is needed, and all of it is refused.
"""

import contextlib
import errno
from collections.abc import Iterator
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hypogoal.core.errors import UserError
from hypogoal.core.files import open_file, path_part

FILTERS = {1: "gzip", 2: "shuffle", 3: "fletcher32", 32000: "lzf"}  # all of them built into h5py
MOST_RATIO = 1032  # bytes from one compressed byte: deflate's limit, the highest of these filters
MAX_CHUNK_BYTES = 256 * 2**20
MAX_ATTRIBUTE_BYTES = 8 * 2**20
MAX_CHUNKS = 100_000  # per dataset: each takes about 4 kB of memory, stored or not
MAX_ENTRIES = 100_000  # per group


@contextlib.contextmanager
def open_hdf5(path: Path, subject: str, do: str) -> Iterator[Any]:
    """An HDF5 file opened for reading, locked if the file system can.

    A file that is missing, truncated, not HDF5, open for writing elsewhere, or in which something is ``Foreign`` is a
    ``UserError``.
    """
    import h5py

    open_file(path, f"{subject} is", do).close()
    try:
        opened = h5py.File(path, "r", locking="best-effort")
    except (OSError, ValueError, RuntimeError, KeyError) as error:
        if "unable to lock" in str(error) or getattr(error, "errno", None) == errno.EAGAIN:
            raise UserError(f"{subject} is open in another program", path, "Close it there first.") from None
        if isinstance(error, PermissionError):
            raise UserError(f"{subject} may not be read (permission denied)", path, "Ask for permission.") from None
        raise UserError(f"{subject} is truncated or not HDF5", path, do) from None
    with opened as file:
        try:
            yield file
        except Foreign as error:
            raise UserError(f"{subject} cannot be used: {error}", path, do) from None


@contextlib.contextmanager
def create_hdf5(path: Path) -> Iterator[Any]:
    """A fresh HDF5 file to fill, built in memory and written when the block ends.

    On a full disk the HDF5 library crashes the process (a segmentation fault, h5py 3.16); writing the finished bytes
    ourselves raises a normal ``OSError``.
    """
    import h5py

    with h5py.File(path.name, "w", driver="core", backing_store=False) as file:
        yield file
        file.flush()
        image = file.id.get_file_image()
    path.write_bytes(image)


class Foreign(Exception):
    """Refused contents of an HDF5 file; the caller adds where and what to do."""


@contextlib.contextmanager
def _readable(subject: str) -> Iterator[None]:
    """Whatever the HDF5 library raises in the block, if ``subject`` is damaged, is ``Foreign``."""
    try:
        yield
    except (OSError, RuntimeError, KeyError, ValueError, TypeError, AttributeError, MemoryError):
        raise Foreign(f"{subject} is not readable") from None


def fixed(text: str) -> NDArray[np.bytes_]:
    """A text as a fixed-length UTF-8 string, stored in place; variable-length ones lie in HDF5's global heap."""
    import h5py

    data = text.encode()
    return np.array(data, dtype=h5py.string_dtype("utf-8", max(1, len(data))))


def set_attribute(file: Any, name: str, value: str | int | float | bool) -> None:
    """Set an attribute of the root; a text as a fixed-length string."""
    stored = fixed(value) if isinstance(value, str) else np.asarray(value)
    file.attrs.create(name, stored, dtype=stored.dtype)


def attribute(file: Any, name: str) -> Any:
    """An attribute of the root: a text, int, float, bool, or None if there is none.

    Anything else is ``Foreign``; reading a variable-length text from a damaged heap may never end (HDF5 2.0).
    """
    with _readable(f"the attribute {name!r}"):
        if name not in file.attrs:
            return None
        stored = file.attrs.get_id(name)
        if stored.shape not in ((), (1,)) or stored.dtype.kind not in "Siufb":
            raise Foreign(f"the attribute {name!r} is neither a text of fixed length nor a number")
        if stored.get_storage_size() > MAX_ATTRIBUTE_BYTES:
            raise Foreign(f"the attribute {name!r} is too large")
        value = np.asarray(file.attrs[name]).item()
        return value.decode() if isinstance(value, bytes) else value


def members(group: Any) -> list[str]:
    """The names in a group, sorted; ``Foreign`` if it is not a group, has too many, or a name is not plain."""
    import h5py

    if not isinstance(group, h5py.Group):  # iterating over a dataset would yield its values, perhaps 2^62
        raise Foreign("a dataset is where a group should be")
    with _readable("a group"):
        count = len(group)
        names = sorted(group) if count <= MAX_ENTRIES else []
    if count > MAX_ENTRIES or not all(map(path_part, names)):
        raise Foreign("a group has names that cannot be right")
    return names


def find(file: Any, name: str) -> Any:
    """The group or dataset called ``name`` (``a/b``); None if missing, ``Foreign`` if unreadable or behind a link."""
    import h5py

    place = file
    for part in name.split("/"):
        with _readable(repr(name)):
            # Not `part in place` and not `place.get`: these follow links, into other files too.
            if not isinstance(place, h5py.Group) or not place.id.links.exists(part.encode()):
                return None
            if place.id.links.get_info(part.encode()).type != h5py.h5l.TYPE_HARD:
                raise Foreign(f"{name!r} is a link, which may lead anywhere")
            place = place[part]
    return place


def checked(file: Any, name: str, kinds: str) -> Any:
    """The dataset called ``name``, unread; the size that it declares is one that the file can hold.

    ``kinds`` are letters of NumPy's ``dtype.kind``; ``S`` for fixed-length texts. A missing one, other types (such as
    references and variable-length texts), data outside the file, plugin filters, and more declared bytes than the
    stored ones can stand for are ``Foreign``.
    """
    import h5py

    dataset = find(file, name)
    if not isinstance(dataset, h5py.Dataset):
        raise Foreign(f"no readable {name!r}")
    with _readable(repr(name)):
        dtype, shape, settings = dataset.dtype, dataset.shape, dataset.id.get_create_plist()
        if dtype.kind not in kinds or shape is None:
            raise Foreign(f"{name!r} has values of an unexpected type ({dtype}, shape {shape})")
        if dataset.is_virtual or settings.get_external_count():
            raise Foreign(f"the data of {name!r} lie in another file")
        filters = [settings.get_filter(index)[0] for index in range(settings.get_nfilters())]
        if not FILTERS.keys() >= {*filters}:
            raise Foreign(f"{name!r} needs a filter that is not one of {', '.join(FILTERS.values())}")
        stored, whole = int(dataset.id.get_storage_size()), int(file.id.get_filesize())
        sides = dataset.chunks or shape
        chunk = prod(map(int, sides)) * dtype.itemsize if dataset.chunks else 0
        chunks = prod(-(-side // width) for side, width in zip(shape, sides, strict=True) if width)
    size = prod(map(int, shape)) * int(dtype.itemsize)  # the dataset's own ``nbytes`` may overflow
    if stored > whole or size > (MOST_RATIO if filters else 1) * stored or chunk > MAX_CHUNK_BYTES:
        raise Foreign(f"{name!r} declares {size:,} bytes but stores {stored:,} in a file of {whole:,}")
    if chunks > min(MAX_CHUNKS, max(stored, 1)):  # ``stored`` may be a lie
        raise Foreign(f"{name!r} declares {size:,} bytes in {chunks} chunks but stores {stored:,}")
    return dataset


def read_array(file: Any, name: str, kinds: str, rows: slice | NDArray[np.int64] | None = None) -> NDArray[Any]:
    """A dataset's values, or ``rows`` of them; ``Foreign`` if damaged."""
    dataset = checked(file, name, kinds)
    with _readable(repr(name)):
        return np.asarray(dataset[() if rows is None else rows])


def walk(group: Any, prefix: str = "", depth: int = 8, seen: set[int] | None = None) -> Iterator[str]:
    """The names of all datasets below a group; links, unreadable parts and over ``depth`` levels are ``Foreign``.

    A dataset with several names (there may be millions) is listed once.
    """
    import h5py

    seen = set() if seen is None else seen
    for name in members(group):
        item = find(group, name)
        address = int(h5py.h5o.get_info(item.id).addr)
        if address in seen:
            continue
        seen.add(address)
        if isinstance(item, h5py.Group):
            if depth == 0:
                raise Foreign("groups are nested too deep")
            yield from walk(item, f"{prefix}{name}/", depth - 1, seen)
        elif isinstance(item, h5py.Dataset):
            yield f"{prefix}{name}"
