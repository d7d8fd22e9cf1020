"""Work on several cores, in processes of its own, none of which outlives its parent."""

import contextlib
import ctypes
import multiprocessing
import os
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from typing import TypeVar

from hypogoal.core import own_code
from hypogoal.core.errors import Killed

T = TypeVar("T")
SAFE_PATH = {"PYTHONSAFEPATH": "1"}  # the same for a Python that multiprocessing starts
CORES = "HYPOGOAL_CORES"  # in the environment: how many cores a stage may use
RESEND_SECONDS = 1.0
KILLED = 9  # SIGKILL, which has no name on Windows
PYTHON = (sys.executable, "-P")  # does not import a random.py of the current folder in place of Python's
PR_SET_PDEATHSIG = 1  # Linux's prctl: the signal that a process gets when its parent dies


def cores() -> int:
    """How many cores this process may use: those the system allows, or fewer with ``HYPOGOAL_CORES``."""
    return allowed(len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1)


def allowed(wanted: int) -> int:
    """How many of ``wanted`` processes (0: one per core) a stage may use."""
    if not wanted:
        return cores()
    setting = os.environ.get(CORES, "")
    return min(wanted, max(1, int(setting))) if setting.isdigit() else wanted


def in_processes(tasks: Sequence[Callable[[], T]], workers: int, done: Callable[[int, T], None]) -> None:
    """Run tasks, ``workers`` at once, in this process if that is 1; ``done`` gets each task's number and result.

    In other processes tasks and results must be picklable, and user code allowed here is allowed there. If a task
    fails, or at Ctrl-C, running ones get SIGTERM and are waited for, so that they can save a checkpoint. A process
    killed by the system raises ``Killed``.
    """
    if min(workers, len(tasks)) <= 1:
        for number, task in enumerate(tasks):
            done(number, task())
        return
    before = set(multiprocessing.active_children())
    # Spawned, not forked: a fork would copy the caller's threads and locks.
    spawn = multiprocessing.get_context("spawn")
    environment = SAFE_PATH | own_code.environment()
    with with_environment(**environment):
        pool = ProcessPoolExecutor(min(workers, len(tasks)), spawn, _begin, (os.getpid(),))
    try:
        with with_environment(**environment):
            futures = {pool.submit(_guarded, task): number for number, task in enumerate(tasks)}
        for future in as_completed(list(futures)):
            done(futures.pop(future), future.result())
    except BrokenProcessPool:
        do = f"Run fewer at once: --set workers=1, or {CORES}=1 in the environment."
        raise Killed("a process was killed by the system, most likely for lack of memory", None, do) from None
    except BaseException:
        # Repeated until none is left: a process that fails holds the first signal back for a checkpoint that never
        # comes, and then waits for the next task behind a lock that a killed process may hold.
        while left := set(multiprocessing.active_children()) - before:
            for process in left:
                process.terminate()
            left.pop().join(RESEND_SECONDS)
        raise
    finally:
        pool.shutdown(cancel_futures=True)


@contextlib.contextmanager
def with_environment(**values: str) -> Iterator[None]:
    """Set environment variables within the block."""
    before = {name: os.environ.get(name) for name in values}
    os.environ.update(values)
    try:
        yield
    finally:
        for name, value in before.items():
            os.environ.pop(name, None)
            os.environ.update({} if value is None else {name: value})


def _begin(parent: int) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # only the parent handles Ctrl-C; it sends SIGTERM
    die_with_parent()
    if os.getppid() != parent:
        os._exit(128 + KILLED)


def die_with_parent() -> None:
    """Have the kernel kill this process when its parent dies: an orphan would write beside its successor."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, KILLED)


def _guarded(task: Callable[[], T]) -> T:
    try:
        return task()
    except KeyboardInterrupt:  # the pool would give this process the next task
        os._exit(128 + signal.SIGTERM)
    except BaseException as error:
        user_error = own_code.of_user(error)
        if user_error is None:
            raise
        raise user_error from error  # its place is only known here: tracebacks are not sent to the parent
