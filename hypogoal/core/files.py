"""Files that others wrote: what they hold is data to check, never to trust (Spec G2).

Sizes are looked at before anything is read, names before anything is opened. Devices, pipes and folders are no files.
"""

from __future__ import annotations

import json
import os
import tomllib
from pathlib import Path, PurePosixPath
from typing import Any, NoReturn

from hypogoal.core.errors import UserError

MAX_TEXT_BYTES = 64 * 2**20
MAX_JSON_DEPTH = 32
MAX_NAME_BYTES = 200
MOST_DOTS = 256  # in a line of TOML
MOST_INTEGER = (1 << 53) - 1  # other readers of JSON take numbers for floats of 64 bits


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


def parse_toml(text: str, where: object, what: str, do: str) -> dict[str, Any]:
    """TOML without keys in hundreds of parts (``a.a.a``), for which the parser takes the square of their number.

    Raises:
        UserError: it is not, or not TOML at all.
    """
    try:
        for number, line in enumerate(text.split("\n"), 1):
            if line.count(".") > MOST_DOTS:
                raise ValueError(f"more than {MOST_DOTS} dots in line {number}")
        table = tomllib.loads(text)
        repr(table)  # hexadecimals of any length are read, and not printed
        return table
    except (ValueError, RecursionError) as error:  # a number of 5,000 digits, brackets within each other
        raise UserError(f"{what} not valid TOML ({str(error)[:200]})", where, do) from None


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
        fresh.replace(path)
    finally:
        fresh.unlink(missing_ok=True)


def plain_name(name: object) -> bool:
    """Whether a text can be part of a file's name and of a message: no separators, no control characters, no dot first.

    Names of sub-goals become files of weights and groups of HDF5 files: ``../../x`` must not.
    """
    return (
        isinstance(name, str)
        and name.isprintable()
        and name.strip() == name
        and not name.startswith(".")
        and not set(name) & set("/\\")
        and 0 < len(name.encode(errors="replace")) <= MAX_NAME_BYTES
    )


def inside(folder: Path, name: object) -> Path | None:
    """The file called ``name`` (``a/b.csv``) in ``folder``; None where it would lie outside, links followed."""
    if not isinstance(name, str) or not name or not all(plain_name(part) for part in name.split("/")):
        return None
    path = folder / PurePosixPath(name)
    try:
        return path if path.resolve().is_relative_to(folder.resolve()) else None
    except (OSError, RuntimeError):  # links that lead in a circle
        return None
