"""What is printed: for people, who must see a stranger's text and not have their terminal obey it, and for programs.

Whoever closed a stream wants nothing of it. An error of standard error ends nothing, a day of training least of all;
one of standard output is told as what it is, since what was to be done is done by then.
"""

from __future__ import annotations

import contextlib
import io
import os
import sys
import unicodedata
from typing import TYPE_CHECKING, Any, TextIO

if TYPE_CHECKING:
    from rich.console import Console


class Unprinted(OSError):
    """Standard output does not take what is printed: a full disk behind it, not below an output."""


def printable(text: str) -> str:
    """A line that may quote a stranger's file: no sign in it moves the cursor, hides, turns or colours anything."""
    return "".join(sign if sign.isprintable() or unicodedata.category(sign) == "Zs" else "?" for sign in text)


def say(text: object, *, err: bool = False) -> None:
    """A line for people, on standard output or error."""
    give(printable(str(text)), err=err)


def give(text: object, *, err: bool = False) -> None:
    """What programs read, as it is: JSON, or the path of an output, of which they can make use only if it is exact."""
    stream = sys.stderr if err else sys.stdout
    try:
        if stream is not None:
            print(text, file=stream, flush=True)
    except OSError as error:
        _silence(stream)
        if not err:
            raise Unprinted(error.errno, error.strerror) from None


def draw(table: Any, width: int) -> None:
    """A table on standard output, as wide as the terminal, or ``width`` where there is none."""
    try:
        screen(width=None if sys.stdout.isatty() else width).print(table)
    except OSError as error:
        _silence(sys.stdout)
        raise Unprinted(error.errno, error.strerror) from None


def drawn(table: Any, width: int) -> str:
    """A table as plain text, the same wherever it is made."""
    console = screen(width=width, record=True, file=io.StringIO())
    console.print(table)
    return console.export_text().rstrip("\n")


def screen(*, err: bool = False, width: int | None = None, **more: Any) -> Console:
    """Where tables and bars are drawn; brackets in a text are brackets, and it is made :func:`printable`."""
    from rich.console import Console
    from rich.text import Text

    class Screen(Console):
        def render_str(self, text: str, **options: Any) -> Text:
            return super().render_str("\n".join(map(printable, text.split("\n"))), **options)

    return Screen(stderr=err, width=width, markup=False, emoji=False, highlight=False, force_jupyter=False, **more)


def _silence(stream: TextIO) -> None:
    """Have what is still to be written to a stream go nowhere: at the end Python tries to once more."""
    with contextlib.suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def open_streams() -> None:
    """Open what is closed of the three standard streams, on nothing.

    Otherwise the next file that is opened, of weights perhaps, becomes standard error, and gets what is written there.
    Signs that a pipe or terminal does not take (cp1252 has no block of a curve) become '?' and end nothing.
    """
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # which takes the lowest number that is free
        stream = getattr(sys, name)
        if stream is None:
            setattr(sys, name, os.fdopen(number, "w" if number else "r", closefd=False))
        elif number and getattr(stream, "errors", "") == "strict" and hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="replace")
