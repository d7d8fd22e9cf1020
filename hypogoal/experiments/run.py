"""A run of cells: how it is begun, resumed or partly made anew, on this machine or by Slurm."""

import multiprocessing
import os
import shlex
import shutil
import signal
import sys
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

from hypogoal.cells import CELLS, DONE, PLAN, RUNNING, Cell, read_plan, status_lines, unmade
from hypogoal.core.errors import UserError
from hypogoal.core.files import replace_text
from hypogoal.core.processes import CORES, cores, surroundings
from hypogoal.core.progress import duration
from hypogoal.experiments import slurm

PRELOADED = [  # modules that stages import when they are called
    "networkx",
    "h5py",
    "minigrid",
    "hypogoal.cli",
    "hypogoal.hypotheses.sub_goals",
    "hypogoal.meta.training",
    "hypogoal.baselines.agents",
    "hypogoal.evaluation.questions",
]
POLL_SECONDS = 0.05
CRASHED = (signal.SIGSEGV, signal.SIGABRT)  # torch aborts at a segmentation fault
CRASHES = 3  # a cell may crash so often: the emulator of Montezuma's Revenge can crash in long runs (its issue 11)
OTHERWISE = "Give the settings it was begun with, --from STAGE to make a stage anew with these, or another --out."


def run(
    cells: Sequence[Cell],
    out: Path,
    *,
    workers: int,
    say: Callable[[str], None],
    sbatch: Sequence[str] | None = None,
    resume: bool = False,
    force: bool = False,
    from_: str | None = None,
    only: str | None = None,
) -> None:
    """Run the cells that are not done, on this machine or, with options for ``sbatch``, by Slurm.

    Raises ``UserError`` if the run exists, unless it is to be resumed, forced (all anew), or made anew ``from_`` a
    stage or ``only`` in that stage. Raises ``UserError`` at the end if a cell is not made.
    """
    chosen = in_part(cells, from_, only)
    if out.exists() and not (force or resume or from_ or only):
        do = "Give --resume to finish it, --from STAGE to make a part anew, --force to make all anew."
        raise UserError("the run exists already", out, do)
    slurm.check_free(out, is_wanted=sbatch is not None)
    anew = [] if resume else chosen
    if force:
        anew = [*anew, *read_plan(out)]
    begin(cells, out, anew)
    todo = [cell for cell in (chosen if only else cells) if not cell.is_done]
    if sbatch is not None:
        slurm.submit(todo, out, workers, sbatch, say)
        return
    try:
        run_local(todo, workers=workers, say=say)
    except KeyboardInterrupt as error:
        error.add_note("what is done is kept: give the same command with --resume to go on")
        raise
    if not all(cell.is_done for cell in todo):
        head, *lines = [*status_lines(out), "what they need is not made"]
        do = "Mend it, then give the same command with --resume: what is done is kept."
        raise UserError(head, lines[0].strip(), do)


def in_part(cells: Sequence[Cell], from_: str | None, only: str | None) -> list[Cell]:
    """Return the cells of the stage ``only`` or, with all cells that read these, of the stage ``from_``.

    Without either, return all cells.
    """
    if not (from_ or only):
        return [*cells]
    places = {cell.place for cell in cells if cell.stage == (from_ or only)}
    if not places or (from_ and only):
        stages = dict.fromkeys(cell.stage for cell in cells)
        do = f"Choose one of {', '.join(stages)}."
        raise UserError("--from or --only needs one stage of the run", from_ or only, do)
    for cell in cells:  # in order, because a cell comes after those that it needs
        if from_ and not places.isdisjoint(cell.needs):
            places.add(cell.place)
    return [cell for cell in cells if cell.place in places]


def begin(cells: Sequence[Cell], run: Path, anew: Sequence[Cell] = ()) -> None:
    """Write the plan, and remove what the cells ``anew`` made earlier.

    Raises ``UserError`` if the run was begun with other commands for cells that are kept.
    """
    words = {cell.name: cell.words for cell in cells}
    renewed = {cell.name for cell in anew}
    for old in read_plan(run):
        is_kept = old.name not in renewed and not old.is_derived
        is_begun = old.is_done or old.draft.folder.exists()
        if is_kept and is_begun and old.words != words.get(old.name):
            raise UserError(f"the run here began {old.name} otherwise", shlex.join(old.words), OTHERWISE)
    discard(anew)
    for cell in cells:
        cell.log().parent.mkdir(parents=True, exist_ok=True)
        cell.log("code").unlink(missing_ok=True)
    replace_text(run / PLAN, CELLS.dump_json([*cells], indent=1).decode() + "\n")
    if unmade(run):
        discard([cell for cell in cells if cell.is_derived])  # an old evaluation would be of fewer cells


def discard(cells: Sequence[Cell]) -> None:
    """Remove what cells made or began. Raises ``UserError`` if a cell is being made."""
    for cell in cells:
        if cell.draft.is_locked:
            raise UserError("another process makes it", cell.draft.out, "Wait until it is done, or end it.")
    for cell in cells:
        out = cell.draft.out
        shutil.rmtree(cell.draft.folder, ignore_errors=True)
        if out.is_dir():
            shutil.rmtree(out)
        out.unlink(missing_ok=True)


def run_local(cells: Sequence[Cell], *, workers: int, say: Callable[[str], None], forked: bool | None = None) -> None:
    """Run cells that are not done, in their order, until each is done, has failed, or needs a cell that has failed.

    At most ``workers`` cells (0: one per core) run at once. Cells that start together share the cores, less one for
    each cell that already runs. If another process, left over by a run that was killed, is making a cell, that cell is
    waited for. A cell that crashes goes on from its checkpoint, at most ``CRASHES`` times. If the run is stopped, cells
    that still run get SIGTERM. ``forked``: cells start from one process that has imported what they need; this is the
    default on Linux without CUDA.
    """
    if forked is None:
        forked = sys.platform == "linux" and not any("cuda" in cell.words for cell in cells)
    context: Any = multiprocessing.get_context("forkserver" if forked else "spawn")
    if forked:
        context.set_forkserver_preload(PRELOADED)
    todo = [*cells]
    begun_at = time.monotonic()
    running: dict[Any, Cell] = {}  # cells by process
    crashes: Counter[str] = Counter()

    def end(process: Any) -> Cell:
        process.join()
        cell = running.pop(process)
        replace_text(cell.log("code"), f"{process.exitcode}\n")
        return cell

    with surroundings():
        try:
            while running or any(cell.is_makeable for cell in todo):
                free = (workers or cores()) - len(running)
                makeable = [cell for cell in todo if cell.is_makeable and not cell.draft.is_locked]
                at_work = {cell.place for cell in [*makeable, *running.values()]}
                ready = [cell for cell in makeable if at_work.isdisjoint(cell.after)]
                starting = ready[:free]
                idle_cores = cores() - len(running)
                is_first = len(todo) == len(cells)
                if starting and is_first:
                    say(f"Each line names what one command makes in {cells[0].run}.")
                for cell in starting:
                    todo.remove(cell)
                    say(f"{cell.name} begins; {_to_come(cells, len(todo), time.monotonic() - begun_at)}")
                    # A fork has the environment of the process that it is forked from.
                    variables = {**os.environ, CORES: str(max(1, idle_cores // len(starting)))}
                    words = [*cell.command, "--resume"]
                    process = context.Process(target=_make, args=(words, cell.log(), variables))
                    process.start()
                    running[process] = cell
                time.sleep(POLL_SECONDS)
                for process in [process for process in running if process.exitcode is not None]:
                    cell = end(process)
                    if cell.state == RUNNING:  # a process that is left over makes the cell
                        todo.append(cell)
                    elif cell.state == DONE:
                        say(f"{cell.name} is done")
                    elif -process.exitcode in CRASHED and crashes[cell.name] < CRASHES:
                        crashes[cell.name] += 1
                        todo.append(cell)
                        say(f"{cell.name} crashed (signal {-process.exitcode}): it goes on from its last checkpoint")
                    else:
                        say(f"{cell.name} FAILED: {cell.last_words}")
        finally:
            for process in running:
                process.terminate()
            for process in [*running]:
                end(process)


def _to_come(cells: Sequence[Cell], waiting: int, seconds: float) -> str:
    """Return how many cells wait, and how long all that is left will take.

    The pace is that of the cells that are done after ``seconds``.
    """
    done = sum(cell.is_done for cell in cells)
    left = f", about {duration(seconds / done * (len(cells) - done))} left" if done else ""
    return f"{waiting} {'command' if waiting == 1 else 'commands'} to come{left}"


def _make(words: list[str], log: Path, variables: Mapping[str, str]) -> None:
    """Run a command in a cell's process, as one types it, with this environment. Its output goes into the log."""
    os.environ.update(variables)
    with log.open("ab") as printed:
        for number in (1, 2):
            os.dup2(printed.fileno(), number)
    sys.argv = ["hypogoal", *words]
    sys.exit(import_module("hypogoal.cli").main())
