"""Cells as Slurm job arrays (Spec G4): Slurm decides where and when, the manifests of cells say what is done.

There is an array for the cells of a stage at a depth of the experiment. It begins when the arrays that it reads have
ended, successfully or not (``afterany``): elements whose inputs are missing end at once, the others run. Slurm's
accounting is not needed.
"""

import getpass
import json
import re
import shlex
import shutil
import subprocess
import time
from collections.abc import Sequence
from dataclasses import dataclass
from math import ceil
from pathlib import Path
from typing import Any

from hypogoal.core.errors import UserError
from hypogoal.core.files import read_json, replace_text
from hypogoal.core.own_code import TRUST, environment_of_children
from hypogoal.core.schemas import is_list, is_object, is_text
from hypogoal.core.workers import PYTHON
from hypogoal.experiments.cells import Cell, Plan, depths

FOLDER, JOBS = "slurm", "jobs.json"
MOST_ELEMENTS = 1000  # of an array, if Slurm does not say: its default limit is 1001
LEAST_MEMORY = 500e6
MARGIN, BESIDE = 1.1, 100e6  # factor on estimates, as some clusters kill at the limit; bytes of the job itself
CANCEL_SECONDS = 120.0
GATHER = "gather"


@dataclass(frozen=True)
class Options:
    """What every cell requests from Slurm; empty values are left to Slurm, or estimated (memory, cpus)."""

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
    depth = depths(plan.cells)
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
    No Slurm, a refusal by Slurm, or jobs of this sweep still in its queue are a ``UserError``.
    """
    check(run, options)
    if alive := queued(run):
        do = "Look with --status, end them with --cancel."
        raise UserError(f"this sweep is in Slurm's queue already (job {alive[0]})", run, do)
    folder = run / FOLDER
    folder.mkdir(parents=True, exist_ok=True)
    jobs: list[dict[str, Any]] = []
    numbers: dict[str, str] = {}
    try:
        for array in arrays(plan, todo, most_elements()):
            script = folder / f"{array.name}.sh"
            replace_text(script, _script(array, run, options))
            numbers[array.name] = _sbatch(script, [numbers[name] for name in array.after])
            jobs.append({"id": numbers[array.name], "name": array.name, "cells": [cell.name for cell in array.cells]})
            replace_text(folder / JOBS, json.dumps(jobs, indent=1) + "\n")
        script = folder / f"{GATHER}.sh"
        memory = f"#SBATCH --mem={ceil(LEAST_MEMORY / 2**20)}M"
        replace_text(script, "\n".join([*_head(run, GATHER, options), memory, *_sweep(run, "--gather"), ""]))
        jobs.append({"id": _sbatch(script, list(numbers.values())), "name": GATHER, "cells": []})
    except UserError:
        for job in jobs:
            _command("scancel", job["id"])
        raise
    replace_text(folder / JOBS, json.dumps(jobs, indent=1) + "\n")
    return jobs


def most_elements() -> int:
    """How many cells an array may have, by Slurm's configuration."""
    if shutil.which("scontrol") is None:
        return MOST_ELEMENTS
    match = re.search(r"^MaxArraySize\s*=\s*(\d+)", _command("scontrol", "show", "config").stdout, re.MULTILINE)
    return max(1, int(match[1]) - 1) if match else MOST_ELEMENTS


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


def _head(run: Path, name: str, options: Options) -> list[str]:
    place = str((run / FOLDER).resolve()).replace("%", "%%")
    lines = [
        "#!/bin/sh",
        f"#SBATCH --job-name={re.sub(r'[^A-Za-z0-9_.-]', '-', run.name)}-{name}",
        f"#SBATCH --output={shlex.quote(place)}/%x-%A-%a.out",
        "#SBATCH --open-mode=append",
    ]
    lines += [f"#SBATCH --partition={options.partition}"] if options.partition else []
    return lines + [f"#SBATCH {extra}" for extra in options.extra]


def _script(array: Array, run: Path, options: Options) -> str:
    """A plain batch script: element N runs the Nth cell that it names."""
    cpus = options.cpus or max(cell.cost.cores for cell in array.cells)
    estimated = cpus * max(cell.cost.memory for cell in array.cells)
    requested = MARGIN * max(estimated, LEAST_MEMORY) + BESIDE
    memory = options.memory or (f"{ceil(requested / 2**20)}M" if estimated else "")
    lines = _head(run, array.name, options)
    lines += [
        f"#SBATCH --array=0-{len(array.cells) - 1}" + (f"%{options.cap}" if options.cap else ""),
        f"#SBATCH --cpus-per-task={cpus}",
        "#SBATCH --requeue",
        f"#SBATCH --signal=B:USR2@{options.warn}",
    ]
    lines += [f"#SBATCH --mem={memory}"] if memory else []
    lines += [f"#SBATCH --time={options.time}"] if options.time else []
    lines += [f"#SBATCH --gres=gpu:{options.gpus}"] if options.gpus else []
    names = " ".join(shlex.quote(cell.name) for cell in array.cells)
    lines += [
        "trap '' USR2  # until the program listens: the warning must not end it",
        f"set -- {names}",
        'shift "$SLURM_ARRAY_TASK_ID"',
        f"export {TRUST}={shlex.quote(environment_of_children()[TRUST])}",
    ]
    return "\n".join([*lines, *_sweep(run, '--cell "$1"')]) + "\n"


def _sweep(run: Path, option: str) -> list[str]:
    command = f"{shlex.join(PYTHON)} -m hypogoal sweep --out {shlex.quote(str(run))} {option}"
    return [f"cd {shlex.quote(str(Path.cwd()))} || exit 1", f"exec {command}"]


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
