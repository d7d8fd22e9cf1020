"""``results.csv``: the numbers of a run's evaluation, each with its cell's place in the experiment (Spec G4)."""

import csv
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from hypogoal.core.files import write_table
from hypogoal.experiments.sweep import Cell, read_plan

RESULTS = "results.csv"
SCOPES = ("", "labelled", "unlabelled", "heldout", "unseen", "all")  # of what is listed


def write_results(cells: Sequence[Cell], run: Path) -> None:
    """Write ``results.csv``, if there is an evaluation; learning curves are in its ``numbers.csv`` alone."""
    numbers = run / "evaluation" / "numbers.csv"
    if numbers.exists():
        names = list(dict.fromkeys(name for cell in cells for name in cell.columns))
        header = ["cell", "stage", *names, "sub_goal", "member", "scope", "number", "value"]
        write_table(run / RESULTS, header, _lines(cells, names, numbers))


def _lines(cells: Sequence[Cell], names: Sequence[str], numbers: Path) -> Iterator[list[Any]]:
    """In the order of the cells."""
    with numbers.open(encoding="utf-8", newline="") as file:
        rows = [row for row in csv.DictReader(file) if not row["step"] and row["scope"] in SCOPES]
    for cell in cells:
        place = [cell.name, cell.stage, *(cell.columns.get(name, "") for name in names)]
        for row in rows:
            if row["artefact"] == cell.place:
                yield [*place, row["sub_goal"], row["member"], row["scope"], row["quantity"], row["value"]]


if __name__ == "__main__":  # the last job of a run on Slurm
    write_results(read_plan(Path(sys.argv[1])), Path(sys.argv[1]))
