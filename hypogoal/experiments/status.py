"""How far a sweep is, from its files alone: during and after it, on any machine that sees them (Spec A8, G4).

A cell is finished when its output's manifest says so and agrees with the files and inputs. That reads the output's
files once (some ms per MB); ``hypogoal verify`` checks their content, too.
"""

import stat
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hypogoal.core.artefacts import MANIFEST, check_files, find_input, open_artefact, sha256_of
from hypogoal.core.errors import UserError
from hypogoal.core.progress import duration, said_left
from hypogoal.dataset import open_dataset
from hypogoal.evaluation.run import find
from hypogoal.experiments.cells import DERIVED, Cell, Plan
from hypogoal.experiments.records import Record, is_running, last_line, log_of, read_plan, read_record

DONE, RUNNING, FAILED, STOPPED, WAITING, HELD = "done", "running", "failed", "stopped", "waiting", "held"
STOPS = (None, 0, 130, 143, -2, -15)  # exit codes of cells that were stopped, or died with their runner
MOST_SHOWN = 20


@dataclass(frozen=True)
class State:
    """How far one cell is."""

    cell: Cell
    state: str  # see above: stopped cells go on at the next start, held ones need a failed one
    record: Record
    text: str = ""  # the last line of its log, if it runs or failed


@dataclass(frozen=True)
class Status:
    """How far all cells of a sweep are."""

    run: Path
    experiment: str
    states: list[State]
    seconds_left: float | None

    def count(self, *states: str) -> int:
        """How many cells are in these states."""
        return sum(row.state in states for row in self.states)


def read_status(run: Path) -> Status:
    """The state of every cell; done means :func:`done_of`, which the next start checks file by file."""
    plan, factor = read_plan(run)
    states: list[State] = []
    done = done_of(plan)
    bad: set[Path] = set()
    for cell in plan.cells:
        record = read_record(run, cell)
        if is_running(run, cell):
            state = RUNNING
        elif cell.out in done:
            state = DONE
        elif record.code not in STOPS:
            state = FAILED
        elif not bad.isdisjoint(cell.needs):
            state = HELD
        else:
            state = STOPPED if record.attempts else WAITING
        if state in (FAILED, HELD):
            bad.add(cell.out)
        states.append(State(cell, state, record, last_line(log_of(run, cell)) if state in (RUNNING, FAILED) else ""))
    return Status(run, plan.experiment, states, time_left(states, plan.workers, factor))


def done_of(plan: Plan) -> set[Path]:
    """The outputs of cells that are done: complete, as a manifest says, and not to be made again.

    An evaluation or report of less than the plan now has, or of something else, is not done.
    """
    done: set[Path] = set()
    for cell in plan.cells:
        if cell.name in plan.anew or stamp_of(cell) is None:
            continue
        if cell.stage not in DERIVED or (done.issuperset(cell.needs) and is_current(cell)):
            done.add(cell.out)
    return done


def time_left(states: Sequence[State], workers: int, factor: float) -> float | None:
    """Seconds until every cell that can be done is done; None if nothing is known of one of those left.

    Estimates are scaled by what done cells took; without an estimate, done cells of the same stage are the guide.
    """
    done = [row for row in states if row.state == DONE and row.record.seconds > 0]
    estimated = [row for row in done if row.cell.cost.seconds > 0]
    if estimated:
        factor = sum(row.record.seconds for row in estimated) / sum(row.cell.cost.seconds for row in estimated)
    left = []
    for row in states:
        if row.state in (DONE, FAILED, HELD):
            continue
        alike = [other.record.seconds for other in done if other.cell.stage == row.cell.stage]
        if row.cell.cost.seconds > 0:
            seconds = factor * row.cell.cost.seconds
        elif alike:
            seconds = sum(alike) / len(alike)
        elif row.cell.stage == "report":
            seconds = 0.0
        else:
            return None
        if (remaining := said_left(row.text)) is not None:  # the cell's own forecast is better
            left.append(remaining)
            continue
        spent = row.record.seconds + (time.time() - row.record.started if row.state == RUNNING else 0.0)
        left.append(max(0.0, seconds - spent))
    return max(sum(left) / workers, max(left, default=0.0))


def lines(status: Status) -> list[str]:
    """The status as text: a line of numbers, then the cells that run or failed."""
    left = status.count(STOPPED, WAITING, HELD)
    numbers = [f"{status.count(state)} {state}" for state in (DONE, RUNNING, FAILED)]
    held = f" ({status.count(HELD)} wait for failed ones)" if status.count(HELD) else ""
    head = f"{status.run}: {status.experiment}, {len(status.states)} cells: {', '.join(numbers)}, {left} left{held}"
    text = [head]
    if status.count(RUNNING, STOPPED, WAITING):
        unknown = status.seconds_left is None
        text.append("time left: not known yet" if unknown else f"time left: about {duration(status.seconds_left or 0)}")
        if not status.count(RUNNING):
            text.append("nothing runs now; what is not queued goes on when the sweep is started again")
    for state in (RUNNING, FAILED):
        shown = [row for row in status.states if row.state == state]
        for row in shown[:MOST_SHOWN]:
            host = row.record.host if state == RUNNING else ""
            where = f" on {host}" if host else f" ({log_of(status.run, row.cell)})"
            text.append(f"  {state} {row.cell.name}{where}: {row.text}")
        if len(shown) > MOST_SHOWN:
            text.append(f"  and {len(shown) - MOST_SHOWN} more {state}")
    return text


def as_json(status: Status) -> dict[str, Any]:
    """The status for programs."""
    return {
        "run": str(status.run),
        "experiment": status.experiment,
        "seconds_left": status.seconds_left,
        "counts": {state: status.count(state) for state in (DONE, RUNNING, FAILED, STOPPED, WAITING, HELD)},
        "cells": [
            {
                "name": row.cell.name,
                "state": row.state,
                "attempts": row.record.attempts,
                "seconds": round(row.record.seconds, 1),
                "code": row.record.code,
                "host": row.record.host,
                "text": row.text,
            }
            for row in status.states
        ],
    }


def is_finished(cell: Cell) -> bool:
    """Whether the cell's output is complete and made from its present inputs, which must be complete.

    An evaluation or report of less than the run now has, or of something else, is not finished. The output of a
    training stage may be weeks of work and is never replaced: one of something else, or changed, is a ``UserError``.
    """
    if not cell.out.exists() or (cell.out.is_dir() and not any(cell.out.iterdir())):
        return False
    where: Path | None = cell.out
    try:
        fault = _fault(cell)
    except UserError as error:
        fault, where = str(error), None
    if fault and cell.stage not in DERIVED:
        raise UserError(fault, where, "Move it out of the run to have it made again.")
    return not fault


def stamp_of(cell: Cell) -> tuple[int, int] | None:
    """Identifies the complete output of a cell: its inode, and when it was written, in ns; None: there is none."""
    place = cell.out if cell.stage == "collect" else cell.out / MANIFEST
    try:
        status = place.stat()
    except OSError:
        return None
    return (status.st_ino, status.st_mtime_ns) if stat.S_ISREG(status.st_mode) else None


def left_of(cells: Sequence[Cell]) -> list[Cell]:
    """The cells that are not :func:`is_finished`, with the evaluation and report that read any of them."""
    left: list[Cell] = []
    pending: set[Path] = set()
    for cell in cells:
        if (cell.stage in DERIVED and not pending.isdisjoint(cell.needs)) or not is_finished(cell):
            left.append(cell)
            pending.add(cell.out)
    return left


def _fault(cell: Cell) -> str:
    """What is wrong with an existing output; empty if nothing is."""
    if cell.stage == "collect":
        open_dataset(cell.out)
        return ""
    artefact = open_artefact(cell.out)
    if damage := check_files(artefact):
        return damage[0]
    for entry in artefact.manifest["inputs"]:
        if find_input(artefact.path, entry)[1].startswith("changed"):
            return f"its input {entry['path']} was changed since"
    return "it is of other artefacts" if cell.stage in DERIVED and not is_current(cell) else ""


def is_current(cell: Cell) -> bool:
    """Whether an existing evaluation or report read the present outputs, as manifests say; no other file is read.

    Times of files say nothing: copies of a run have other ones.
    """
    try:
        read = {entry["sha256"] for entry in open_artefact(cell.out).manifest["inputs"]}
        run = Path(cell.arguments[1])
        sources = [part.path for part in find(run).everything()] if cell.stage == "evaluate" else cell.needs
        return read.issuperset(sha256_of(path / MANIFEST) for path in sources)
    except (UserError, OSError):
        return False
