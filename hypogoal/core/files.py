"""Files that others wrote: their contents are checked, never trusted (Spec G2).

Sizes are checked before reading, names before opening. Devices, pipes and folders are refused: everything that is not
read by a library is opened with :func:`open_file`, which never waits.
"""

import contextlib
import csv
import io
import json
import os
import re
import stat
import tomllib
from collections.abc import Iterable, Iterator, Sequence
from io import BufferedReader
from pathlib import Path, PurePosixPath
from typing import Any, TypeGuard, TypeVar

from hypogoal.core.errors import UserError
from hypogoal.core.locks import fresh_file
from hypogoal.core.terminal import printable

T = TypeVar("T")
MAX_TEXT_BYTES = 64 * 2**20
END_BYTES = 8 * 2**20  # of a log that is followed: some 80,000 lines
MOST_DEPTH = 32  # of JSON and TOML
MOST_HOLE, HOLE_RATIO = 2**30, 1000  # a larger file that stores less than a thousandth of its bytes is refused
MAX_NAME_BYTES = 200
MOST_DOTS = 256  # in a line of TOML
MOST_INTEGER = (1 << 53) - 1  # many readers of JSON treat numbers as 64-bit floats
FRESH = re.compile(r"\..+\.\d+\.new", re.DOTALL)  # the name of a file while :func:`replacing` writes it
NO_FILE_NAME = '<>:"|?*'  # not allowed in file names on Windows
FORMULA = "=+-@＝＋－＠"  # a cell that begins with one is a formula to a spreadsheet; full-width ones too


def require_file(path: Path, subject: str, do: str) -> int:
    """The size in bytes of a regular file; a missing one, a folder, device or pipe is a ``UserError``.

    ``subject`` begins the message, with its verb ("the weights are"); ``do`` is what to do.
    """
    try:
        state = path.stat()
    except (FileNotFoundError, NotADirectoryError):
        raise UserError(f"{subject} missing", path, do) from None
    except (OSError, ValueError) as error:  # a name too long or with a null character, a folder without permission
        raise UserError(f"{subject} not readable ({getattr(error, 'strerror', error)})", path, do) from None
    if not stat.S_ISREG(state.st_mode):
        raise UserError(f"{subject} not a regular file", path, do)
    return state.st_size


def open_file(path: Path, subject: str, do: str) -> BufferedReader:
    """A regular file, or a link to one, opened for reading bytes; see :func:`require_file`.

    The file may be replaced by a pipe at any time: opening does not wait for the pipe's other end, and the opened file
    is checked again.
    """
    require_file(path, subject, do)
    flags = [getattr(os, name, 0) for name in ("O_NONBLOCK", "O_CLOEXEC", "O_NOCTTY", "O_BINARY", "O_NOINHERIT")]
    try:
        file = os.fdopen(os.open(path, os.O_RDONLY | sum(flags)), "rb")
    except OSError as error:
        raise UserError(f"{subject} not readable ({error.strerror})", path, do) from None
    if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
        file.close()
        raise UserError(f"{subject} not a regular file", path, do)
    return file


def is_hole(file: BufferedReader) -> bool:
    """Whether a sparse file declares over a thousand times the bytes it stores; reading it would never end."""
    state = os.fstat(file.fileno())
    stored = 512 * getattr(state, "st_blocks", state.st_size)
    if state.st_size <= max(MOST_HOLE, HOLE_RATIO * stored) or not hasattr(os, "SEEK_HOLE"):
        return False
    hole = os.lseek(file.fileno(), 0, os.SEEK_HOLE)
    os.lseek(file.fileno(), 0, os.SEEK_SET)
    return hole < state.st_size


def read_bytes(path: Path, subject: str, do: str, limit: int = MAX_TEXT_BYTES) -> bytes:
    """The bytes of a regular file, up to its size when opened; over ``limit`` or unreadable, a ``UserError``."""
    with open_file(path, subject, do) as file:
        size = os.fstat(file.fileno()).st_size
        if size > limit:
            raise UserError(f"{subject} too large ({size} bytes, at most {limit} are read)", path, do)
        try:
            return file.read(size)
        except OSError as error:
            raise UserError(f"{subject} not readable ({error.strerror})", path, do) from None


def read_text(path: Path, subject: str, do: str, limit: int = MAX_TEXT_BYTES) -> str:
    """The text of a file in UTF-8 (else a ``UserError``) with line feeds as line ends; see :func:`read_bytes`."""
    try:
        text = read_bytes(path, subject, do, limit).decode()
    except UnicodeDecodeError:
        raise UserError(f"{subject} not text in UTF-8", path, do) from None
    return text.replace("\r\n", "\n").replace("\r", "\n")


def read_end(path: Path, limit: int = END_BYTES) -> list[str]:
    """The last lines of a log that may still be growing, at most ``limit`` bytes; none if it cannot be read."""
    try:
        with open_file(path, "the log is", "") as file:
            file.seek(max(0, os.fstat(file.fileno()).st_size - limit - 1))
            cut, data = file.tell() > 0, file.read(limit + 1)
    except (UserError, OSError):
        return []
    lines = data.decode(errors="replace").splitlines()
    return lines[1:] if cut else lines


def read_json(path: Path, subject: str, do: str, limit: int = MAX_TEXT_BYTES) -> Any:
    """The contents of a JSON file; see :func:`read_text` and :func:`parse_json`."""
    return parse_json(read_text(path, subject, do, limit), path, subject, do)


def parse_json(text: str, where: object, subject: str, do: str) -> Any:
    """JSON whose values are :func:`_bounded`, finite and valid UTF-8; else a ``UserError``."""
    try:
        value = _parsed(text)
        json.dumps(value, ensure_ascii=False, allow_nan=False).encode()  # half a surrogate pair, NaN, 1e999
    except ValueError:
        raise UserError(f"{subject} not valid JSON", where, do) from None
    return value


def json_lines(lines: Iterable[str]) -> Iterator[dict[str, Any]]:
    """The objects in a log's lines; half-written, damaged and other lines are left out."""
    for line in lines:
        with contextlib.suppress(ValueError):
            if isinstance(value := _parsed(line), dict):
                yield value


def _parsed(text: str) -> Any:
    """JSON whose values are :func:`_bounded`; else a ``ValueError``."""
    try:
        return _bounded(json.loads(text))
    except RecursionError:
        raise ValueError("it is too deep") from None


def _bounded(value: T) -> T:
    """A value at most ``MOST_DEPTH`` deep whose integers are exact as floats; else a ``ValueError``."""
    level: list[Any] = [value]
    for _ in range(MOST_DEPTH):
        if any(isinstance(item, int) and abs(item) > MOST_INTEGER for item in level):
            raise ValueError(f"it has an integer beyond {MOST_INTEGER}")
        groups = (item for item in level if isinstance(item, (dict, list)))
        level = [inner for item in groups for inner in (item.values() if isinstance(item, dict) else item)]
        if not level:
            return value
    raise ValueError("it is too deep")


def parse_toml(text: str, where: object, subject: str, do: str) -> dict[str, Any]:
    """Valid TOML, else a ``UserError``; keys of hundreds of parts (``a.a.a``) take quadratic time and are refused."""
    try:
        for number, line in enumerate(text.split("\n"), 1):
            if line.count(".") > MOST_DOTS:
                raise ValueError(f"more than {MOST_DOTS} dots in line {number}")
        table = tomllib.loads(text)
        repr(table)  # raises for hexadecimals too long to print
        return _bounded(table)
    except (ValueError, RecursionError) as error:  # a number of 5,000 digits, brackets within each other
        raise UserError(f"{subject} not valid TOML ({str(error)[:200]})", where, do) from None


def replace_text(path: Path, text: str) -> None:
    """Write a file atomically: a reader sees the old contents or ``text``."""
    with replacing(path) as fresh:
        fresh.write_text(text, encoding="utf-8")


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A temporary file, renamed to ``path`` when the block ends; removed if it raises, left over if it is killed."""
    fresh = path.with_name(f".{path.name}.{os.getpid()}.new")
    with fresh_file(fresh):
        yield fresh
        replace_file(fresh, path)


def replace_file(fresh: Path, path: Path) -> None:
    """Rename a file once it is on the disk: after a power failure ``path`` is the old file or the new one."""
    sync(fresh)
    fresh.replace(path)
    sync(path.parent)


def sync(path: Path) -> None:
    """Flush a file, or a folder's list of files, to the disk.

    Windows cannot open folders and syncs only files opened for writing.
    """
    if os.name == "nt" and path.is_dir():
        return
    descriptor = os.open(path, os.O_RDWR if os.name == "nt" else os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def write_table(path: Path, columns: Sequence[str], rows: Iterable[Sequence[Any]]) -> None:
    """Write a CSV file with a header atomically; numbers stay numbers, no text becomes a spreadsheet's formula."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(map(_harmless, row) for row in (columns, *rows))
    replace_text(path, text.getvalue())


def _harmless(value: Any) -> Any:
    """A cell; in a text, an apostrophe precedes what would begin a formula, also after another separator."""
    if not isinstance(value, str):
        return value
    try:
        float(value)
    except ValueError:
        return re.sub(rf"(^|[,;\"])(?=\s*[{re.escape(FORMULA)}])", r"\1'", printable(value))
    return value


def path_part(name: object) -> TypeGuard[str]:
    """Whether a name can be part of a path and of a message: no separators, control characters or leading dot.

    A name read from a file must not be ``../../x``.
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
    """Whether a text can name a sub-goal or the like; the same rule for writing and reading.

    Names become file names on every system, words of commands and cells of tables. Letters of any script are fine.
    """
    return path_part(name) and not name.endswith(".") and name[0] not in FORMULA and not set(name) & set(NO_FILE_NAME)


def plain_names(names: object) -> bool:
    """Whether this is a list of plain names that differ even if case is ignored."""
    if not (isinstance(names, list | tuple) and names and all(map(plain_name, names))):
        return False
    return len({name.casefold() for name in names}) == len(names)


def inside(folder: Path, name: object) -> Path | None:
    """The path of ``name`` (``a/b.csv``) in ``folder``; None if it would lie outside, links followed."""
    if not isinstance(name, str) or not name or not all(path_part(part) for part in name.split("/")):
        return None
    path = folder / PurePosixPath(name)
    return path if lies_in(folder, path) else None


def lies_in(folder: Path, path: Path) -> bool:
    """Whether a path lies in a folder, links followed."""
    try:
        return path.resolve().is_relative_to(folder.resolve())
    except (OSError, RuntimeError):  # circular links
        return False


def visible(folder: Path, pattern: str) -> list[Path]:
    """The paths below a folder that match a pattern, sorted; hidden ones, such as drafts, are left out."""
    candidates = ((path, path.relative_to(folder).parts) for path in folder.rglob(pattern))
    return sorted(path for path, parts in candidates if not any(part.startswith(".") for part in parts))
