"""Cells on this machine: as many processes at once as there are cores."""

import multiprocessing
import os
import signal
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any

from hypogoal.cells import DONE, RUNNING, Cell
from hypogoal.core.files import replace_text
from hypogoal.core.own_code import environment
from hypogoal.core.processes import CORES, cores

# Libraries use one thread per process, unless the user sets these.
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
PRELOADED = [  # what stages import when they are called
    "torch._dynamo",
    "networkx",
    "h5py",
    "minigrid",
    "hypogoal.cli",
    "hypogoal.hypotheses.sub_goals",
    "hypogoal.meta.training",
    "hypogoal.learners.baselines.agents",
    "hypogoal.evaluation.questions",
]
POLL_SECONDS = 0.05
CRASHED = (signal.SIGSEGV, signal.SIGABRT)  # torch aborts at a segmentation fault
CRASHES = 3  # of a cell that are survived: the emulator of Montezuma's Revenge can crash in long runs (its issue 11)


def run_local(cells: Sequence[Cell], *, workers: int, say: Callable[[str], None], forked: bool | None = None) -> None:
    """Run cells that are not done, in their order, until each is done, has failed, or needs one that has.

    At most ``workers`` (0: one per core) run at once; those that start together share the cores. One that another
    process is making, left over by a run that was killed, is waited for. One that crashes goes on from its checkpoint,
    at most ``CRASHES`` times. At the end those that still run get SIGTERM. ``forked``: cells start from one process
    that has imported what they need; by default on Linux without CUDA.
    """
    if forked is None:
        forked = sys.platform == "linux" and not any("cuda" in cell.words for cell in cells)
    context: Any = multiprocessing.get_context("forkserver" if forked else "spawn")
    if forked:
        context.set_forkserver_preload(PRELOADED)
    todo = [*cells]
    running: dict[Any, Cell] = {}  # by process
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
                for cell in ready[:free]:
                    todo.remove(cell)
                    say(f"{cell.name} ...; {len(todo)} to come")
                    # A fork has the environment of the process that it is forked from.
                    variables = {**os.environ, CORES: str(max(1, free // len(ready)))}
                    words = [*cell.command, "--resume"]
                    process = context.Process(target=_make, args=(words, cell.log(), variables))
                    process.start()
                    running[process] = cell
                time.sleep(POLL_SECONDS)
                for process in [process for process in running if process.exitcode is not None]:
                    cell = end(process)
                    if cell.state == RUNNING:  # by a process that is left over
                        todo.append(cell)
                    elif cell.state == DONE:
                        say(f"{cell.name} done")
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


@contextmanager
def surroundings() -> Iterator[None]:
    """Within it this process has the environment of those that it starts."""
    before = dict(os.environ)
    # A process that starts others imports no random.py from the current folder.
    os.environ.update({**dict.fromkeys(THREADS, "1"), **before, **environment(), "PYTHONSAFEPATH": "1"})
    try:
        yield
    finally:
        os.environ.clear()
        os.environ.update(before)


def _make(words: list[str], log: Path, variables: Mapping[str, str]) -> None:
    """In a cell's process: the command, as one types it, with this environment; its output goes into its log."""
    os.environ.update(variables)
    with log.open("ab") as printed:
        for number in (1, 2):
            os.dup2(printed.fileno(), number)
    sys.argv = ["hypogoal", *words]
    sys.exit(import_module("hypogoal.cli").main())
