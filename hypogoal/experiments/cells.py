"""Experiments as data: cells, each one ordinary command with its own output (Spec A6, G4)."""

import shlex
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from hypogoal.core.errors import UserError
from hypogoal.settings import CONFIGS, options_of

DERIVED = ("evaluate", "report")  # stages that only read a run: made again in minutes
RESERVED = ("--out", "--force", "--resume")  # set by the sweep alone
SHORT = frozenset(option for stage in CONFIGS for option in options_of(stage))  # short for --set, which wins
COLUMNS = ("sub_goal", "member", "scope", "number", "value")  # of ``results.csv``, after those of the cell
Axes = tuple[tuple[str, str | int | float], ...]


@dataclass(frozen=True)
class Cell:
    """One command of an experiment."""

    name: str  # for messages and its log
    arguments: tuple[str, ...]  # of ``hypogoal``, without ``--force``
    out: Path  # what it writes
    needs: tuple[Path, ...] = ()  # outputs of other cells that it reads
    cores: int = 1  # processes that it can use
    axes: Axes = ()  # its place in the experiment, columns of ``results.csv``: seed, method, ...

    @property
    def stage(self) -> str:
        """Its command: train-meta, ..."""
        return self.arguments[0]

    @property
    def parts(self) -> list[list[str]]:
        """The words of its command: those before all options, then each option with its values."""
        parts: list[list[str]] = [[]]
        for word in self.arguments:
            if word.startswith("-"):
                parts.append([])
            parts[-1] += word.split("=", 1) if word.startswith("--") else [word]
        return parts

    @property
    def text(self) -> str:
        """The command as one would type it."""
        return shlex.join(("hypogoal", *self.arguments))


@dataclass(frozen=True)
class Plan:
    """An experiment."""

    experiment: str  # its name
    cells: list[Cell]  # in an order in which they can run
    workers: int  # cores used at once
    anew: frozenset[str] = frozenset()  # names of cells to be made again, even if they were complete before

    def of_stage(self, stage: str) -> frozenset[str]:
        """The names of a stage's cells; none is a ``UserError``."""
        stages = dict.fromkeys(cell.stage for cell in self.cells)
        if stage not in stages:
            raise UserError("this run has no such stage", stage, f"Choose one of {', '.join(stages)}.")
        return frozenset(cell.name for cell in self.cells if cell.stage == stage)

    def from_stage(self, stage: str) -> frozenset[str]:
        """The names of a stage's cells and of those that need them; none is a ``UserError``."""
        names, outs = {*self.of_stage(stage)}, set[Path]()
        for cell in self.cells:  # those that a cell needs are before it
            if cell.name in names or not outs.isdisjoint(cell.needs):
                names.add(cell.name)
                outs.add(cell.out)
        return frozenset(names)


def closing_cells(run: Path, needs: Sequence[Path], cores: int = 1) -> list[Cell]:
    """Evaluate, in so many processes, and report, when everything else is complete."""
    evaluation = run / "evaluation"
    return [
        Cell("evaluate", ("evaluate", str(run), "--out", str(evaluation)), evaluation, tuple(needs), cores),
        Cell("report", ("report", str(run)), run / "report", (evaluation,)),
    ]


def moved(cell: Cell, source: str, target: str) -> Cell:
    """The cell of the same run in another folder, ``target`` instead of ``source``; only paths of outputs change."""

    def place(path: object) -> str:
        return target + str(path)[len(source) :]

    paths = {str(path) for path in (cell.out, *cell.needs)} | ({source} if cell.stage in DERIVED else set())
    return replace(
        cell,
        arguments=(cell.stage, *(place(word) if word in paths else word for word in cell.arguments[1:])),
        out=Path(place(cell.out)),
        needs=tuple(Path(place(need)) for need in cell.needs),
    )
