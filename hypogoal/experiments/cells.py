"""Experiments as data: cells, each one ordinary command with its own output (Spec A6, G4)."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from hypogoal.core.artefacts import MANIFEST
from hypogoal.core.errors import UserError
from hypogoal.core.files import plain_name


@dataclass(frozen=True)
class Cell:
    """One command of an experiment.

    Attributes:
        name: for messages and its log.
        arguments: of ``hypogoal``, without ``--force``.
        out: what it writes.
        needs: outputs of other cells that must be complete first.
        seconds: what it costs, on one core like that of docs/performance.md; 0 where that is not known.
    """

    name: str
    arguments: tuple[str, ...]
    out: Path
    needs: tuple[Path, ...] = ()
    seconds: float = 0.0

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

    def cost(self, cells: Sequence[Cell] | None = None) -> str:
        """How many of the plan's cells (all, or those given) there are to run, and for how long."""
        some = self.cells if cells is None else cells
        seconds = sum(cell.seconds for cell in some)
        longest = max((cell.seconds for cell in some), default=0.0)
        wall = max(seconds / self.workers, longest)
        time = f"about {_duration(seconds)} of one core, {_duration(wall)} with {self.workers} at once"
        return f"{len(some)} commands, {time} (rates of a 2.5 GHz core, docs/performance.md)"


def _duration(seconds: float) -> str:
    if seconds < 90 * 60:
        return f"{max(1, round(seconds / 60))} min"
    return f"{seconds / 3600:.1f} h" if seconds < 48 * 3600 else f"{seconds / 86400:.1f} days"


def stage_cell(
    out: Path, run: Path, arguments: Sequence[str], needs: Sequence[Path] = (), seconds: float = 0.0
) -> Cell:
    """The cell of a stage that writes ``out`` within the run's folder; its name is its place there."""
    if not all(map(plain_name, out.relative_to(run).parts)):
        raise UserError("this would be written outside the run", out, "Leave separators and dots out of names.")
    name = out.relative_to(run).with_suffix("").as_posix().replace("/", "-")
    return Cell(name, (*arguments, "--out", str(out)), out, tuple(needs), seconds)


def closing_cells(run: Path, needs: Sequence[Path], seconds: float = 0.0) -> list[Cell]:
    """Evaluate (which takes ``seconds``) and report, when everything else is there."""
    evaluation = run / "evaluation"
    return [
        Cell("evaluate", ("evaluate", str(run), "--out", str(evaluation)), evaluation, tuple(needs), seconds),
        Cell("report", ("report", str(run)), run / "report", (evaluation,)),
    ]
