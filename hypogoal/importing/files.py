"""Files that other programs wrote: which there are, and why one cannot be read."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any

from hypogoal.core.errors import UserError

POINTER = b"version https://git-lfs"  # how a file begins that Git LFS has not fetched


def files_of(folder: Path, suffixes: Sequence[str], left: Counter[str]) -> list[Path]:
    """The visible files with these suffixes in a folder and those below it, sorted, links followed.

    ``left`` counts the others by suffix.
    """
    taken = []
    for place, folders, names in os.walk(folder, followlinks=True):
        folders[:] = [name for name in folders if not name.startswith(".")]
        for name in names:
            file = Path(place, name)
            suffix = file.suffix.lower()
            if name.startswith("."):
                continue
            if suffix in suffixes:
                taken.append(file)
            else:
                left[suffix or name] += 1
    return sorted(taken)


def needed(module: str, extra: str) -> Any:
    """A module of an extra of hypogoal's; a ``UserError`` where it is not installed."""
    try:
        return import_module(module)
    except ImportError:
        package = module.partition(".")[0]
        raise UserError(f"this needs {package}, which is not installed", None, f"pip install '{extra}'") from None


@contextmanager
def reading(path: Path, do: str) -> Iterator[None]:
    """A block that reads a file of another program: whatever its library raises becomes one line with the cause."""
    try:
        yield
    except (UserError, MemoryError):
        raise
    except Exception as error:  # noqa: BLE001 - libraries raise what they like
        raise _unreadable(path, error, do) from None


def _unreadable(path: Path, error: Exception, do: str) -> UserError:
    """Why a file cannot be read, and a remedy that fits."""
    if isinstance(error, FileNotFoundError):
        return UserError("no such file", error.filename or path, do)
    if "h5clear" in str(error):
        return UserError("the program that wrote this has not closed it", path, f"Once it has ended: h5clear -s {path}")
    if path.is_file():
        with path.open("rb") as file:
            if file.read(len(POINTER)) == POINTER:
                return UserError("this is a pointer of Git LFS, not the file itself", path, "git lfs pull")
    cause = f"{type(error).__name__}: {error}"[:200]
    return UserError(f"this cannot be read ({cause})", path, do)
