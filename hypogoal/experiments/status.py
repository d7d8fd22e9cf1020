"""How far a sweep is, from its files alone: during and after it, on any machine that sees them (Spec A8, G4).

A cell is finished when its output's manifest says so and agrees with the files and inputs. That reads the output's
files once (some ms per MB); ``hypogoal verify`` checks their content, too.
"""

import stat
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from hypogoal.core.artefacts import MANIFEST, check_files, find_input, open_artefact
from hypogoal.core.drafts import drafts_in
from hypogoal.core.errors import UserError
from hypogoal.core.manifests import digest_of
from hypogoal.core.progress import duration
from hypogoal.core.terminal import amount
from hypogoal.data import open_dataset
from hypogoal.evaluation.run import find
from hypogoal.experiments.cells import DERIVED, Cell, Plan
from hypogoal.experiments.records import Record, is_running, last_line, log_of, read_plan, read_record

DONE, RUNNING, FAILED, STOPPED, WAITING, HELD = "done", "running", "failed", "stopped", "waiting", "held"
STOPS = (None, 0, 130, 143, -2, -15)  # exit codes of cells that were stopped, or died with their runner
MOST_SHOWN = 20
INTERRUPTED = "interrupted; its command with --resume continues it"


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
    plan = read_plan(run)
    states: list[State] = []
    done, bad = done_of(plan, run), set[Path]()
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
    return Status(run, plan.experiment, states, time_left(states, plan.workers))


def done_of(plan: Plan, run: Path) -> set[Path]:
    """The outputs of cells that are done: complete, as a manifest says, and not to be made again.

    An evaluation or report of less than the plan now has, or of something else, is not done.
    """
    done: set[Path] = set()
    for cell in plan.cells:
        if stamp_of(cell) is None or to_remake(plan, run, cell):
            continue
        if cell.stage not in DERIVED or (done.issuperset(cell.needs) and is_current(cell)):
            done.add(cell.out)
    return done


def to_remake(plan: Plan, run: Path, cell: Cell) -> bool:
    """Whether a cell is still to be made again: no attempt since ``run --force`` succeeded."""
    return cell.name in plan.anew and read_record(run, cell).code != 0


def time_left(states: Sequence[State], workers: int) -> float | None:
    """Seconds until every cell that can be done is done; None if nothing is known of one of those left.

    A cell takes as long as those of its stage that are done.
    """
    left = []
    for row in states:
        if row.state in (DONE, FAILED, HELD) or row.cell.stage in DERIVED:
            continue
        alike = [other.record.seconds for other in states if (other.state, other.cell.stage) == (DONE, row.cell.stage)]
        if not any(alike):
            return None
        seconds = sum(alike) / len(alike)
        spent = row.record.seconds + (time.time() - row.record.started if row.state == RUNNING else 0.0)
        left.append(max(0.0, seconds - spent))
    return max(sum(left) / workers, max(left, default=0.0))


def lines(status: Status) -> list[str]:
    """The status as text: a line of numbers, then the cells that run or failed."""
    numbers = [f"{status.count(state)} {state}" for state in (DONE, RUNNING, FAILED)]
    left, held = status.count(STOPPED, WAITING, HELD), status.count(HELD)
    numbers.append(f"{left} left{f' ({held} wait for failed ones)' if held else ''}")
    text = [f"{status.run}: {status.experiment}, {amount(len(status.states), 'cell')}: {', '.join(numbers)}"]
    if status.count(RUNNING, STOPPED, WAITING):
        seconds = status.seconds_left
        text.append(f"time left: {'not known yet' if seconds is None else f'about {duration(seconds)}'}")
        if not status.count(RUNNING):
            text.append("nothing runs now; what is not queued goes on when the sweep is started again")
    for state in (RUNNING, FAILED):
        shown = [row for row in status.states if row.state == state]
        for row in shown[:MOST_SHOWN]:
            where = f" on {row.record.host}" if state == RUNNING else f" ({log_of(status.run, row.cell)})"
            text.append(f"  {state} {row.cell.name}{where}: {row.text}")
        if len(shown) > MOST_SHOWN:
            text.append(f"  and {len(shown) - MOST_SHOWN} more {state}")
    return text


def in_the_making(path: Path) -> list[str]:
    """A line for each output below a path that is not complete, and for its sweep how many cells are done."""
    text = [f"{place}: {'in progress' if active else INTERRUPTED}" for place, active in drafts_in(path).items()]
    try:
        status = read_status(path)
    except UserError:  # no sweep
        return text
    left = len(status.states) - status.count(DONE)
    return [*text, f"{path}: {status.count(DONE)} of {amount(len(status.states), 'cell')} done"] if left else text


def as_json(status: Status) -> dict[str, Any]:
    """The status for programs."""
    counts = {state: status.count(state) for state in (DONE, RUNNING, FAILED, STOPPED, WAITING, HELD)}
    cells = [
        {"name": row.cell.name, "state": row.state, **asdict(row.record), "text": row.text} for row in status.states
    ]
    head = {"run": str(status.run), "experiment": status.experiment, "seconds_left": status.seconds_left}
    return {**head, "counts": counts, "cells": cells}


def is_finished(cell: Cell) -> bool:
    """Whether the cell's output is complete and made from its present inputs, which must be complete.

    An evaluation or report of less than the run now has, or of something else, is not finished. The output of a
    training stage may be weeks of work and is never replaced: one of something else, or changed, is a ``UserError``.
    """
    if not cell.out.exists() or (cell.out.is_dir() and not any(cell.out.iterdir())):
        return False
    try:
        if cell.stage == "collect":
            open_dataset(cell.out)
            return True
        artefact = open_artefact(cell.out)
        faults = check_files(artefact)
        inputs = artefact.manifest["inputs"]
        changed = [entry["path"] for entry in inputs if find_input(artefact.path, entry)[1].startswith("changed")]
        faults += [f"its input {path} was changed since" for path in changed]
    except UserError as error:
        faults = [error.what]
    if cell.stage in DERIVED:
        return not faults and is_current(cell)
    if faults:
        do = f"Give --from {cell.stage}, or move it out of the run, to have it made again."
        raise UserError(faults[0], cell.out, do)
    return True


def stamp_of(cell: Cell) -> tuple[int, int] | None:
    """Identifies the complete output of a cell: its inode, and when it was written, in ns; None: there is none."""
    place = cell.out if cell.stage == "collect" else cell.out / MANIFEST
    try:
        status = place.stat()
    except OSError:
        return None
    return (status.st_ino, status.st_mtime_ns) if stat.S_ISREG(status.st_mode) else None


def is_current(cell: Cell) -> bool:
    """Whether an existing evaluation or report read the present outputs, as manifests say; no other file is read.

    Times of files say nothing: copies of a run have other ones.
    """
    try:
        read = {entry["sha256"] for entry in open_artefact(cell.out).manifest["inputs"]}
        run = Path(cell.arguments[1])
        sources = [part.path for part in find(run).everything()] if cell.stage == "evaluate" else cell.needs
        return read.issuperset(digest_of(path / MANIFEST) for path in sources)
    except (UserError, OSError):
        return False
