"""``results.csv``: the numbers of a run's evaluation, each with its cell's place in the experiment (Spec G4)."""

import csv
import sys
from collections.abc import Sequence
from pathlib import Path

from hypogoal.core.files import write_table
from hypogoal.experiments.sweep import Cell, read_plan

SCOPES = ("", "labelled", "unlabelled", "heldout", "unseen", "all")  # of what is listed
COLUMNS = ("sub_goal", "member", "scope", "quantity", "value")


def write_results(cells: Sequence[Cell], run: Path) -> None:
    """Write ``results.csv``, if there is an evaluation; learning curves are in its ``numbers.csv`` alone."""
    path = run / "evaluation" / "numbers.csv"
    if not path.exists():
        return
    with path.open(encoding="utf-8", newline="") as file:
        numbers = [row for row in csv.DictReader(file) if not row["step"] and row["scope"] in SCOPES]
    names: dict[str, None] = {}  # in the order in which cells bring them
    for cell in cells:
        names |= dict.fromkeys(cell.columns)
    rows = []
    for cell in cells:
        place = [cell.columns.get(name, "") for name in names]
        for row in numbers:
            if row["artefact"] == cell.place:
                number = [row[column] for column in COLUMNS]
                rows.append([cell.name, cell.stage, *place, *number])
    write_table(run / "results.csv", ["cell", "stage", *names, *COLUMNS], rows)


if __name__ == "__main__":  # the last job of a run on Slurm
    write_results(read_plan(Path(sys.argv[1])), Path(sys.argv[1]))
