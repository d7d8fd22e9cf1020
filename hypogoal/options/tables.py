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

BLANK = ("best_near", "best_far")  # the columns whose cells may be empty, which is NaN


@dataclass(frozen=True)
class Table(Columns):
    """The columns of a CSV file, as arrays (n,)."""

    FILE: ClassVar[str]

    @classmethod
    def of_rows(cls, rows: Iterable[Sequence[float]]) -> Self:
        """Return a table of ``rows``, each of which has a number for every column."""
        listed = list(rows)
        columns = zip(*listed, strict=True) if listed else [()] * len(cls.names())
        return cls.cast(*columns)

    @classmethod
    def read(cls, path: Path) -> Self:
        """Return the table in a CSV file with a header.

        Raises ``UserError`` if the file is missing or no table, or if a cell is no finite number. Only cells of a
        ``BLANK`` column may be empty.
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
        """Write the table's file into ``folder``. A NaN becomes an empty cell."""
        with replacing(folder / self.FILE) as fresh, fresh.open("w", encoding="utf-8", newline="") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(self.names())
            for row in self.rows():
                writer.writerow(["" if math.isnan(number) else number for number in row])

    def rows(self) -> list[tuple[Any, ...]]:
        """Return plain numbers, row by row. Truth values are 0 and 1."""
        columns = [(getattr(self, name) * 1).tolist() for name in self.names()]
        return [*zip(*columns, strict=True)]


@dataclass(frozen=True)
class Episodes(Table):
    """Training episodes in the order in which they ended."""

    FILE = "episodes.csv"

    step: Ints  # the number of environment steps when the episode ended, summed over environments and stages
    length: Ints  # the number of steps
    reward: Doubles  # undiscounted
    terminated: Bools  # whether the episode reached a terminal state. Otherwise it was cut, at the cap
    # As the domain says. By default, whether it terminated with a reward, because dying is a terminal state, too.
    succeeded: Bools

    def last(self) -> Episodes:
        """Return the last ``LAST`` episodes, or all episodes if there are fewer."""
        return self.at(slice(-LAST, None))


@dataclass(frozen=True)
class ChoiceCounts(Table):
    """Choices of options, with one row for each option and each window of steps that ends at ``step``."""

    FILE = "choices.csv"

    step: Ints
    option: Ints  # g*K + k
    offered: Ints  # the number of decisions in which the option was offered
    chosen: Ints  # the number of decisions for the option
    expected: Doubles  # the number of decisions for the option expected under uniform-random choice
    reached: Ints  # the number of executions that reached the option's sub-goal
    duration: Ints  # the number of steps of the option's executions

    def total(self, name: str, options: int) -> Doubles:
        """Return the sum of column ``name`` over all windows, float64 (O,)."""
        return np.bincount(self.option, weights=getattr(self, name), minlength=options).astype(float)


@dataclass(frozen=True)
class Executions(Table):
    """The last executions of each option, in the order in which they ended."""

    FILE = "executions.csv"

    step: Ints  # the number of environment steps when the execution ended
    option: Ints  # g*K + k
    duration: Ints  # the number of steps
    reached: Bools  # whether the option's own classifier ended the execution
    inside_at_start: Bools  # whether that classifier was positive already where the execution began
    terminated: Bools  # whether the execution ended in a terminal state of the episode: solved, or lost
    room: Ints  # where the execution stopped, with x and y
    x: Ints
    y: Ints
    distance: Ints  # from where it stopped to the nearest true sub-goal, in the domain's units


@dataclass(frozen=True)
class Exploits(Table):
    """How sure the options' own classifiers were at most, in the executions of :class:`Executions`."""

    FILE = "exploits.csv"

    step: Ints  # the number of environment steps when the execution ended
    option: Ints  # g*K + k
    reached: Bools  # whether the option's own classifier ended the execution
    near: Bools  # whether the execution ended near the option's true sub-goal
    best_near: Doubles  # the highest log-odds near the true sub-goal, NaN if the execution never was near
    best_far: Doubles  # the highest log-odds far from the true sub-goal, NaN if the execution always was near
