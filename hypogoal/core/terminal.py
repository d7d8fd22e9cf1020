"""Printing: lines and tables for people, texts for programs."""

from __future__ import annotations

import io
import sys
from typing import Any


def say(*lines: object, err: bool = False) -> None:
    """Print lines on standard output or error."""
    stream = sys.stderr if err else sys.stdout
    for line in lines:
        print(line, file=stream, flush=True)


def drawn(table: Any, width: int) -> str:
    """A table as plain text, the same on every machine; brackets are no mark-up."""
    from rich.console import Console

    console = Console(
        width=width,
        record=True,
        file=io.StringIO(),
        markup=False,
        emoji=False,
        highlight=False,
        force_jupyter=False,
    )
    console.print(table)
    return console.export_text().rstrip("\n")
