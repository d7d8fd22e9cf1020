"""Initiation sets learned from executions: agents with and without them, on DoorKey and on one ladder.

    python -m studies.initiation docs/results/initiation.csv --runs RUNS

reads the artefacts ``RUNS/meta/{anywhere,learned}-LAYOUT`` and ``RUNS/ladder/{anywhere,learned}-SEED``; without
``--runs`` it prints the tables of the file.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from hypogoal.core.artefacts import open_artefact
from hypogoal.evaluation.curves import read_run, run_numbers
from hypogoal.options.tables import Executions
from studies.cells import parser_of, read_rows, table, write_rows

SWITCH = ("anywhere", "learned")
COLUMNS = ("task", "layout", "seed", "initiation", "quantity", "value")
Cells = dict[tuple[str, int, str, str], float]


def gather(runs: Path) -> Iterator[dict[str, str | float | int]]:
    """The rows of the finished runs."""
    for path in sorted(runs.glob("meta/*")):
        artefact = open_artefact(path, "meta")
        run = read_run(artefact, path.name)
        numbers = run_numbers(run.episodes, run.layout["shortest_path"])
        place = {"task": "doorkey", "layout": artefact.config["layout_seed"], "seed": artefact.seed}
        for quantity in ("steps_to_95", "success", "length"):
            value = numbers[quantity]
            yield {**place, "initiation": artefact.config["initiation"], "quantity": quantity, "value": value or 0}
    for path in sorted(runs.glob("ladder/*")):
        artefact = open_artefact(path, "options")
        executions = Executions.read(path / Executions.FILE)
        members = [executions.of(member) for member in range(artefact.config["members"])]
        inside = float(np.mean([np.mean(last.reached & (last.distance == 0)) for last in members]))
        place = {"task": f"ladder {artefact.config['start']}", "layout": "", "seed": artefact.seed}
        yield {**place, "initiation": artefact.config["initiation"], "quantity": "inside", "value": round(inside, 4)}


def cells_of(path: Path) -> Cells:
    """The value of each (task, layout or seed, initiation, quantity)."""
    return {
        (row["task"], int(row["layout"] or row["seed"]), row["initiation"], row["quantity"]): float(row["value"])
        for row in read_rows(path)
    }


def tables(path: Path) -> Iterator[str]:
    """Steps to 95 % and success on each layout; the share of executions that end inside on the ladder."""
    cells = cells_of(path)
    places = sorted({(task, place) for task, place, _, _ in cells})
    yield from table(
        ["task", "steps to 95 %, anywhere", "learned", "last 100 solved or inside, anywhere", "learned"],
        (
            [f"{task}, {'layout' if task == 'doorkey' else 'seed'} {place}", *_steps(cells, task, place)]
            + [f"{cells[task, place, switch, 'success' if task == 'doorkey' else 'inside']:.2f}" for switch in SWITCH]
            for task, place in places
        ),
    )


def _steps(cells: Cells, task: str, place: int) -> list[str]:
    steps = [cells.get((task, place, switch, "steps_to_95")) for switch in SWITCH]
    return ["-" if value is None else f"{value / 1000:.0f} k" if value else "never" for value in steps]


def main() -> None:
    """Gather, or print."""
    parser = parser_of(__doc__)
    parser.add_argument("--runs", type=Path, help="the folder with the runs' artefacts")
    arguments = parser.parse_args()
    if arguments.runs:
        write_rows(arguments.csv, COLUMNS, gather(arguments.runs))
    print("\n".join(tables(arguments.csv)))


if __name__ == "__main__":
    main()
