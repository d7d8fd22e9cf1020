"""The process of one cell, which every runner starts (Spec G4)."""

import os
import subprocess
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import BinaryIO

from hypogoal.core.drafts import unfinished
from hypogoal.core.own_code import environment_of_children
from hypogoal.core.workers import CORES, PYTHON, die_with_parent
from hypogoal.experiments.cells import Cell
from hypogoal.experiments.records import Record, begun, open_log, read_record, write_record
from hypogoal.experiments.status import stamp_of

# Libraries use one thread per process, unless the user sets these.
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMEXPR_NUM_THREADS")
LEFT = "hypogoal: it ended as if all were well, but made nothing: own code has left the process (sys.exit, os._exit)"


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

    def ended(self, code: int) -> int:
        """Record how it ended and close the log; returns the exit code, which is not 0 if it made nothing."""
        if code == 0 and stamp_of(self.cell) in (None, self.before):
            self.log.write(f"{LEFT}\n".encode())
            code = 2
        write_record(self.run, self.cell, replace(self.record, seconds=self.record.seconds + self.seconds, code=code))
        self.log.close()
        return code


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
        command = [*PYTHON, "-m", "hypogoal", *cell.arguments, again]
        environment = {**dict.fromkeys(THREADS, "1"), **os.environ, CORES: str(cores), **environment_of_children()}
        process = subprocess.Popen(
            command,
            stdout=log,
            stderr=subprocess.STDOUT,
            stdin=subprocess.DEVNULL,
            env=environment,
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
