"""Files that others wrote: what they hold is data to check, never to trust (Spec G2).

Sizes are looked at before anything is read, names before anything is opened. Devices, pipes and folders are no files.
"""

from __future__ import annotations

import csv
import io
import json
import os
import re
from collections.abc import Iterable, Sequence
from pathlib import Path, PurePosixPath
from typing import Any, NoReturn, TypeGuard

from hypogoal.core.errors import UserError, printable

MAX_TEXT_BYTES = 64 * 2**20
MAX_JSON_DEPTH = 32
MAX_NAME_BYTES = 200
MOST_INTEGER = (1 << 53) - 1  # other readers of JSON take numbers for floats of 64 bits
NO_FILE_NAME = '<>:"|?*'  # signs that Windows has in no file's name
FORMULA = "=+-@＝＋－＠"  # signs with which a spreadsheet begins to compute, of full width too


def require_file(path: Path, what: str, do: str) -> int:
    """The size in bytes of a regular file.

    Args:
        path: the file.
        what: what it is, for the message ("the weights are").
        do: what to do where it is missing.

    Raises:
        UserError: it is missing, or a folder, device or pipe.
    """
    try:
        if path.is_file():
            return path.stat().st_size
        there = path.exists()
    except OSError as error:  # a name that is too long, a folder that may not be entered
        raise UserError(f"{what} not readable ({error.strerror})", path, do) from None
    raise UserError(f"{what} not a regular file" if there else f"{what} missing", path, do)


def read_text(path: Path, what: str, do: str, limit: int = MAX_TEXT_BYTES) -> str:
    """The text of a file of at most ``limit`` bytes of UTF-8.

    Args:
        path: the file.
        what: what it is, for messages, with its verb ("the manifest is").
        do: what to do about any of the errors.
        limit: bytes.

    Raises:
        UserError: missing, no regular file, larger, not readable or not UTF-8.
    """
    size = require_file(path, what, do)
    if size > limit:
        raise UserError(f"{what} too large ({size} bytes, at most {limit} are read)", path, do)
    try:
        return path.read_text(encoding="utf-8")
    except UnicodeDecodeError:
        raise UserError(f"{what} not text in UTF-8", path, do) from None
    except OSError as error:
        raise UserError(f"{what} not readable ({error.strerror})", path, do) from None


def read_json(path: Path, what: str, do: str, limit: int = MAX_TEXT_BYTES) -> Any:
    """What a JSON file holds; see :func:`read_text` and :func:`parse_json`."""
    return parse_json(read_text(path, what, do, limit), path, what, do)


def parse_json(text: str, where: object, what: str, do: str) -> Any:
    """JSON whose numbers are finite, at most ``MAX_JSON_DEPTH`` deep, and whose texts can be printed.

    Raises:
        UserError: it is not, or not JSON at all.
    """
    try:
        value = json.loads(text, parse_constant=_no_number)
        _check_depth(value)
        json.dumps(value, ensure_ascii=False, allow_nan=False).encode()  # half a surrogate pair, 1e999
    except (ValueError, RecursionError):
        raise UserError(f"{what} not valid JSON", where, do) from None
    return value


def _no_number(name: str) -> NoReturn:
    raise ValueError(name)


def _check_depth(value: Any) -> None:
    level = [value]
    for _ in range(MAX_JSON_DEPTH):
        level = [
            inner
            for item in level
            if isinstance(item, (dict, list))
            for inner in (item.values() if isinstance(item, dict) else item)
        ]
        if not level:
            return
    raise RecursionError


def replace_text(path: Path, text: str) -> None:
    """Write a file whole or not at all: a reader finds what was there before, or ``text``."""
    fresh = path.with_name(f".{path.name}.{os.getpid()}.new")
    try:
        fresh.write_text(text, encoding="utf-8")
        replace_file(fresh, path)
    finally:
        fresh.unlink(missing_ok=True)


def replace_file(fresh: Path, path: Path) -> None:
    """Give a file its name when all of it is on the disk: a power failure leaves it, or what was there before."""
    sync(fresh)
    fresh.replace(path)
    sync(path.parent)


def sync(path: Path) -> None:
    """Have what was written to a file, or to a folder's list of files, on the disk itself.

    Windows opens no folders, and syncs only what was opened for writing.
    """
    if os.name == "nt" and path.is_dir():
        return
    descriptor = os.open(path, os.O_RDWR if os.name == "nt" else os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def write_table(path: Path, columns: Sequence[str], rows: Iterable[Sequence[Any]]) -> None:
    """A CSV file with a header, whole or not at all; numbers stay numbers, no text is a formula to a spreadsheet."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(map(_harmless, row) for row in (columns, *rows))
    replace_text(path, text.getvalue())


def _harmless(value: Any) -> Any:
    """A cell: in a text an apostrophe in front of what would begin a formula, there or after another separator."""
    if not isinstance(value, str):
        return value
    try:
        float(value)
    except ValueError:
        return re.sub(rf"(^|[,;\"])(?=\s*[{re.escape(FORMULA)}])", r"\1'", printable(value))
    return value


def path_part(name: object) -> TypeGuard[str]:
    """Whether a text can be a part of a path and of a message: no separators, no control characters, no dot first.

    What a file says is in a folder must not be ``../../x``.
    """
    return (
        isinstance(name, str)
        and name.isprintable()
        and name.strip() == name
        and not name.startswith(".")
        and not set(name) & set("/\\")
        and 0 < len(name.encode(errors="replace")) <= MAX_NAME_BYTES
    )


def plain_name(name: object) -> TypeGuard[str]:
    """Whether a text can be the name of a sub-goal or the like: one rule, where names are written and where read.

    Names become those of files, on every system, words of commands, cells of tables. Letters of any script are fine.
    """
    return path_part(name) and not name.endswith(".") and name[0] not in FORMULA and not set(name) & set(NO_FILE_NAME)


def plain_names(names: object) -> bool:
    """Whether this is a list of plain names, two of which are not the same where upper and lower case are one."""
    if not (isinstance(names, list | tuple) and names and all(map(plain_name, names))):
        return False
    return len({name.casefold() for name in names}) == len(names)


def inside(folder: Path, name: object) -> Path | None:
    """The file called ``name`` (``a/b.csv``) in ``folder``; None where it would lie outside, links followed."""
    if not isinstance(name, str) or not name or not all(path_part(part) for part in name.split("/")):
        return None
    path = folder / PurePosixPath(name)
    try:
        return path if path.resolve().is_relative_to(folder.resolve()) else None
    except (OSError, RuntimeError):  # links that lead in a circle
        return None
