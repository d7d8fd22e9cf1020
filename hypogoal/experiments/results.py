"""``results.csv``: every number of a sweep, one per row, with its place in the experiment (Spec G4).

Made from the sweep's evaluation, and from the artefacts of cells that it does not cover. It contains nothing that
differs between two runs of the same commands: no time, no machine, no path.
"""

from collections.abc import Iterator, Sequence
from operator import attrgetter
from pathlib import Path
from typing import Any

from hypogoal.core.artefacts import Artefact, open_artefact
from hypogoal.core.errors import UserError
from hypogoal.core.files import json_lines, read_text, write_table
from hypogoal.core.manifests import AGAIN, LOG, NUMBERS_CSV
from hypogoal.core.own_code import command
from hypogoal.data import open_dataset
from hypogoal.evaluation import curves, distance
from hypogoal.evaluation.numbers import grouped
from hypogoal.evaluation.run import read_layout
from hypogoal.evaluation.table import Row, defined, read_rows, rows_of, select
from hypogoal.experiments.cells import COLUMNS, Cell, Plan
from hypogoal.experiments.records import RESULTS
from hypogoal.experiments.status import done_of
from hypogoal.options.tables import Episodes, Executions

SCOPES = ("", "labelled", "unlabelled", "heldout", "unseen", "all")  # of what is listed


def write_results(plan: Plan, run: Path) -> Path:
    """Write ``results.csv``, every number of the cells done; a damaged artefact is a ``UserError``."""
    names = list(dict.fromkeys(name for cell in plan.cells for name, _ in cell.axes))
    path = run / RESULTS
    try:
        write_table(path, ["cell", "stage", *names, *COLUMNS], _lines(plan, run, names))
    except (LookupError, TypeError, ValueError, AttributeError, ArithmeticError) as error:
        problem = f"an artefact is damaged ({type(error).__name__} {error})"
        raise UserError(problem, run, f"Which one: {command('verify', run)}") from None
    return path


def _lines(plan: Plan, run: Path, names: Sequence[str]) -> Iterator[list[Any]]:
    outs = done_of(plan, run)
    done = [cell for cell in plan.cells if cell.out in outs]
    evaluated: dict[str, list[Row]] = {}
    for cell in done:
        if cell.stage == "evaluate":
            listed = select(read_rows(cell.out / NUMBERS_CSV), step="", scope=SCOPES)
            evaluated = grouped(listed, attrgetter("artefact"))
    for cell in done:
        axes = dict(cell.axes)
        place = [cell.name, cell.stage, *(axes.get(name, "") for name in names)]
        for row in defined(_of_cell(cell, evaluated.get(cell.out.relative_to(run).as_posix(), []))):
            yield [*place, row.sub_goal, row.member, row.scope, row.quantity, row.value]


def _of_cell(cell: Cell, evaluated: Sequence[Row]) -> Iterator[Row]:
    """A cell's numbers: the counts of collected states, the last logged losses of each sub-goal's ensemble, the
    evaluation's numbers of a run or of options, and the success of random play where an agent was trained.

    Numbers that the evaluation lacks, because it is not made or counts the artefact as a part of others, are made here.
    """
    if cell.stage == "collect":
        yield from _states(cell.out)
        return
    artefact = open_artefact(cell.out)
    if artefact.kind == "ensemble":
        yield from _losses(artefact)
    files = artefact.manifest["files"] if artefact.kind in ("options", "meta", "baseline") else {}
    yield from evaluated
    if "executions.csv" in files:
        if not evaluated:
            config, executions = artefact.config, Executions.read(artefact.path / "executions.csv")
            more = {"masked": config["mask_reached"], "seed": artefact.seed}
            yield from distance.rows_of_ladder(executions, config["sub_goals"], config["members"], {}, **more)
    elif "episodes.csv" in files:
        layout = read_layout(artefact.path / "layout.json")
        if not evaluated:
            episodes = Episodes.read(artefact.path / "episodes.csv")
            run = curves.Run(artefact.kind, "", artefact.seed, artefact.config, episodes, layout)
            yield from curves.rows_of_run(run, "")
        yield from rows_of({"random_success": layout["random_success"]})


def _states(path: Path) -> Iterator[Row]:
    counts = open_dataset(path).counts()
    for split in ("labelled", "heldout"):
        for sub_goal, row in counts[split].items():
            yield from rows_of(row, sub_goal=sub_goal, scope=split)
    yield from rows_of({"states": counts["unlabelled"]}, scope="unlabelled")


def _losses(artefact: Artefact) -> Iterator[Row]:
    last: dict[str, dict[str, Any]] = {}
    for row in json_lines(read_text(artefact.path / LOG, "the log is", AGAIN).splitlines()):
        last[row["sub_goal"]] = row
    for sub_goal, row in last.items():
        yield from rows_of(row, sub_goal=sub_goal)
