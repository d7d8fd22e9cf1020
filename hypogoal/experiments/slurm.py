"""Cells as Slurm job arrays (Spec G4): Slurm decides where and when, what is on the disk says what is done.

There is an array for the cells of a stage at a depth of the experiment. It begins when the arrays that it reads have
ended, successfully or not (``afterany``). Slurm's accounting is not needed. A cell saves before its time limit and is
queued again; when it is cancelled, it saves too.
"""

import getpass
import os
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from hypogoal.core.artefacts import Draft
from hypogoal.core.errors import UserError
from hypogoal.core.files import replace_text
from hypogoal.core.own_code import environment
from hypogoal.core.terminal import amount
from hypogoal.experiments.sweep import THREADS, Cell

JOBS = "slurm/jobs"  # the numbers of the jobs last submitted, the last of them first: scancel $(cat ...)
MOST_ELEMENTS = 1000  # of an array: Slurm's default limit is 1001
WARN_SECONDS = 120  # before its time limit a cell saves and is queued again

# A line of CELLS is a cell's log, its checkpoints and its command.
SCRIPT = """#!/bin/sh
#SBATCH --open-mode=append --requeue --signal=B:USR2@{warn}
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
GATHER = "#!/bin/sh\ncd {here} && exec {python} -P -m hypogoal.experiments.results {run}\n"


def check() -> None:
    """Refuse (``UserError``) a machine without Slurm."""
    if shutil.which("sbatch") is None:
        raise UserError("there is no Slurm here (no sbatch)", "--engine slurm", "Use --engine local.")


def queued(run: Path) -> list[str]:
    """The numbers of a run's jobs that wait or run; none without Slurm."""
    jobs = run / JOBS
    if not jobs.exists() or shutil.which("squeue") is None:
        return []
    numbers = jobs.read_text().split()
    words = ["squeue", "--noheader", "--format=%A", f"--user={getpass.getuser()}", f"--jobs={','.join(numbers)}"]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    if done.returncode and "Invalid job id" not in done.stderr:
        raise UserError(f"Slurm does not answer ({' '.join(done.stderr.split())})", run, "Try again later.")
    return sorted({*done.stdout.split()}, key=int)


def submit(cells: Sequence[Cell], run: Path, cap: int, options: Sequence[str], say: Callable[[str], None]) -> None:
    """Submit an array for each stage of these cells at a depth; a last job writes ``results.csv``.

    At most ``cap`` cells of an array run at once; 0 is no limit. ``options`` are of ``sbatch``. Every node must see
    the run's folder under the same path. A refusal by Slurm is a ``UserError``.
    """
    here, python = shlex.quote(str(Path.cwd())), shlex.quote(sys.executable)
    folder = run.resolve() / "slurm"
    folder.mkdir(exist_ok=True)
    jobs: list[str] = []
    job_of: dict[str, str] = {}
    for name, part in _arrays(cells):
        listed = folder / f"{name}.txt"
        replace_text(listed, "".join(f"{shlex.join(_line(cell, run))}\n" for cell in part))
        text = SCRIPT.format(warn=WARN_SECONDS, here=here, cells=shlex.quote(str(listed)), python=python)
        needs = {job_of[need] for cell in part for need in cell.needs if need in job_of}
        size = f"--array=0-{len(part) - 1}" + (f"%{cap}" if cap else "")
        job = _sbatch(folder / f"{name}.sh", text, needs, [size, *options], jobs)
        job_of |= {cell.name: job for cell in part}
        say(f"job {job}: {name}, {amount(len(part), 'cell')}")
    text = GATHER.format(here=here, python=python, run=shlex.quote(str(run)))
    _sbatch(folder / "gather.sh", text, {*jobs}, [], jobs)


def _arrays(cells: Sequence[Cell]) -> list[tuple[str, list[Cell]]]:
    """The cells of each array, in the order of submission."""
    depth: dict[str, int] = {}  # the longest chain of cells before each
    groups: dict[tuple[int, str], list[Cell]] = {}
    for cell in cells:
        depth[cell.name] = 1 + max((depth[need] for need in cell.needs if need in depth), default=-1)
        groups.setdefault((depth[cell.name], cell.stage), []).append(cell)
    arrays = []
    for (level, stage), some in sorted(groups.items()):
        for first in range(0, len(some), MOST_ELEMENTS):
            number = f"-{first // MOST_ELEMENTS}" if first else ""
            arrays.append((f"{level:02d}-{stage}{number}", some[first : first + MOST_ELEMENTS]))
    return arrays


def _line(cell: Cell, run: Path) -> list[str]:
    """What the batch script needs of a cell."""
    log = cell.log(run).with_suffix("")
    return [str(log), str(Draft(cell.out(run)).checkpoint), *cell.command(run), "--resume"]


def _sbatch(script: Path, text: str, needs: set[str], options: Sequence[str], jobs: list[str]) -> str:
    """Submit a script that waits for the jobs ``needs``; its number, which is put first in ``jobs`` and their file."""
    replace_text(script, text)
    words = ["sbatch", "--parsable", f"--job-name={script.parent.parent.name}-{script.stem}"]
    words.append(f"--output={str(script.parent).replace('%', '%%')}/%x-%A-%a.out")
    words += [f"--dependency=afterany:{':'.join(sorted(needs))}"] if needs else []
    exported = {**dict.fromkeys(THREADS, "1"), **os.environ, **environment()}
    words += [*options, str(script)]
    done = subprocess.run(words, capture_output=True, text=True, check=False, env=exported)
    lines = done.stdout.split() or [""]
    number = lines[-1].partition(";")[0]  # the last line: a cluster's banner may come before
    if done.returncode or not number.isdigit():
        reason = " ".join((done.stderr or done.stdout).split()) or f"exit code {done.returncode}"
        queue = f"Queued are {' '.join(jobs)}: end them with scancel. " if jobs else ""
        raise UserError(
            f"Slurm refuses {script.stem} ({reason})", None, f"{queue}Change the options and give --resume."
        )
    jobs.insert(0, number)
    replace_text(script.parents[1] / JOBS, "\n".join(jobs) + "\n")
    return number
