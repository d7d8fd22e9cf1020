"""Reading and writing of small files.

If a file cannot be read, a ``UserError`` is raised. A file that is written gets its name once it is whole and on the
disk. ``subject`` begins a message ("the weights"), and ``do`` says what to do.
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

NO_FILE_NAME = '<>:"|?*'  # signs that are not allowed in file names on Windows
POINTER = b"version https://git-lfs"  # the beginning of a file that Git LFS has not fetched
AGAIN = "Write or download it again; hypogoal's page on data of your own says what is read."


@contextlib.contextmanager
def reading(path: Path, do: str = AGAIN, subject: str = "this") -> Iterator[None]:
    """Turn what a library raises within the block, while it reads ``path``, into a ``UserError``.

    The error is one line with the cause.
    """
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
    """Return the rows of a log that may still be growing, without a half-written row.

    The list is empty if the log cannot be read.
    """
    rows = []
    with contextlib.suppress(OSError, ValueError):
        for line in path.read_text(encoding="utf-8").splitlines():
            rows.append(json.loads(line))
    return rows


def replace_text(path: Path, text: str) -> None:
    """Write ``text`` to a file. A reader sees the old contents or ``text``, and nothing between."""
    with replacing(path) as fresh:
        fresh.write_text(text, encoding="utf-8")


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Give a file to write, and rename it to ``path`` when the block ends and the file is on the disk.

    If the block raises, the file is removed. If the process is killed, the file is left over, and the next writer of
    ``path`` overwrites it.
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
    """Return whether a text can name a sub-goal or the like, and so be a file's name on every system.

    Letters of any script are allowed.
    """
    return name.isprintable() and name.strip(" .") == name != "" and not set(name) & set(f"{NO_FILE_NAME}/\\")


def plain_names(names: Sequence[str]) -> bool:
    """Return whether there are names, all of them plain, that differ even if case is ignored."""
    different = {name.casefold() for name in names}
    return len(different) == len(names) > 0 and all(map(plain_name, names))


def visible(folder: Path, pattern: str) -> list[Path]:
    """Return the paths below a folder that match a pattern, sorted, without hidden paths such as drafts."""
    paths = [path for path in folder.rglob(pattern) if "/." not in f"/{path.relative_to(folder).as_posix()}"]
    return sorted(paths)


def as_json(facts: Any) -> str:
    """Return facts and numbers, also NumPy's, as a JSON text. NaN becomes null."""
    return to_json(
        facts,
        indent=1,
        inf_nan_mode="null",
        fallback=methodcaller("item"),
    ).decode()
