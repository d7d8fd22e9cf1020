"""One cell inside a Slurm job: it saves and is queued again before its time is up, and saves when it is cancelled."""

import os
import signal
import subprocess
from pathlib import Path
from types import FrameType

from hypogoal.core.checkpoints import FOLDER
from hypogoal.core.drafts import draft_folder, unfinished
from hypogoal.core.errors import UserError
from hypogoal.core.terminal import say
from hypogoal.experiments.cells import Cell
from hypogoal.experiments.records import read_plan
from hypogoal.experiments.runners import Running, start
from hypogoal.experiments.runners.local import reason
from hypogoal.experiments.status import is_finished

WARNING = signal.SIGUSR2
SLOW = "nothing new could be saved before the time limit: give a longer --time, or an earlier --warn"
TOLD = (128 + signal.SIGTERM, -signal.SIGTERM)  # how a stage ends that was told to stop; the latter: before it listened


class _Signals:
    """What Slurm says to the job: passed on to the cell as SIGTERM, upon which its stage saves."""

    def __init__(self) -> None:
        self.warned = self.stopped = False
        self.running: Running | None = None
        for number in (WARNING, signal.SIGTERM, signal.SIGINT):
            signal.signal(number, self._heard)

    def _heard(self, number: int, frame: FrameType | None) -> None:
        self.warned |= number == WARNING
        self.stopped |= number != WARNING
        self.tell()

    def tell(self) -> None:
        """Pass on what was heard."""
        if self.running is not None and (self.warned or self.stopped):
            self.running.process.terminate()


def run_job(run: Path, name: str) -> None:
    """Run the cell called ``name`` of the sweep in ``run``; the job's processors are what it may use.

    Where there is no such cell, what it needs is not there, or it fails, it is a ``UserError``.
    """
    signals = _Signals()
    plan, _ = read_plan(run)
    by_name = {cell.name: cell for cell in plan.cells}
    if name not in by_name:
        raise UserError("no such cell in this sweep", name, "See sweep.json.")
    cell = by_name[name]
    for other in plan.cells:
        if other.out in cell.needs and not is_finished(other):
            raise UserError(f"{name} waits for {other.name}, which is not done", run, "Start the sweep again.")
    if is_finished(cell):
        return
    before = _saved(cell)
    processors = os.environ.get("SLURM_CPUS_PER_TASK", "1")
    signals.running = start(cell, run, cores=int(processors) if processors.isdigit() else 1)
    signals.tell()  # what came in between
    code = signals.running.process.wait()
    again = code in TOLD and signals.warned and not signals.stopped
    if again and (not unfinished(cell.out) or _saved(cell) == before):  # it would come here for ever
        signals.running.log.write(f"hypogoal: {SLOW}\n".encode())
        again, code = False, 1
    code = signals.running.ended(code)
    if again:
        # By array and element: the last element's own number is the array's too, and would queue all of them again.
        job = "_".join(os.environ.get(name, "") for name in ("SLURM_ARRAY_JOB_ID", "SLURM_ARRAY_TASK_ID"))
        say(f"{cell.name}: saved, queued again (job {job})", err=True)
        done = subprocess.run(["scontrol", "requeue", job], capture_output=True, text=True, check=False)
        if done.returncode:
            raise UserError(
                f"Slurm does not queue it again ({done.stderr.strip()})", cell.name, "Start the sweep again."
            )
    elif code:
        raise UserError(f"{name} failed: {reason(run, cell, code)}")


def _saved(cell: Cell) -> list[tuple[str, int]]:
    """Which checkpoints a cell has, and when each was written."""
    found = (draft_folder(cell.out) / FOLDER).glob("*.safetensors")
    return sorted((path.name, path.stat().st_mtime_ns) for path in found)
