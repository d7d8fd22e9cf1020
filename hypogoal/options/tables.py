"""The tables of trained agents and options, each one class that writes and reads its CSV file."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np

from hypogoal.core.arrays import Bools, Columns, Doubles, Ints
from hypogoal.core.artefacts import AGAIN
from hypogoal.core.errors import UserError
from hypogoal.core.files import reading, replacing
from hypogoal.domains.episodes import LAST

BLANK = ("best_near", "best_far")  # columns whose cells may be empty: NaN


@dataclass(frozen=True)
class Table(Columns):
    """Columns (n,) of a file."""

    FILE: ClassVar[str]

    @classmethod
    def of_rows(cls, rows: Iterable[Sequence[float]]) -> Self:
        """A table of rows, each with a number for every column."""
        listed = list(rows)
        columns = zip(*listed, strict=True) if listed else [()] * len(cls.names())
        return cls.cast(*columns)

    @classmethod
    def read(cls, path: Path) -> Self:
        """The table in a CSV file with a header.

        A file that is missing, no table, or has other cells than finite numbers (or, in a ``BLANK`` column, nothing) is
        a ``UserError``.
        """
        from pandas import read_csv

        with reading(path, AGAIN, "the table"):
            frame = read_csv(path, dtype=str, encoding="utf-8-sig")
            frame = frame[[*cls.names()]].astype(float)
        for name, values in frame.items():
            known = np.isfinite(values)
            if name in BLANK:
                known |= values.isna()
            if not known.all():
                raise UserError("a number in the table is missing", path, AGAIN)
        return cls.cast(*frame.to_numpy().T)

    def write(self, folder: Path) -> None:
        """The file of this table into ``folder``; a NaN is an empty cell."""
        with replacing(folder / self.FILE) as fresh, fresh.open("w", encoding="utf-8", newline="") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(self.names())
            for row in self.rows():
                writer.writerow(["" if math.isnan(number) else number for number in row])

    def rows(self) -> list[tuple[Any, ...]]:
        """Plain numbers, row by row; truth values are 0 and 1."""
        columns = [(getattr(self, name) * 1).tolist() for name in self.names()]
        return [*zip(*columns, strict=True)]


@dataclass(frozen=True)
class Episodes(Table):
    """Training episodes in the order in which they ended."""

    FILE = "episodes.csv"

    step: Ints  # environment steps when it ended, summed over parallel environments and stages
    length: Ints  # steps
    reward: Doubles  # undiscounted
    terminated: Bools  # it reached a terminal state; else it was cut at the cap
    # as its domain says; else terminated with a reward: an agent that dies reaches a terminal state too.
    succeeded: Bools

    def last(self) -> Episodes:
        """The last ``LAST`` episodes, or all where there are fewer."""
        return self.at(slice(-LAST, None))


@dataclass(frozen=True)
class ChoiceCounts(Table):
    """Choices of options: one row per option and window of steps that ends at ``step``."""

    FILE = "choices.csv"

    step: Ints
    option: Ints  # g*K + k
    offered: Ints  # decisions in which it was offered
    chosen: Ints  # decisions for it
    expected: Doubles  # decisions for it under uniform-random choice
    reached: Ints  # executions that reached its sub-goal
    duration: Ints  # steps of its executions

    def total(self, name: str, options: int) -> Doubles:
        """The sum of column ``name`` over all windows, (O,)."""
        return np.bincount(self.option, weights=getattr(self, name), minlength=options).astype(float)


@dataclass(frozen=True)
class Executions(Table):
    """The last executions of each option, in the order in which they ended."""

    FILE = "executions.csv"

    step: Ints  # environment steps when it ended
    option: Ints  # g*K + k
    duration: Ints  # steps
    reached: Bools  # its own termination classifier ended it
    inside_at_start: Bools  # that classifier's prediction was positive where it began
    terminated: Bools  # the episode ended in a terminal state: solved, or lost
    room: Ints  # where it stopped; x and y too
    x: Ints
    y: Ints
    distance: Ints  # from there to the nearest true sub-goal, in the domain's units


@dataclass(frozen=True)
class Exploits(Table):
    """Of the same executions, how sure their own classifiers were at most."""

    FILE = "exploits.csv"

    step: Ints  # environment steps when it ended
    option: Ints  # g*K + k
    reached: Bools  # its own termination classifier ended it
    near: Bools  # that was near its true sub-goal
    best_near: Doubles  # highest log-odds near the true sub-goal; NaN where it did not come near
    best_far: Doubles  # highest log-odds far from it; NaN where it always was near
