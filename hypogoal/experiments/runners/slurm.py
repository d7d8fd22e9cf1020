"""Cells as Slurm job arrays (Spec G4): Slurm decides where and when, the manifests of cells say what is done.

There is an array for the cells of a stage at a depth of the experiment. It begins when the arrays that it reads have
ended, successfully or not (``afterany``): elements whose inputs are missing end at once, the others run. Slurm's
accounting is not needed. A cell in a job saves before its time limit, to be queued again, and when it is cancelled.
"""

import getpass
import json
import os
import re
import shlex
import shutil
import signal
import subprocess
import time
from collections.abc import Sequence
from dataclasses import dataclass
from math import ceil
from pathlib import Path
from types import FrameType
from typing import Any

from hypogoal.core import checkpoints
from hypogoal.core.drafts import draft_folder
from hypogoal.core.errors import UserError
from hypogoal.core.files import read_json, replace_text
from hypogoal.core.own_code import environment
from hypogoal.core.schemas import is_list, is_object, is_text
from hypogoal.core.terminal import say
from hypogoal.core.workers import PYTHON
from hypogoal.experiments.cells import Cell, Plan
from hypogoal.experiments.records import read_plan
from hypogoal.experiments.runners.local import Running, start
from hypogoal.experiments.status import is_finished, to_remake

FOLDER, JOBS = "slurm", "jobs.json"
MOST_ELEMENTS = 1000  # of an array: Slurm's default limit is 1001
CANCEL_SECONDS = 120.0
GATHER = "gather"
SLOW = "nothing new could be saved before the time limit: give a longer --time, or an earlier --warn"
STOPPED = (128 + signal.SIGTERM, -signal.SIGTERM)  # exit codes after SIGTERM; the latter: before the stage listened


@dataclass(frozen=True)
class Options:
    """What every cell requests from Slurm; empty values are left to Slurm."""

    partition: str = ""
    time: str = ""  # limit of a cell, as ``sbatch --time`` takes it
    memory: str = ""  # of a cell, as ``sbatch --mem`` takes it
    gpus: int = 0  # of a cell
    cpus: int = 0  # of a cell; 0: as many processes as it can use
    cap: int = 0  # cells of an array that run at once, at most; 0: no limit
    warn: int = 120  # seconds before the time limit at which a cell saves and is queued again
    extra: tuple[str, ...] = ()  # further options of ``sbatch``


@dataclass(frozen=True)
class Array:
    """An array: its name, its cells, and the names of the arrays that it waits for."""

    name: str
    cells: list[Cell]
    after: list[str]


def arrays(plan: Plan, todo: Sequence[Cell], most: int = MOST_ELEMENTS) -> list[Array]:
    """The arrays of the cells to run, each of at most ``most``, after the arrays that it reads."""
    depth: dict[Path, int] = {}  # the longest chain of cells before each
    for cell in plan.cells:
        depth[cell.out] = 1 + max((depth[need] for need in cell.needs), default=-1)
    groups: dict[tuple[int, str], list[Cell]] = {}
    for cell in todo:
        groups.setdefault((depth[cell.out], cell.stage), []).append(cell)
    array_of: dict[Path, str] = {}
    result = []
    for (level, stage), cells in sorted(groups.items()):
        needs = {need for cell in cells for need in cell.needs}
        after = list(dict.fromkeys(name for out, name in array_of.items() if out in needs))
        for number in range(ceil(len(cells) / most)):
            part = cells[number * most : (number + 1) * most]
            name = f"{level:02d}-{stage}" + (f"-{number}" if number else "")
            result.append(Array(name, part, after))
            array_of.update((cell.out, name) for cell in part)
    return result


def submit(plan: Plan, run: Path, todo: Sequence[Cell], options: Options) -> list[dict[str, Any]]:
    """Write a script for each array of ``todo`` into ``run/slurm`` and submit it; a last job gathers the numbers.

    Every node must see the run's folder under the same path. Returns the number (``id``), name and cells of each job.
    No Slurm, or a refusal by Slurm, is a ``UserError``.
    """
    folder = run / FOLDER
    folder.mkdir(parents=True, exist_ok=True)
    jobs: list[dict[str, Any]] = []
    numbers: dict[str, str] = {}
    parts = arrays(plan, todo)
    try:
        for array in [*parts, Array(GATHER, [], [array.name for array in parts])]:
            script = folder / f"{array.name}.sh"
            replace_text(script, _script(array, run, options))
            numbers[array.name] = _sbatch(script, [numbers[name] for name in array.after])
            jobs.append({"id": numbers[array.name], "name": array.name, "cells": [cell.name for cell in array.cells]})
            replace_text(folder / JOBS, json.dumps(jobs, indent=1) + "\n")
    except UserError:
        _command("scancel", *numbers.values())
        raise
    return jobs


def check(run: Path, options: Options) -> None:
    """Refuse (``UserError``) missing Slurm and options that a batch script cannot have, before anything is written."""
    if shutil.which("sbatch") is None:
        raise UserError("there is no Slurm here (no sbatch)", "--engine slurm", "Use --engine local.")
    for text in (options.partition, options.time, options.memory, *options.extra):
        if not text.isprintable():
            raise UserError("not an option of sbatch", repr(text), "See 'man sbatch'.")
    place = str(run.resolve())
    if "\\" in place or not place.isprintable():  # after a backslash Slurm takes %A and %a literally
        raise UserError("a batch script cannot hold a path with such characters", repr(place), "Choose another --out.")


def _script(array: Array, run: Path, options: Options) -> str:
    """A plain batch script: element N runs the Nth cell that it names; without cells, it gathers the numbers."""
    place = str((run / FOLDER).resolve()).replace("%", "%%")
    settings = [
        f"--job-name={re.sub(r'[^A-Za-z0-9_.-]', '-', run.name)}-{array.name}",
        f"--output={shlex.quote(place)}/%x-%A-%a.out",
        "--open-mode=append",
        *([f"--partition={options.partition}"] if options.partition else []),
        *options.extra,
    ]
    out = shlex.quote(str(run))
    last = f"exec {shlex.join(PYTHON)} -m hypogoal sweep --out {out}"
    if array.cells:
        cpus = options.cpus or max(cell.cores for cell in array.cells)
        settings += [
            f"--array=0-{len(array.cells) - 1}" + (f"%{options.cap}" if options.cap else ""),
            f"--cpus-per-task={cpus}",
            "--requeue",
            f"--signal=B:USR2@{options.warn}",
            *([f"--mem={options.memory}"] if options.memory else []),
            *([f"--time={options.time}"] if options.time else []),
            *([f"--gres=gpu:{options.gpus}"] if options.gpus else []),
        ]
        commands = [
            "trap '' USR2  # until the program listens: the warning must not end it",
            f"set -- {shlex.join(cell.name for cell in array.cells)}",
            'shift "$SLURM_ARRAY_TASK_ID"',
            *(f"export {name}={value}" for name, value in environment().items()),
            f'{last} --cell "$1"',
        ]
    else:
        commands = [f"{last} --gather"]
    head = ["#!/bin/sh", *(f"#SBATCH {setting}" for setting in settings)]
    return "\n".join([*head, f"cd {shlex.quote(str(Path.cwd()))} || exit 1", *commands, ""])


def _sbatch(script: Path, after: Sequence[str]) -> str:
    dependency = [f"--dependency=afterany:{':'.join(after)}"] if after else []
    done = _command("sbatch", "--parsable", *dependency, str(script))
    if done.returncode:
        problem = f"Slurm refuses the array ({' '.join(done.stderr.split()) or f'exit code {done.returncode}'})"
        raise UserError(problem, script, "Change the options; nothing was left in the queue.")
    return done.stdout.strip().partition(";")[0]


def _command(*words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(words, capture_output=True, text=True, check=False)


def jobs_of(run: Path) -> list[str]:
    """The numbers of the jobs last submitted for a run."""
    path = run / FOLDER / JOBS
    if not path.is_file():
        return []
    do = "Check with squeue that no job of the sweep waits or runs, then remove this file."
    jobs = read_json(path, "the list of jobs is", do)
    if not is_list(is_object({"id": is_text}))(jobs):
        raise UserError("the list of jobs is damaged", path, do)
    return [job["id"] for job in jobs if re.fullmatch(r"[0-9]+", job["id"])]


def queued(run: Path) -> list[str]:
    """The numbers of a run's jobs that wait or run; none without Slurm."""
    numbers = jobs_of(run)
    if not numbers or shutil.which("squeue") is None:
        return []
    done = _command("squeue", "--noheader", "--format=%A", f"--user={getpass.getuser()}", f"--jobs={','.join(numbers)}")
    if done.returncode and "Invalid job id" not in done.stderr:
        raise UserError(f"Slurm does not answer ({' '.join(done.stderr.split())})", run, "Try again later.")
    return sorted(set(done.stdout.split()), key=int)


def cancel(run: Path) -> int:
    """End all jobs of a run, whose running cells save first; returns how many. No jobs are a ``UserError``."""
    alive = queued(run)
    if not alive:
        raise UserError("no jobs in Slurm's queue", run, "A sweep on this machine is ended with Ctrl-C or SIGTERM.")
    numbers = jobs_of(run)
    # Waiting jobs first, or they would begin as others end. Then all; running ones get SIGTERM.
    for state in (["--state=PENDING"], []):
        _command("scancel", *state, *numbers)
    until = time.monotonic() + CANCEL_SECONDS
    while queued(run):
        if time.monotonic() > until:
            raise UserError("Slurm has not ended all jobs yet", run, "Look with squeue.")
        time.sleep(0.5)
    return len(alive)


def run_job(run: Path, name: str) -> None:
    """Run the cell called ``name`` of the sweep in ``run`` on the job's processors.

    Slurm's signals are passed on to the cell as SIGTERM, at which its stage saves. An unknown cell, a missing input or
    a failure is a ``UserError``.
    """
    received: set[int] = set()
    running: list[Running] = []

    def pass_on(number: int, frame: FrameType | None) -> None:
        received.add(number)
        for started in running:
            started.process.terminate()

    for number in (signal.SIGUSR2, signal.SIGTERM, signal.SIGINT):
        signal.signal(number, pass_on)
    plan = read_plan(run)
    cell = next((cell for cell in plan.cells if cell.name == name), None)
    if cell is None:
        raise UserError("no such cell in this sweep", name, "See sweep.json.")
    for other in plan.cells:
        if other.out in cell.needs and (to_remake(plan, run, other) or not is_finished(other)):
            raise UserError(f"{name} waits for {other.name}, which is not done", run, "Start the sweep again.")
    if not to_remake(plan, run, cell) and is_finished(cell):
        return
    before = _saved(cell)
    processors = os.environ.get("SLURM_CPUS_PER_TASK", "1")
    cores = int(processors) if processors.isdigit() else 1
    started = start(cell, run, cores=cores, force=name in plan.anew)
    running.append(started)
    if received:  # in between
        started.process.terminate()
    code = started.process.wait()
    again = code in STOPPED and received == {signal.SIGUSR2}
    if again and _saved(cell) in ([], before):  # or it would never end
        started.log.write(f"hypogoal: {SLOW}\n".encode())
        again, code = False, 1
    reason = started.ended(code)
    if again:
        # By array and element: the last element's own number is also the array's and would queue all of them again.
        job = "_".join(os.environ.get(name, "") for name in ("SLURM_ARRAY_JOB_ID", "SLURM_ARRAY_TASK_ID"))
        say(f"{name}: saved, queued again (job {job})", err=True)
        done = _command("scontrol", "requeue", job)
        if done.returncode:
            raise UserError(f"Slurm does not queue it again ({done.stderr.strip()})", name, "Start the sweep again.")
    elif reason:
        raise UserError(f"{name} failed: {reason}")


def _saved(cell: Cell) -> list[tuple[str, int]]:
    """A cell's checkpoints, and when each was written."""
    paths = (draft_folder(cell.out) / checkpoints.FOLDER).glob("*.safetensors")
    return sorted((path.name, path.stat().st_mtime_ns) for path in paths)
