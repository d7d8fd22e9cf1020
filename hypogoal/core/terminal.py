"""Printing: lines and tables for people, texts for programs."""

from __future__ import annotations

import io
import sys
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rich.console import Console


def amount(count: int, noun: str) -> str:
    """``1 cell``, ``2 cells``."""
    return f"{count:,} {noun}{'' if count == 1 else 's'}"


def say(text: object, *, err: bool = False) -> None:
    """Print a text on standard output or error."""
    print(text, file=sys.stderr if err else sys.stdout, flush=True)


def drawn(table: Any, width: int) -> str:
    """A table as plain text, the same on every machine."""
    console = screen(width=width, record=True, file=io.StringIO())
    console.print(table)
    return console.export_text().rstrip("\n")


def screen(*, err: bool = False, **more: Any) -> Console:
    """A console for tables and bars; brackets are no mark-up."""
    from rich.console import Console

    return Console(stderr=err, markup=False, emoji=False, highlight=False, force_jupyter=False, **more)
