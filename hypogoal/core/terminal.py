"""Printing: for people, whose terminals must not obey a stranger's text, and for programs.

A closed stream is ignored. A failing standard error never ends a stage; a failing standard output raises
:class:`Unprinted`, since the work is complete by then.
"""

from __future__ import annotations

import contextlib
import io
import os
import shutil
import sys
import textwrap
import unicodedata
from typing import TYPE_CHECKING, Any, TextIO

if TYPE_CHECKING:
    from rich.console import Console


class Unprinted(OSError):
    """Standard output cannot be written, for example to a full disk; the stage's output is complete."""


def printable(text: str) -> str:
    """A line that may quote a stranger's file, without control, invisible and bidirectional characters."""
    return "".join(sign if sign.isprintable() or unicodedata.category(sign) == "Zs" else "?" for sign in text)


def amount(count: int, noun: str) -> str:
    """``1 cell``, ``2 cells``."""
    return f"{count:,} {noun}{'' if count == 1 else 's'}"


def say(text: object, *, err: bool = False, wrap: bool = False) -> None:
    """A line for people, on standard output or error; ``wrap``: on a terminal as several that end after words."""
    lines, stream = [printable(str(text))], sys.stderr if err else sys.stdout
    if wrap and stream is not None and stream.isatty():
        width = shutil.get_terminal_size().columns
        lines = textwrap.wrap(lines[0], width, break_on_hyphens=False, break_long_words=False) or lines
    for line in lines:
        give(line, err=err)


def give(text: object, *, err: bool = False) -> None:
    """Print text for programs exactly as it is: JSON or the path of an output."""
    stream = sys.stderr if err else sys.stdout
    try:
        if stream is not None:
            print(text, file=stream, flush=True)
    except OSError as error:
        _silence(stream)
        if not err:
            raise Unprinted(error.errno, error.strerror) from None


def draw(table: Any, width: int) -> None:
    """Print a table on standard output, as wide as the terminal, or ``width`` if there is none."""
    try:
        screen(width=None if sys.stdout.isatty() else width).print(table)
    except OSError as error:
        _silence(sys.stdout)
        raise Unprinted(error.errno, error.strerror) from None


def drawn(table: Any, width: int) -> str:
    """A table as plain text, the same on every machine."""
    console = screen(width=width, record=True, file=io.StringIO())
    console.print(table)
    return console.export_text().rstrip("\n")


def screen(*, err: bool = False, width: int | None = None, **more: Any) -> Console:
    """A console for tables and bars; texts are made :func:`printable`, and brackets are no mark-up."""
    from rich.console import Console
    from rich.text import Text

    class Screen(Console):
        def render_str(self, text: str, **options: Any) -> Text:
            return super().render_str("\n".join(map(printable, text.split("\n"))), **options)

    return Screen(stderr=err, width=width, markup=False, emoji=False, highlight=False, force_jupyter=False, **more)


def _silence(stream: TextIO) -> None:
    """Redirect a stream to nowhere: Python flushes it once more at exit."""
    with contextlib.suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def open_streams() -> None:
    """Open closed standard streams on nothing.

    Otherwise the next opened file, perhaps of weights, becomes standard error and receives its text. Characters that a
    pipe or terminal cannot encode (cp1252 lacks the blocks of curves) become '?'.
    """
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest free number
        stream = getattr(sys, name)
        if stream is None:
            setattr(sys, name, os.fdopen(number, "w" if number else "r", closefd=False))
        elif number and getattr(stream, "errors", "") == "strict" and hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="replace")
