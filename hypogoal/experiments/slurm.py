"""Cells as Slurm job arrays: Slurm decides where and when cells run, and the disk says which cells are done.

Each stage has an array for its cells. An array begins when the arrays that it reads have ended, successfully or not
(``afterany``). Slurm's accounting is not needed. Before its time limit, a cell saves and is queued again. A cell that
is cancelled saves, too.
"""

import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from hypogoal.cells import Cell
from hypogoal.command.stage import LISTED
from hypogoal.core.errors import UserError
from hypogoal.core.files import replace_text
from hypogoal.core.processes import surroundings

JOBS = "slurm/jobs"  # file with the jobs last submitted, the last first, after --clusters=NAME: scancel $(cat ...)
COLOURS = re.compile(r"\x1b\[[\d;]*[A-Za-z]")
# The line of sbatch's output that is its answer; some clusters print more lines.
ANSWER = re.compile(r"^[ \t]*(?:Submitted batch job )?(\d+)(?:(?:;| on cluster )(\S+))?[ \t\r]*$", re.MULTILINE)

# A line of the file of cells has a cell's log, checkpoints and command. A cell stops two minutes before its time limit.
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
    """Raise ``UserError`` if jobs of the run wait or run, or if Slurm does not say so.

    If Slurm ``is_wanted``, also raise ``UserError`` if there is no Slurm.
    """
    if is_wanted and shutil.which("sbatch") is None:
        raise UserError("there is no Slurm here (no sbatch)", "--engine slurm", "Use --engine local.")
    jobs = run / JOBS
    if not jobs.exists() or shutil.which("squeue") is None:
        return
    words = jobs.read_text().split()
    cluster = [word for word in words if word.startswith("--")]
    queue = _asked("squeue", "--me", "--noheader", "--format=%F", *cluster)
    if queue.returncode or "error" in queue.stderr:
        do = f"Try again when squeue answers. If none of them waits or runs, remove {jobs}."
        raise UserError(f"squeue does not say whether this run's jobs are done ({queue.stderr})", run, do)
    alive = [job for job in words if job in queue.stdout.split()]
    if alive:
        do = f"Wait, or end it: {shlex.join(['scancel', *cluster, *alive])}"
        raise UserError("this run is in Slurm's queue", run, do)


def submit(cells: Sequence[Cell], run: Path, cap: int, options: Sequence[str], say: Callable[[str], None]) -> None:
    """Submit an array for each stage of the cells.

    At most ``cap`` cells of an array run at once; 0 is no limit. ``options`` are for ``sbatch``. Every node must see
    the run's folder under the same path. Raises ``UserError`` if Slurm refuses.
    """
    folder = run.resolve() / "slurm"
    folder.mkdir(exist_ok=True)
    output = f"--output={str(folder).replace('%', '%%')}/%x-%A-%a.out"
    here, python = shlex.quote(os.getcwd()), shlex.quote(sys.executable)
    job_of: dict[str, str] = {}  # by a cell's place
    for name in LISTED:  # in this order, because a stage reads what earlier stages made
        part = [cell for cell in cells if cell.stage == name]
        if not part:
            continue
        listed, script = folder / f"{name}.txt", folder / f"{name}.sh"
        replace_text(listed, "".join(map(_line, part)))
        replace_text(script, SCRIPT.format(here=here, python=python, cells=shlex.quote(str(listed))))
        array = f"--array=0-{len(part) - 1}"
        if cap:
            array += f"%{cap}"
        words = [f"--job-name={folder.parent.name}-{name}", output, array]
        before: set[str] = set()
        for cell in part:
            before.update(job_of[need] for need in cell.needs if need in job_of)
        if before:
            words.append(f"--dependency=afterany:{':'.join(sorted(before))}")
        done = _asked("sbatch", "--parsable", *words, *options, str(script))
        answers = {*ANSWER.findall(done.stdout)}
        jobs = " ".join(dict.fromkeys(reversed(job_of.values())))
        queued = f"Queued are {jobs}: end them with scancel. " if jobs else ""
        if done.returncode:
            do = f"{queued}Change the options and give --resume."
            raise UserError(f"Slurm refuses {name} ({done.stderr or done.stdout})", None, do)
        if len(answers) != 1:
            do = f"It is queued: find it with squeue --me, end it with scancel. {queued}Then give --resume."
            raise UserError(f"sbatch does not say one number of a job for {name} ({done.stdout})", None, do)
        [(job, cluster)] = answers
        where = f"--clusters={cluster} " if cluster else ""
        replace_text(run / JOBS, f"{where}{job} {jobs}\n")
        job_of |= dict.fromkeys([cell.place for cell in part], job)
        say(f"job {job}: {name}, {len(part)} cells")


def _line(cell: Cell) -> str:
    """Return what the batch script needs of a cell, as a line."""
    log = cell.log().with_suffix("")
    return shlex.join([str(log), str(cell.draft.checkpoint), *cell.command, "--resume"]) + "\n"


def _asked(*words: str) -> subprocess.CompletedProcess[str]:
    """Return what a command of Slurm's says. Jobs inherit the environment that the command gets."""
    with surroundings():
        done = subprocess.run(words, capture_output=True, text=True, errors="replace", check=False)
    done.stdout = COLOURS.sub("", done.stdout)
    return done
