"""What a sweep records beside its cells' outputs: its plan, and how each cell went (Spec G4).

``sweep.json`` is the plan, in which the run's folder is called ``{run}``: the folder can be moved, and every machine
that sees it can read it. ``logs/NAME.log`` is a cell's output; the process that holds the kernel's lock on it runs the
cell. The cell's processes inherit the lock, so it ends with the last of them. ``logs/NAME.json`` is the cell's record.
"""

import json
import socket
import time
from collections.abc import Sequence, Set
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, BinaryIO

from hypogoal.core.drafts import PATIENCE_SECONDS
from hypogoal.core.errors import UserError
from hypogoal.core.files import open_file, path_part, read_end, read_json, replace_text
from hypogoal.core.locks import try_lock
from hypogoal.core.schemas import LARGEST, Schema, is_amount, is_count, is_list, is_table, is_text, misfit
from hypogoal.experiments.cells import DERIVED, RESERVED, Cell, Plan, closing_cells, moved
from hypogoal.settings import STAGES

FORMAT_VERSION = 3  # 2, of 0.23: with forecasts of seconds and memory, which are ignored
PLAN, LOGS, RESULTS, FINISHED = "sweep.json", "logs", "results.csv", "run.json"
RUN = "{run}"
AGAIN = "Start the sweep again."
GIVE = "Give the command that began it, of 'run' with --resume and without --force: what is complete is kept."


@dataclass(frozen=True)
class Record:
    """How a cell has gone so far."""

    attempts: int = 0  # how often it was started
    seconds: float = 0.0  # total time of the attempts that ended
    code: int | None = None  # exit code, minus the signal that ended it; None: it runs, or died with its runner
    started: float = 0.0  # when the last attempt began, Unix time; for people only
    host: str = ""  # where


def log_of(run: Path, cell: Cell) -> Path:
    """The log of a cell."""
    return run / LOGS / f"{cell.name}.log"


def last_line(log: Path) -> str:
    """The last line of a cell's log."""
    lines = read_end(log)
    return lines[-1] if lines else "started" if log.is_file() else ""


def read_record(run: Path, cell: Cell) -> Record:
    """A cell's record; an empty one if it was never started or its record cannot be read."""
    try:
        record = read_json(run / LOGS / f"{cell.name}.json", "the record is", AGAIN)
    except UserError:
        return Record()
    fits = misfit(record, {}, RECORD) is None
    return Record(**{key: record[key] for key in RECORD if key in record}) if fits else Record()


def write_record(run: Path, cell: Cell, record: Record) -> None:
    """Write a cell's record."""
    replace_text(run / LOGS / f"{cell.name}.json", json.dumps(asdict(record)) + "\n")


def begun(before: Record) -> Record:
    """The record of a cell that is about to start."""
    return Record(before.attempts + 1, before.seconds, None, time.time(), socket.gethostname())


def open_log(run: Path, cell: Cell) -> BinaryIO:
    """A cell's log to append to, locked: while it or a copy is open, others who start the cell get a ``UserError``."""
    path = log_of(run, cell)
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.parent.is_symlink() or path.is_symlink() or (path.exists() and not path.is_file()):
        raise UserError("the cell's log is a link, or no regular file", path, "Remove it.")
    log = path.open("ab", buffering=0)
    until = time.monotonic() + PATIENCE_SECONDS  # for processes that are dying or only look
    while try_lock(log) is False:
        if time.monotonic() > until:
            log.close()
            host = read_record(run, cell).host
            raise UserError(f"{cell.name} is being run by another process ({host})", path, "Wait until it is done.")
        time.sleep(0.05)
    return log


def is_running(run: Path, cell: Cell) -> bool:
    """Whether a process on any machine runs the cell.

    If the file system cannot lock, a cell that was started and has not ended counts as running.
    """
    try:
        with open_file(log_of(run, cell), "the log is", AGAIN) as log:
            is_free = try_lock(log, shared=True)
    except (OSError, UserError):
        return False
    record = read_record(run, cell)
    return not is_free if is_free is not None else record.attempts > 0 and record.code is None


def write_plan(run: Path, plan: Plan) -> None:
    """Write the plan into the run's folder."""
    run.mkdir(parents=True, exist_ok=True)
    head = {"format": FORMAT_VERSION, "experiment": plan.experiment, "workers": plan.workers}
    head |= {"anew": sorted(plan.anew)} if plan.anew else {}
    lines = ",\n".join(f"  {json.dumps(_row(cell, run))}" for cell in plan.cells)
    replace_text(run / PLAN, f'{json.dumps(head)[:-1]}, "cells": [\n{lines}\n]}}\n')


def _row(cell: Cell, run: Path) -> dict[str, Any]:
    """What is written of a cell."""
    cell = moved(cell, str(run), RUN)
    places = {"out": str(cell.out), "needs": [str(need) for need in cell.needs]}
    return {"name": cell.name, "arguments": [*cell.arguments], **places, "axes": dict(cell.axes), "cores": cell.cores}


class LostPlan(UserError):
    """The plan of a sweep exists but cannot be read."""


def read_plan(run: Path) -> Plan:
    """The plan of a run's folder; none is a ``UserError``, a damaged one is ``LostPlan``."""
    path = run / PLAN
    if not path.is_file():
        raise UserError("no sweep here", run, "Give the folder of a sweep that was started as --out.")
    try:
        content = read_json(path, "the sweep's plan is", GIVE)
    except UserError as error:
        raise LostPlan(error.what, path, GIVE) from None
    if isinstance(content, dict) and is_count(content.get("format")) and content["format"] > FORMAT_VERSION:
        raise UserError("the sweep's plan is of a newer format", path, "Upgrade hypogoal.")
    key = misfit(content, PLAN_KEYS, PLAN_MAY)
    if key is not None:
        raise LostPlan(f"the sweep's plan is damaged ({key or 'no JSON object'})", path, GIVE)
    cells, outs = [], set[Path]()
    for row in content["cells"]:
        needs, axes = tuple(map(Path, row["needs"])), tuple(row["axes"].items())
        cell = Cell(row["name"], tuple(row["arguments"]), Path(row["out"]), needs, row["cores"], axes)
        cells.append(moved(cell, RUN, str(run)))
        if not outs.issuperset(cells[-1].needs) or cells[-1].out in outs:
            raise LostPlan(f"the sweep's plan is damaged (what {cell.name} needs or writes)", path, GIVE)
        outs.add(cells[-1].out)
    if len({cell.name for cell in cells}) < len(cells):
        raise LostPlan("the sweep's plan is damaged (the names of cells)", path, GIVE)
    return Plan(content["experiment"], cells, content["workers"], frozenset(content.get("anew", ())))


def _is_place(value: Any) -> bool:
    """Whether a text is a path within the run."""
    parts = Path(value).parts if is_text(value) else ()
    return len(parts) > 1 and parts[0] == RUN and all(map(path_part, parts))


def _is_cell(row: Any) -> bool:
    """Whether this can be a cell: its command must be a stage that stays within the run."""
    if misfit(row, CELL) is not None:
        return False
    words, out = row["arguments"], row["out"]
    if words[:1] and words[0] in DERIVED:  # they read the run
        return (words, out) in [([*cell.arguments], str(cell.out)) for cell in closing_cells(Path(RUN), ())]
    reserved = [pair for pair in pairwise([*words, ""]) if pair[0].split("=")[0] in RESERVED]
    is_stage = words[:1] and words[0] in STAGES and all(pair == ("--out", out) for pair in reserved)
    return bool(is_stage) and all(map(_is_place, (word for word in words if word.startswith(RUN))))


# What is read of a record and of a plan.
RECORD: Schema = {
    "attempts": is_count,
    "seconds": is_amount,
    "code": lambda value: value is None or (type(value) is int and abs(value) < 1 << 16),
    "started": lambda value: type(value) in (int, float) and abs(value) <= LARGEST,  # of a clock that may be wrong
    "host": is_text,
}
CELL: Schema = {
    "name": path_part,
    "arguments": is_list(is_text),
    "out": _is_place,
    "needs": is_list(_is_place),
    "axes": is_table(lambda value: is_text(value) or isinstance(value, int | float)),
    "cores": lambda value: is_count(value) and value > 0,
}
PLAN_KEYS: Schema = {
    "format": is_count,
    "experiment": is_text,
    "workers": lambda value: is_count(value) and value > 0,
    "cells": is_list(_is_cell),
}
PLAN_MAY: Schema = {"anew": is_list(is_text)}


def check_same(run: Path, cells: Sequence[Cell], anew: Set[str] = frozenset()) -> None:
    """Refuse (``UserError``) cells that lack any of the folder's plan, or have other commands.

    The commands of those called ``anew`` may be others.
    """
    do = "Give the settings it was begun with, --from STAGE to make a stage anew with these, or another --out."
    by_place = {cell.out: cell for cell in cells}
    for cell in read_plan(run).cells:
        if cell.out not in by_place:
            raise UserError(f"the sweep here has a cell that this one lacks: {cell.name}", run, do)
        old, new = _meaning(cell), _meaning(by_place[cell.out])
        if old != new and cell.name not in anew:
            first, second = (
                next((part for key, part in a.items() if b.get(key) != part), "") for a, b in ((old, new), (new, old))
            )
            raise UserError(f"{cell.name} of the sweep here was begun with '{first}', not '{second}'", run, do)


def _meaning(cell: Cell) -> dict[tuple[str, str], str]:
    """A cell's command in parts, whose order does not matter; of a setting the last counts."""
    return {(part[0], part[-1].partition("=")[0]): " ".join(part) for part in cell.parts}
