"""``results.csv``: every number of a sweep, one a row, with its place in the experiment (Spec G4).

Made from the cells' own artefacts, and for the members of ensembles from the evaluation, which judged them. Nothing
that differs between two runs of the same commands is in it: no time, no machine, no path.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from hypogoal.core.artefacts import Artefact, open_artefact
from hypogoal.core.errors import UserError
from hypogoal.core.files import read_json, read_text, write_table
from hypogoal.dataset import open_dataset
from hypogoal.evaluation.curves import run_numbers
from hypogoal.evaluation.distance import ladder_numbers
from hypogoal.evaluation.reading import read_episodes, read_executions, read_layout
from hypogoal.experiments.cells import Cell, Plan
from hypogoal.experiments.records import RESULTS
from hypogoal.experiments.status import done_of

AGAIN = "Make the artefact again."


class Number(NamedTuple):
    """One number of a cell: of which sub-goal, member and set of states, where that is said of it."""

    number: str
    value: float | int
    sub_goal: str = ""
    member: int | str = ""
    scope: str = ""


def write_results(plan: Plan, run: Path) -> Path:
    """Gather every number of the cells that are done and write ``results.csv``, whole or not at all.

    Raises:
        UserError: an artefact is damaged.
    """
    names = list(dict.fromkeys(name for cell in plan.cells for name, _ in cell.axes))
    columns = ["cell", "stage", *names, *Number._fields[2:], *Number._fields[:2]]
    path = run / RESULTS
    try:
        write_table(path, columns, _rows(plan, run, names))
    except (KeyError, TypeError, ValueError, AttributeError, IndexError) as error:
        what = f"an artefact is damaged ({type(error).__name__} {error})"
        raise UserError(what, run, "'hypogoal verify' says which.") from None
    return path


def _rows(plan: Plan, run: Path, names: Sequence[str]) -> Iterator[list[Any]]:
    done = done_of(plan)
    judged = _judged([cell for cell in plan.cells if cell.out in done])
    for cell in plan.cells:
        if cell.out not in done:
            continue
        axes = dict(cell.axes)
        about = [cell.name, cell.stage, *(axes.get(name, "") for name in names)]
        for number in (*_numbers(cell), *judged.get(cell.out.relative_to(run).as_posix(), ())):
            if math.isfinite(number.value):
                yield [*about, *number[2:], number.number, number.value]


def _numbers(cell: Cell) -> Iterator[Number]:
    if cell.stage == "collect":
        yield from _states(cell.out)
        return
    artefact = open_artefact(cell.out)
    files = artefact.manifest["files"]
    if artefact.kind == "ensemble":
        yield from _losses(artefact)
    if "executions.csv" in files:
        yield from _distances(artefact)
    elif "episodes.csv" in files and artefact.kind in ("options", "meta", "baseline"):
        layout = read_layout(artefact.path / "layout.json")
        numbers = run_numbers(read_episodes(artefact.path / "episodes.csv"), layout["shortest_path"])
        facts = {name: layout[name] for name in ("shortest_path", "random_success")}
        steps = artefact.config["steps"] + artefact.manifest["config"].get("options_steps", 0)
        yield from _named({"steps": steps, **numbers, **facts})


def _named(numbers: Mapping[str, Any], **place: Any) -> Iterator[Number]:
    for name, value in numbers.items():
        if isinstance(value, int | float) and not isinstance(value, bool):
            yield Number(name, value, **place)


def _states(path: Path) -> Iterator[Number]:
    counts = open_dataset(path).counts()
    for split in ("labelled", "heldout"):
        for sub_goal, row in counts[split].items():
            yield from _named(row, sub_goal=sub_goal, scope=split)
    yield Number("states", counts["unlabelled"], scope="unlabelled")


def _losses(artefact: Artefact) -> Iterator[Number]:
    """The last that was logged of each sub-goal."""
    last: dict[str, dict[str, Any]] = {}
    for line in read_text(artefact.path / "metrics.jsonl", "the log is", AGAIN).splitlines():
        row = json.loads(line)
        last[row["sub_goal"]] = row
    for sub_goal, row in last.items():
        yield from _named(row, sub_goal=sub_goal)


def _distances(artefact: Artefact) -> Iterator[Number]:
    config = artefact.config
    executions = read_executions(artefact.path / "executions.csv")
    masked = config["mask_reached"]
    for row in ladder_numbers(executions, config["sub_goals"], config["members"], {}, masked=masked):
        for option in row["options"]:
            numbers = {name: value for name, value in option.items() if name not in ("member", "option")}
            yield from _named(numbers, sub_goal=row["sub_goal"], member=option["member"])


def _judged(cells: Iterable[Cell]) -> dict[str, list[Number]]:
    """What the sweep's evaluation says of each ensemble, by its path within the run; empty where there is none yet."""
    found: dict[str, list[Number]] = {}
    for cell in cells:
        if cell.stage != "evaluate":
            continue
        metrics = read_json(cell.out / "metrics.json", "the evaluation's numbers are", AGAIN)
        for ensemble in metrics["ensembles"]:
            found[ensemble["path"]] = [number for row in ensemble["sub_goals"] for number in _of_sub_goal(row)]
    return found


def _of_sub_goal(row: Mapping[str, Any]) -> Iterator[Number]:
    """Spec F1: every member on held-out states; on the ladders apart for rooms that no training set holds."""
    yield from _members(row["sub_goal"], row["members"], "heldout")
    for scope, own in row.get("rooms", {}).get("scopes", {}).items():
        yield from _members(row["sub_goal"], own["members"], scope)
    for states in ("heldout", "unlabelled"):
        yield from _named({"disagreement": row["disagreement"][states]}, sub_goal=row["sub_goal"], scope=states)


def _members(sub_goal: str, rows: Iterable[Mapping[str, Any]], scope: str) -> Iterator[Number]:
    for row in rows:
        numbers = {name: value for name, value in row.items() if name != "member"}
        yield from _named(numbers, sub_goal=sub_goal, member=row["member"], scope=scope)
