"""Experiments as data: cells, each one ordinary command with its own output (Spec A6, G4)."""

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

from hypogoal.core.errors import UserError
from hypogoal.core.files import path_part
from hypogoal.settings import CONFIGS, options_of

DERIVED = ("evaluate", "report")  # stages that only read a run: made again in minutes
RESERVED = ("--out", "--force", "--resume")  # given by the sweep alone
SHORT = frozenset(option for stage in CONFIGS for option in options_of(stage))  # short for --set, which wins
COLUMNS = ("sub_goal", "member", "scope", "number", "value")  # of ``results.csv``, after those of the cell
Axes = tuple[tuple[str, str | int | float], ...]


class Cost(NamedTuple):
    """The estimated cost of a cell; 0 if unknown."""

    seconds: float = 0.0  # on one core like that of docs/performance.md
    memory: float = 0.0  # bytes, of each of its processes
    disk: float = 0.0  # bytes, checkpoints included
    cores: int = 1  # processes that it can use


UNKNOWN = Cost()


@dataclass(frozen=True)
class Cell:
    """One command of an experiment."""

    name: str  # for messages and its log
    arguments: tuple[str, ...]  # of ``hypogoal``, without ``--force``
    out: Path  # what it writes
    needs: tuple[Path, ...] = ()  # outputs of other cells that it reads
    cost: Cost = UNKNOWN
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
    anew: frozenset[str] = frozenset()  # names of cells still to be made again, even if complete
    # The preset files that its commands name, each with its digest at the last start of the sweep.
    presets: Mapping[str, str] = field(default_factory=dict)


def stage_cell(
    out: Path,
    run: Path,
    arguments: Sequence[str],
    needs: Sequence[Path] = (),
    cost: Cost = UNKNOWN,
    axes: Mapping[str, str | int | float] | None = None,
) -> Cell:
    """The cell of a stage that writes ``out`` within the run's folder; its name is its place there."""
    if not all(map(path_part, out.relative_to(run).parts)):
        raise UserError("this would be written outside the run", out, "Leave separators and dots out of names.")
    name = out.relative_to(run).as_posix().removesuffix(".h5").replace("/", "-")
    if not path_part(f"{name}.json"):
        raise UserError("this name is too long for a file", name, "Choose shorter ones.")
    return Cell(name, (*arguments, "--out", str(out)), out, tuple(needs), cost, tuple((axes or {}).items()))


def closing_cells(run: Path, needs: Sequence[Path], cost: Cost = UNKNOWN) -> list[Cell]:
    """Evaluate (which takes ``cost``) and report, when everything else is complete."""
    evaluation = run / "evaluation"
    return [
        Cell("evaluate", ("evaluate", str(run), "--out", str(evaluation)), evaluation, tuple(needs), cost),
        Cell("report", ("report", str(run)), run / "report", (evaluation,), cost._replace(seconds=0.0)),
    ]


def moved(cell: Cell, source: str, target: str) -> Cell:
    """The cell of the same run in another folder, ``target`` instead of ``source``.

    Only paths change: a run may have the name of a stage, a domain or the value of a setting.
    """

    def part(text: str) -> str:
        return target + text[len(source) :] if within(text, source) else text

    def within(text: str, place: object) -> bool:
        return text == str(place) or text.startswith(f"{place}/")

    def is_place(number: int, word: str) -> bool:
        is_named = cell.arguments[number - 1] == "--out" or (number == 1 and cell.stage in DERIVED)
        return is_named or any(within(word, place) for place in (cell.out, *cell.needs))

    return replace(
        cell,
        arguments=tuple(part(word) if is_place(n, word) else word for n, word in enumerate(cell.arguments)),
        out=Path(part(str(cell.out))),
        needs=tuple(Path(part(str(need))) for need in cell.needs),
    )


def depths(cells: Sequence[Cell]) -> dict[Path, int]:
    """The longest chain of cells before each, by its output: 0 for those that need nothing."""
    depth: dict[Path, int] = {}
    for cell in cells:
        depth[cell.out] = 1 + max((depth[need] for need in cell.needs), default=-1)
    return depth
