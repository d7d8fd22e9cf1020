"""Tasks on several cores: each in a process of its own, none of which outlives the one that asked for it."""

import ctypes
import multiprocessing
import os
import signal
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from typing import TypeVar

from hypogoal.core import own_code
from hypogoal.core.errors import Killed
from hypogoal.core.own_code import users_own
from hypogoal.core.surroundings import environment, shield

T = TypeVar("T")
SAFE_PATH = {"PYTHONSAFEPATH": "1"}  # a Python started with it is as ``PYTHON`` is
CORES = "HYPOGOAL_CORES"  # in the environment: how many cores a stage may use, where others use the rest
RESEND_SECONDS = 1.0
KILLED = 9  # SIGKILL, which Windows has no name for
PYTHON = (sys.executable, "-P")  # a Python that does not run a random.py of the current folder in place of its own
PR_SET_PDEATHSIG = 1  # Linux's prctl: the signal that this process gets when its parent dies


def cores() -> int:
    """How many cores this process may use: those the system gives it, or fewer where ``HYPOGOAL_CORES`` says so."""
    return allowed(len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1)


def allowed(wanted: int) -> int:
    """How many processes a stage may use that was told to use ``wanted`` (0: all it can), no more than are allotted."""
    if not wanted:
        return cores()
    setting = os.environ.get(CORES, "")
    return min(wanted, max(1, int(setting))) if setting.isdigit() else wanted


def in_processes(tasks: Sequence[Callable[[], T]], workers: int, done: Callable[[int, T], None]) -> None:
    """Run tasks, ``workers`` at once; where that is one, in this process; ``done`` is told each one's number and
    result.

    More than one at once, they and their results go from process to process; own code that is allowed here is allowed
    there. When a task fails, or at Ctrl-C, those that run get SIGTERM and are waited for: who saves checkpoints saves
    one. Where the system kills a process, it is ``Killed``.
    """
    if min(workers, len(tasks)) <= 1:
        for number, task in enumerate(tasks):
            done(number, task())
        return
    before = set(multiprocessing.active_children())
    # Started anew rather than forked: a fork takes along whatever threads and locks the caller has.
    spawn = multiprocessing.get_context("spawn")
    with environment(**SAFE_PATH):
        pool = ProcessPoolExecutor(min(workers, len(tasks)), spawn, _begin, (os.getpid(),))
    try:
        trusted = own_code.allowed()
        with environment(**SAFE_PATH):
            futures = {pool.submit(_guarded, task, trusted): number for number, task in enumerate(tasks)}
        for future in as_completed(list(futures)):
            done(futures.pop(future), future.result())
    except BrokenProcessPool:
        do = f"Run fewer at once: --set workers=1, or {CORES}=1 in the environment."
        raise Killed("a process was killed by the system, most likely for lack of memory", None, do) from None
    except BaseException:
        # Again until none is left: one that fails of its own has kept the first for the checkpoint that never comes,
        # and waits for the next task, behind a lock that a killed one may hold.
        while left := set(multiprocessing.active_children()) - before:
            for process in left:
                process.terminate()
            left.pop().join(RESEND_SECONDS)
        raise
    finally:
        pool.shutdown(cancel_futures=True)


def _begin(parent: int) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the parent alone, which sends SIGTERM on
    shield()
    die_with_parent()
    if os.getppid() != parent:
        os._exit(128 + KILLED)


def die_with_parent() -> None:
    """Have the kernel kill this process when its parent dies: an orphan would go on writing beside its successor."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, KILLED)


def _guarded(task: Callable[[], T], trusted: frozenset[str]) -> T:
    try:
        with own_code.vouched(*trusted):
            return task()
    except KeyboardInterrupt:  # the pool would give this process the next task
        os._exit(128 + signal.SIGTERM)
    except BaseException as error:
        if (user_error := users_own(error)) is None:
            raise
        raise user_error from error  # where it came from is known here only: no traceback goes along
