"""Small files. What cannot be read is a ``UserError``; what is written has its name once it is whole and on the disk.

``subject`` begins a message ("the weights"); ``do`` is what to do.
"""

import contextlib
import json
import os
from collections.abc import Iterator, Sequence
from operator import methodcaller
from pathlib import Path
from typing import Any

from pydantic_core import to_json

from hypogoal.core.errors import UserError, reason

NO_FILE_NAME = '<>:"|?*'  # not allowed in file names on Windows
POINTER = b"version https://git-lfs"  # how a file begins that Git LFS has not fetched
AGAIN = "Write or download it again; hypogoal's page on data of your own says what is read."


@contextlib.contextmanager
def reading(path: Path, do: str = AGAIN, subject: str = "this") -> Iterator[None]:
    """A block that reads a file by some library: whatever that raises becomes one line with the cause."""
    try:
        yield
    except (UserError, MemoryError, UnicodeEncodeError):
        raise
    except ImportError as error:
        do = "pip install 'hypogoal[lerobot,minari]'"
        raise UserError(f"a package that reads this is not installed ({error})", path, do) from None
    except FileNotFoundError as error:
        raise UserError("no such file", error.filename or path, do) from None
    except IsADirectoryError:
        raise UserError(f"{subject} is a directory", path, do) from None
    except Exception as error:  # noqa: BLE001 - libraries raise what they like
        fault = f"{subject} cannot be read ({type(error).__name__}: {reason(error)})"[:250]
        if "h5clear" in fault:
            do = f"If no program writes it any more, one has crashed: h5clear -s {path}"
        elif "unable to lock" in fault:
            do = "It is open in another program: close it there first."
        elif "signature not found" in fault:
            fault = f"{subject} is no HDF5 file"
        elif "synchronously" in fault and "plugin" in fault:
            fault = f"{subject} is compressed by a filter of HDF5 that is not installed"
            do = "pip install hdf5plugin, and give HDF5_PLUGIN_PATH its hdf5plugin.PLUGIN_PATH."
        elif path.is_file() and path.read_bytes().startswith(POINTER):
            fault, do = "this is a pointer of Git LFS, not the file itself", "git lfs pull"
        raise UserError(fault, path, do) from None


def read_log(path: Path) -> list[dict[str, Any]]:
    """The rows of a log that may still be growing, but for a half-written one; none if it cannot be read."""
    rows = []
    with contextlib.suppress(OSError, ValueError):
        for line in path.read_text(encoding="utf-8").splitlines():
            rows.append(json.loads(line))
    return rows


def replace_text(path: Path, text: str) -> None:
    """Write a file: a reader sees the old contents or ``text``."""
    with replacing(path) as fresh:
        fresh.write_text(text, encoding="utf-8")


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A file to write, renamed to ``path`` when the block ends and it is on the disk; removed if the block raises.

    If the process is killed it is left over; the next writer of ``path`` overwrites it.
    """
    fresh = path.with_name(f".{path.name}.new")
    try:
        yield fresh
        sync(fresh)
        fresh.replace(path)
        sync(path.parent)
    finally:
        fresh.unlink(missing_ok=True)


def sync(path: Path) -> None:
    """Flush a file, or a folder's list of files, to the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def plain_name(name: str) -> bool:
    """Whether a text can name a sub-goal or the like: a file's name on every system. Any script is fine."""
    return name.isprintable() and name.strip(" .") == name != "" and not set(name) & set(f"{NO_FILE_NAME}/\\")


def plain_names(names: Sequence[str]) -> bool:
    """Whether there are names, all plain, that differ even if case is ignored."""
    different = {name.casefold() for name in names}
    return len(different) == len(names) > 0 and all(map(plain_name, names))


def visible(folder: Path, pattern: str) -> list[Path]:
    """The paths below a folder that match a pattern, sorted; hidden ones, such as drafts, are left out."""
    paths = [path for path in folder.rglob(pattern) if "/." not in f"/{path.relative_to(folder).as_posix()}"]
    return sorted(paths)


def as_json(facts: Any) -> str:
    """Text of facts and numbers, NumPy's too; NaN becomes null."""
    return to_json(
        facts,
        indent=1,
        inf_nan_mode="null",
        fallback=methodcaller("item"),
    ).decode()
