"""Runs cells on this machine in the plan's order, as many at once as cores and memory allow (Spec G4)."""

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from hypogoal.core.errors import UserError
from hypogoal.core.preflight import free_memory
from hypogoal.experiments.cells import Cell, Plan
from hypogoal.experiments.records import last_line, log_of, made_anew
from hypogoal.experiments.runners import Running, start
from hypogoal.experiments.status import is_finished

POLL_SECONDS = 0.2
REPORT_SECONDS = 15.0


@dataclass
class Outcome:
    """How the cells ended: the reasons of those that failed, and the cells that wait for one of them."""

    failed: dict[str, str] = field(default_factory=dict)
    waiting: list[Cell] = field(default_factory=list)


def run_cells(plan: Plan, run: Path, *, say: Callable[[str], None], check: bool = False) -> Outcome:
    """Run unfinished cells; a failing cell stops only those that need it. ``say`` gets messages on the progress.

    ``check``: all are complete; the stage of each only checks that its command would make the existing output.
    """
    outcome = Outcome(waiting=list(plan.cells))
    places = {cell.name: place for place, cell in enumerate(plan.cells)}
    running: list[Running] = []
    done: set[Path] = set()
    startable: list[Cell] = []
    budget = free_memory()
    total, reported = len(plan.cells), time.monotonic()
    try:
        while True:
            while ready := [cell for cell in outcome.waiting if done.issuperset(cell.needs)]:
                for cell in ready:  # a finished one makes others ready
                    outcome.waiting.remove(cell)
                    try:
                        if cell.name not in plan.anew and is_finished(cell) and not check:
                            done.add(cell.out)
                        else:
                            startable.append(cell)
                    except UserError as error:
                        _fail(outcome, cell, str(error), say)
            startable.sort(key=lambda cell: places[cell.name])  # not first those that wait for nothing
            while startable and (cores := _allotted(startable, running, plan.workers, budget)):
                cell = startable.pop(0)
                try:
                    running.append(start(cell, run, cores=cores, force=cell.name in plan.anew, check=check))
                    say(f"[{len(done)}/{total}] {cell.name} ...")
                except UserError as error:
                    _fail(outcome, cell, str(error), say)
            if not running and not any(done.issuperset(cell.needs) for cell in outcome.waiting):
                return outcome
            time.sleep(POLL_SECONDS)
            for started in [started for started in running if started.process.poll() is not None]:
                running.remove(started)
                if code := started.ended(started.process.returncode):
                    _fail(outcome, started.cell, reason(run, started.cell, code), say)
                else:
                    if started.cell.name in plan.anew:
                        made_anew(run, started.cell)
                    done.add(started.cell.out)
                    say(f"[{len(done)}/{total}] {started.cell.name} done in {started.seconds:.0f} s")
            if running and time.monotonic() - reported > REPORT_SECONDS:
                reported = time.monotonic()
                for started in running:
                    say(f"    {started.cell.name}: {last_line(log_of(run, started.cell))}")
    finally:
        for started in running:
            started.process.terminate()
        for started in running:
            started.ended(started.process.wait())


def _allotted(startable: list[Cell], running: list[Running], workers: int, budget: int | None) -> int:
    """How many processes the next cell gets; 0: it has to wait.

    It does not wait for all the cores that it could use, or small cells would always go first. Cells that can start at
    the same time share the cores.
    """
    cell = startable[0]
    free = workers - sum(started.cores for started in running)
    if free <= 0:
        return 0
    cores = max(1, min(cell.cost.cores, free // len(startable)))
    if budget is None or not running:  # the first one always runs; its stage refuses if memory is too little
        return cores
    left = budget - sum(started.cell.cost.memory * started.cores for started in running)
    return min(cores, max(0, int(left // cell.cost.memory))) if cell.cost.memory else cores


def _fail(outcome: Outcome, cell: Cell, reason: str, say: Callable[[str], None]) -> None:
    outcome.failed[cell.name] = reason
    say(f"{cell.name} FAILED: {reason}")


def reason(run: Path, cell: Cell, code: int) -> str:
    """Why a cell ended with this exit code, in a line."""
    log = log_of(run, cell)
    if code < 0:
        return f"ended by signal {-code}{' (out of memory?)' if code == -9 else ''}; see {log}"
    return f"{last_line(log).removeprefix('hypogoal: ')} ({log})"
