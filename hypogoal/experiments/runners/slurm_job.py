"""A cell inside a Slurm job: it saves before its time limit, to be queued again, and when it is cancelled."""

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
STOPPED = (128 + signal.SIGTERM, -signal.SIGTERM)  # exit codes after SIGTERM; the latter: before the stage listened


class _Signals:
    """Slurm's signals to the job, passed on to the cell as SIGTERM, at which its stage saves."""

    def __init__(self) -> None:
        self.warned = self.stopped = False
        self.running: Running | None = None
        for number in (WARNING, signal.SIGTERM, signal.SIGINT):
            signal.signal(number, self._receive)

    def _receive(self, number: int, frame: FrameType | None) -> None:
        self.warned |= number == WARNING
        self.stopped |= number != WARNING
        self.pass_on()

    def pass_on(self) -> None:
        """Stop the cell if a signal was received."""
        if self.running is not None and (self.warned or self.stopped):
            self.running.process.terminate()


def run_job(run: Path, name: str) -> None:
    """Run the cell called ``name`` of the sweep in ``run`` on the job's processors.

    An unknown cell, a missing input or a failure is a ``UserError``.
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
    signals.pass_on()  # what came in between
    code = signals.running.process.wait()
    again = code in STOPPED and signals.warned and not signals.stopped
    if again and (not unfinished(cell.out) or _saved(cell) == before):  # or it would never end
        signals.running.log.write(f"hypogoal: {SLOW}\n".encode())
        again, code = False, 1
    code = signals.running.ended(code)
    if again:
        # By array and element: the last element's own number is also the array's and would queue all of them again.
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
    """A cell's checkpoints, and when each was written."""
    paths = (draft_folder(cell.out) / FOLDER).glob("*.safetensors")
    return sorted((path.name, path.stat().st_mtime_ns) for path in paths)
