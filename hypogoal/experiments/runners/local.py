"""Cells as processes, which every runner starts, and all cells of a plan on this machine (Spec G4)."""

import os
import subprocess
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import BinaryIO

from hypogoal.core.drafts import unfinished
from hypogoal.core.errors import UserError
from hypogoal.core.own_code import environment
from hypogoal.core.workers import CORES, PYTHON, die_with_parent
from hypogoal.experiments.cells import Cell, Plan
from hypogoal.experiments.records import Record, begun, last_line, log_of, open_log, read_record, write_record
from hypogoal.experiments.status import is_finished, stamp_of, to_remake

# Libraries use one thread per process, unless the user sets these.
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMEXPR_NUM_THREADS")
LEFT = "hypogoal: it ended as if all were well, but made nothing: own code has left the process (sys.exit, os._exit)"
POLL_SECONDS = 0.2
REPORT_SECONDS = 15.0


@dataclass
class Running:
    """A cell that runs in its own process; its log is locked until :meth:`ended`."""

    cell: Cell
    run: Path
    process: subprocess.Popen[bytes]
    cores: int
    log: BinaryIO
    record: Record
    since: float
    before: tuple[int, int] | None

    @property
    def seconds(self) -> float:
        """Since its start."""
        return time.monotonic() - self.since

    def ended(self, code: int) -> str:
        """Record how it ended and close the log; returns why it failed in a line, empty if it did not."""
        if code == 0 and stamp_of(self.cell) in (None, self.before):
            self.log.write(f"{LEFT}\n".encode())
            code = 2
        write_record(self.run, self.cell, replace(self.record, seconds=self.record.seconds + self.seconds, code=code))
        self.log.close()
        log = log_of(self.run, self.cell)
        if code < 0:
            return f"ended by signal {-code}{' (out of memory?)' if code == -9 else ''}; see {log}"
        return f"{last_line(log).removeprefix('hypogoal: ')} ({log})" if code else ""


def start(cell: Cell, run: Path, *, cores: int = 1, force: bool = False, check: bool = False) -> Running:
    """Start a cell at its last checkpoint; it ends with this process. If another process runs it: ``UserError``.

    ``cores`` are the processes that it may use. ``force``: make it again even if it is complete; an attempt at that
    which has begun is continued. ``check``: its stage only checks that this command would make the existing output.
    """
    log = open_log(run, cell)
    try:
        before = read_record(run, cell)
        record = begun(before)
        write_record(run, cell, record)
        log.write(b"started\n")  # the last line of the previous attempt is no longer the last of the log
        fresh = (force or cell.out.exists()) and not check  # what exists is an outdated evaluation
        again = "--force" if fresh and not (before.attempts and unfinished(cell.out)) else "--resume"
        existing = None if check else stamp_of(cell)
        process = subprocess.Popen(
            [*PYTHON, "-m", "hypogoal", *cell.arguments, again],
            stdout=log,
            stderr=subprocess.STDOUT,
            stdin=subprocess.DEVNULL,
            env={**dict.fromkeys(THREADS, "1"), **os.environ, CORES: str(cores), **environment()},
            preexec_fn=_follow(os.getpid()) if os.name == "posix" else None,
        )
    except BaseException:
        log.close()
        raise
    return Running(cell, run, process, cores, log, record, time.monotonic(), existing)


def _follow(parent: int) -> Callable[[], None]:
    def follow() -> None:
        die_with_parent()
        if os.getppid() != parent:  # it died before the call above
            os._exit(1)

    return follow


@dataclass
class Outcome:
    """How the cells ended: the reasons of those that failed, and the cells that wait for one of them."""

    failed: dict[str, str] = field(default_factory=dict)
    waiting: list[Cell] = field(default_factory=list)


def run_cells(plan: Plan, run: Path, *, say: Callable[[str], None], check: bool = False) -> Outcome:
    """Run unfinished cells in the plan's order, as many at once as cores allow.

    A failing cell stops only those that need it. ``say`` gets messages on the progress. ``check``: all are complete;
    the stage of each only checks that its command would make the existing output.
    """
    outcome = Outcome(waiting=list(plan.cells))
    places = {cell.name: place for place, cell in enumerate(plan.cells)}
    startable: list[Cell] = []
    running: list[Running] = []
    done: set[Path] = set()
    reported = time.monotonic()

    def fail(cell: Cell, reason: str) -> None:
        outcome.failed[cell.name] = reason
        say(f"{cell.name} FAILED: {reason}")

    try:
        while True:
            for cell in [*outcome.waiting]:  # in the plan's order: a finished one makes later ones ready
                if not done.issuperset(cell.needs):
                    continue
                outcome.waiting.remove(cell)
                try:
                    if not check and not to_remake(plan, run, cell) and is_finished(cell):
                        done.add(cell.out)
                    else:
                        startable.append(cell)
                except UserError as error:
                    fail(cell, str(error))
            startable.sort(key=lambda cell: places[cell.name])  # not first those that wait for nothing
            while startable and (cores := _allotted(startable, running, plan.workers)):
                cell = startable.pop(0)
                try:
                    running.append(start(cell, run, cores=cores, force=cell.name in plan.anew, check=check))
                    say(f"[{len(done)}/{len(plan.cells)}] {cell.name} ...")
                except UserError as error:
                    fail(cell, str(error))
            if not running:
                return outcome
            time.sleep(POLL_SECONDS)
            for started in [started for started in running if started.process.poll() is not None]:
                running.remove(started)
                if reason := started.ended(started.process.returncode):
                    fail(started.cell, reason)
                else:
                    done.add(started.cell.out)
                    say(f"[{len(done)}/{len(plan.cells)}] {started.cell.name} done in {started.seconds:.0f} s")
            if time.monotonic() - reported > REPORT_SECONDS:
                reported = time.monotonic()
                for started in running:
                    say(f"    {started.cell.name}: {last_line(log_of(run, started.cell))}")
    finally:
        for started in running:
            started.process.terminate()
        for started in running:
            started.ended(started.process.wait())


def _allotted(startable: list[Cell], running: list[Running], workers: int) -> int:
    """How many processes the next cell gets; 0: it has to wait.

    It does not wait for all the cores that it could use, or small cells would always go first. Cells that can start at
    the same time share the cores.
    """
    free = workers - sum(started.cores for started in running)
    if free <= 0:
        return 0
    return max(1, min(startable[0].cores, free // len(startable)))
