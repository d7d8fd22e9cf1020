"""Experiments as data: cells, each one ordinary command with its own output (Spec A6, G4)."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from hypogoal.core.artefacts import MANIFEST


@dataclass(frozen=True)
class Cell:
    """One command of an experiment.

    Attributes:
        name: for messages and its log.
        arguments: of ``hypogoal``, without ``--force``.
        out: what it writes.
        needs: outputs of other cells that must be complete first.
    """

    name: str
    arguments: tuple[str, ...]
    out: Path
    needs: tuple[Path, ...] = ()

    @property
    def text(self) -> str:
        """The command as one would type it."""
        return shlex.join(("hypogoal", *self.arguments))

    def complete(self) -> bool:
        """Whether its output is there; what has a manifest, and a data file under its name, is whole."""
        return (self.out / MANIFEST).is_file() if self.out.suffix != ".h5" else self.out.is_file()


@dataclass(frozen=True)
class Plan:
    """An experiment's cells, in an order in which they can run, and how many run at once."""

    cells: list[Cell]
    workers: int


def stage_cell(out: Path, run: Path, arguments: Sequence[str], needs: Sequence[Path] = ()) -> Cell:
    """The cell of a stage that writes ``out`` within the run's folder; its name is its place there."""
    name = out.relative_to(run).with_suffix("").as_posix().replace("/", "-")
    return Cell(name, (*arguments, "--out", str(out)), out, tuple(needs))


def closing_cells(run: Path, needs: Sequence[Path]) -> list[Cell]:
    """Evaluate and report, when everything else is there."""
    evaluation = run / "evaluation"
    return [
        Cell("evaluate", ("evaluate", str(run), "--out", str(evaluation)), evaluation, tuple(needs)),
        Cell("report", ("report", str(run)), run / "report", (evaluation,)),
    ]
