"""Cells on this machine: as many processes at once as there are cores."""

import multiprocessing
import os
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

from hypogoal.cells import DONE, RUNNING, Cell, read_plan
from hypogoal.core.files import replace_text
from hypogoal.core.own_code import environment
from hypogoal.core.processes import CORES, cores

# Libraries use one thread per process, unless the user sets these.
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMEXPR_NUM_THREADS")
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


class _Attempt(NamedTuple):
    cell: Cell
    process: Any
    cores: int


def run_local(
    cells: Sequence[Cell], run: Path, *, workers: int, say: Callable[[str], None], forked: bool | None = None
) -> None:
    """Run cells that are not done, in their order, until each is done, has failed, or needs one that has.

    They share ``workers`` cores (0: all). One that another process is making, left over by a run that was killed, is
    waited for. ``forked``: cells start from one process that has imported what they need; by default on Linux without
    CUDA.
    """
    if forked is None:
        forked = sys.platform == "linux" and not any("cuda" in cell.words for cell in cells)
    context: Any = multiprocessing.get_context("forkserver" if forked else "spawn")
    if forked:
        context.set_forkserver_preload(PRELOADED)
    todo = [*cells]
    planned = {cell.name: cell for cell in read_plan(run)}

    def is_makeable(cell: Cell) -> bool:
        return all(planned[need].is_done(run) for need in cell.needs)

    with surroundings(), _stopped_at_the_end(run) as running:
        while True:
            todo = [cell for cell in todo if not cell.is_done(run)]
            makeable = [*filter(is_makeable, todo)]
            if not (running or makeable):
                return
            free = (workers or cores()) - sum(each.cores for each in running)
            ready = [cell for cell in makeable if not cell.draft(run).is_locked]
            for cell in ready[:free]:
                todo.remove(cell)
                say(f"{cell.name} ...; {len(todo)} to come")
                share = max(1, free // len(ready))
                running.append(_Attempt(cell, _start(context, cell, run, share), share))
            time.sleep(POLL_SECONDS)
            for each in [each for each in running if each.process.exitcode is not None]:
                running.remove(each)
                _note_end(each, run)
                state = each.cell.state(run)
                if state == RUNNING:  # by a process that is left over
                    todo.append(each.cell)
                elif state == DONE:
                    say(f"{each.cell.name} done")
                else:
                    say(f"{each.cell.name} FAILED: {each.cell.last_words(run)}")


@contextmanager
def _stopped_at_the_end(run: Path) -> Iterator[list[_Attempt]]:
    """Attempts; those that still run at the end get SIGTERM."""
    running: list[_Attempt] = []
    try:
        yield running
    finally:
        for each in running:
            each.process.terminate()
        for each in running:
            each.process.join()
            _note_end(each, run)


def _note_end(attempt: _Attempt, run: Path) -> None:
    replace_text(attempt.cell.log(run, "code"), f"{attempt.process.exitcode}\n")


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


def _start(context: Any, cell: Cell, run: Path, share: int) -> Any:
    """A process that makes a cell on so many cores."""
    words = [*cell.command(run), "--resume"]
    variables = {**os.environ, CORES: str(share)}  # a fork has those of the process that it is forked from
    process = context.Process(target=_make, args=(words, str(cell.log(run)), variables))
    process.start()
    return process


def _make(words: list[str], log: str, variables: Mapping[str, str]) -> None:
    """In a cell's process: the command, as one types it, with this environment; its output goes into its log."""
    os.environ.clear()
    os.environ.update(variables)
    printed = os.open(log, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o666)
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    for number in (1, 2):
        os.dup2(printed, number)
    sys.stdout, sys.stderr = (os.fdopen(number, "w", 1, encoding="utf-8", closefd=False) for number in (1, 2))
    sys.argv = ["hypogoal", *words]
    sys.exit(import_module("hypogoal.cli").main())
