"""Files that other programs wrote: which there are, and why one cannot be read."""

from collections import Counter
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from glob import iglob
from importlib import import_module
from pathlib import Path
from typing import Any

from hypogoal.core.errors import UserError

POINTER = b"version https://git-lfs"  # how a file begins that Git LFS has not fetched
AGAIN = "Write or download it again; hypogoal's page on data of your own says what is read."


def files_of(folder: Path, suffixes: Collection[str], left: Counter[str]) -> list[Path]:
    """The visible files with these suffixes in a folder and those below it, sorted, links followed.

    ``left`` counts the others by suffix.
    """
    taken = []
    for name in iglob("**/*", root_dir=folder, recursive=True):
        file = folder / name
        suffix = file.suffix.lower()
        if file.is_dir():
            continue
        if suffix in suffixes:
            taken.append(file)
        else:
            left[suffix or file.name] += 1
    return sorted(taken)


def needed(module: str, extra: str) -> Any:
    """A module of one of hypogoal's extras; a ``UserError`` where it is not installed."""
    try:
        return import_module(module)
    except ImportError:
        do = f"pip install 'hypogoal[{extra}]'"
        raise UserError(f"this needs {module.partition('.')[0]}, which is not installed", None, do) from None


@contextmanager
def reading(path: Path, do: str = AGAIN) -> Iterator[None]:
    """A block that reads a file of another program: whatever its library raises becomes one line with the cause."""
    try:
        yield
    except (UserError, MemoryError):
        raise
    except FileNotFoundError as error:
        raise UserError("no such file", error.filename or path, do) from None
    except Exception as error:  # noqa: BLE001 - libraries raise what they like
        fault = f"this cannot be read ({type(error).__name__}: {error})"[:200]
        if path.is_file() and path.read_bytes().startswith(POINTER):
            fault, do = "this is a pointer of Git LFS, not the file itself", "git lfs pull"
        raise UserError(fault, path, do) from None
