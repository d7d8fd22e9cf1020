"""Cells as Slurm job arrays (Spec G4): Slurm decides where and when, what is on the disk says what is done.

There is an array for the cells of a stage at a depth of the experiment. It begins when the arrays that it reads have
ended, successfully or not (``afterany``). Slurm's accounting is not needed. A cell saves before its time limit and is
queued again; when it is cancelled, it saves too.
"""

import os
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from hypogoal.cells import Cell
from hypogoal.core.errors import UserError
from hypogoal.core.files import replace_text
from hypogoal.experiments.local import surroundings

JOBS = "slurm/jobs"  # the numbers of the jobs last submitted, the last of them first: scancel $(cat ...)

# A line of the file of cells: a cell's log, its checkpoints, its command. It is stopped two minutes before its limit.
SCRIPT = """#!/bin/sh
#SBATCH --open-mode=append --requeue --signal=B:USR2@120
cd {here} || exit 1
export HYPOGOAL_CORES="${{SLURM_CPUS_PER_TASK:-1}}"
eval "set -- $(sed -n "$((SLURM_ARRAY_TASK_ID + 1))p" {cells})"
log=$1 saved=$2; shift 2
stop() {{ kill -TERM "$cell"; wait "$cell"; }}
again() {{ stop; [ -e "$saved" ] && exec scontrol requeue "${{SLURM_ARRAY_JOB_ID}}_$SLURM_ARRAY_TASK_ID"
  echo "nothing was saved before the time limit: give a longer --time" >>"$log.log"; echo 1 >"$log.code"; exit 1; }}
trap again USR2
trap 'stop; exit 143' TERM
{python} -P -m hypogoal "$@" >>"$log.log" 2>&1 & cell=$!
wait "$cell"; code=$?; echo "$code" >"$log.code"; exit "$code"
"""


def check_free(run: Path, *, is_wanted: bool) -> None:
    """Refuse (``UserError``) a run whose jobs wait or run and, if Slurm ``is_wanted``, a machine without it."""
    if is_wanted and shutil.which("sbatch") is None:
        raise UserError(
            "there is no Slurm here (no sbatch)",
            "--engine slurm",
            "Use --engine local.",
        )
    jobs = run / JOBS
    if jobs.exists() and shutil.which("squeue"):
        numbers = ",".join(jobs.read_text().split())
        alive = _asked("squeue", "--me", "--noheader", "--format=%A", f"--jobs={numbers}").stdout.split()
        if alive:
            raise UserError(
                "this run is in Slurm's queue",
                run,
                f"Wait, or end it: scancel {' '.join({*alive})}",
            )


def submit(cells: Sequence[Cell], run: Path, cap: int, options: Sequence[str], say: Callable[[str], None]) -> None:
    """Submit an array for each stage of these cells at a depth.

    At most ``cap`` cells of an array run at once; 0 is no limit. ``options`` are of ``sbatch``. Every node must see
    the run's folder under the same path. A refusal by Slurm is a ``UserError``.
    """
    folder = run.resolve() / "slurm"
    folder.mkdir(exist_ok=True)
    output = f"--output={str(folder).replace('%', '%%')}/%x-%A-%a.out"
    here, python = shlex.quote(os.getcwd()), shlex.quote(sys.executable)
    jobs: list[str] = []
    job_of: dict[str, str] = {}
    for name, part in _arrays(cells).items():
        listed, script = folder / f"{name}.txt", folder / f"{name}.sh"
        replace_text(listed, "".join(_line(cell, run) for cell in part))
        replace_text(script, SCRIPT.format(here=here, python=python, cells=shlex.quote(str(listed))))
        needs: set[str] = set()
        for cell in part:
            needs |= {job_of[need] for need in cell.needs if need in job_of}
        words = [f"--job-name={run.resolve().name}-{name}", output, f"--array=0-{len(part) - 1}"]
        if cap:
            words[-1] += f"%{cap}"
        if needs:
            words.append(f"--dependency=afterany:{':'.join(sorted(needs))}")
        done = _asked("sbatch", "--parsable", *words, *options, str(script))
        last = done.stdout.splitlines()[-1:]  # a banner may come before
        job = "".join(last).partition(";")[0]
        if done.returncode or not job.isdigit():
            queued = f"Queued are {' '.join(jobs)}: end them with scancel. " if jobs else ""
            problem = f"Slurm refuses {name} ({done.stderr or done.stdout})"
            raise UserError(
                problem,
                None,
                f"{queued}Change the options and give --resume.",
            )
        jobs.insert(0, job)
        replace_text(run / JOBS, "\n".join(jobs) + "\n")
        job_of |= dict.fromkeys([cell.name for cell in part], job)
        say(f"job {job}: {name}, {len(part)} cells")


def _arrays(cells: Sequence[Cell]) -> dict[str, list[Cell]]:
    """The cells of each array by its name, in the order of submission."""
    depth: dict[str, int] = {}  # the longest chain of cells before each
    arrays: dict[str, list[Cell]] = {}
    for cell in cells:
        depth[cell.name] = 1 + max((depth.get(need, -1) for need in cell.needs), default=-1)
        arrays.setdefault(f"{depth[cell.name]:02d}-{cell.stage}", []).append(cell)
    return dict(sorted(arrays.items()))


def _line(cell: Cell, run: Path) -> str:
    """What the batch script needs of a cell."""
    log = cell.log(run).with_suffix("")
    return shlex.join([str(log), str(cell.draft(run).checkpoint), *cell.command(run), "--resume"]) + "\n"


def _asked(*words: str) -> subprocess.CompletedProcess[str]:
    """What a command of Slurm's says; jobs inherit its environment."""
    with surroundings():
        return subprocess.run(words, capture_output=True, text=True, check=False)
