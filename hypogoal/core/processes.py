"""Where work runs: in child processes, on a device, with one torch thread. Also how work is stopped."""

import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from math import ceil, inf
from pathlib import Path
from types import FrameType, ModuleType
from typing import TypeVar

from hypogoal.core import own_code
from hypogoal.core.errors import UserError

T = TypeVar("T")
CORES = "HYPOGOAL_CORES"  # an environment variable that says how many cores a stage may use
DEVICES = ("auto", "cpu", "cuda")
# Libraries use one thread per process, unless the user sets these environment variables.
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
SIGNALS = (signal.SIGINT, signal.SIGTERM)  # Ctrl-C, and a cancelled job
GROUPS = (Path("/proc/self/cgroup"), Path("/sys/fs/cgroup"))  # on Linux, this process's control groups and their limits

_turn = threading.RLock()  # can be acquired again, because a stage may call another stage


def stop(number: int, _frame: FrameType | None) -> None:
    """Handle a signal: raise ``KeyboardInterrupt`` wherever Python is, with the signal's number as its argument."""
    for each in SIGNALS:  # ignored from now on, because another signal would interrupt the clean-up
        signal.signal(each, signal.SIG_IGN)
    raise KeyboardInterrupt(number)


def cores() -> int:
    """Return how many cores this process may use: those that the system allows, or fewer with ``HYPOGOAL_CORES``.

    A quota of the process's control groups counts in whole cores, rounded up.
    """
    affinity = getattr(os, "sched_getaffinity", None)  # not on every system
    count = len(affinity(0)) if affinity else os.cpu_count()
    return allowed(ceil(min(count or 1, quota(*GROUPS))))


def quota(groups: Path, limits: Path) -> float:
    """Return how many cores' time the control groups of a process have, or infinity without a limit.

    Control groups of both versions are read.
    """
    least = inf
    if not groups.is_file():
        return least
    for line in groups.read_text().splitlines():
        _, controllers, place = line.split(":", 2)
        for within in (Path(place), *Path(place).parents):  # a container sees its own group as the root
            folder = limits / controllers / within.relative_to("/")
            with suppress(OSError, ValueError, ZeroDivisionError):  # without a file, or with "max", there is no limit
                if controllers:
                    texts = [(folder / f"cpu.cfs_{name}_us").read_text() for name in ("quota", "period")]
                else:
                    texts = (folder / "cpu.max").read_text().split()
                time, period = map(float, texts)
                if time > 0:
                    least = min(least, time / period)
    return least


def allowed(wanted: int) -> int:
    """Return how many of ``wanted`` processes a stage may use. With ``wanted`` 0, that is one process per core."""
    return min(wanted, int(os.environ.get(CORES, wanted))) if wanted else cores()


def in_processes(
    tasks: Sequence[Callable[[], T]],
    workers: int,
    done: Callable[[int, T], None],
    *,
    forked: bool = False,
) -> None:
    """Run tasks, ``workers`` of them at once. ``done`` is called with each task's number and result.

    With one worker, the tasks run in this process. They also do so in a process that may not have children, such as
    those of a ``Pool``. In child processes, tasks and results must be picklable. If a task fails, or at Ctrl-C, running
    tasks are ended.

    Child processes are spawned and import what they need, which takes some 3 s each. They are not forked because a fork
    copies the caller's locks, and CUDA does not survive a fork. ``forked`` is for tasks that need neither locks nor
    CUDA, and it has an effect on Linux only. The program that called is not run again in spawned processes, because it
    may have no file, or no main guard.

    Raises:
        UserError: if processes cannot share memory, or if a process was killed or could not start.
    """
    workers = min(workers, len(tasks))
    if workers <= 1 or multiprocessing.current_process().daemon:
        for number, task in enumerate(tasks):
            done(number, task())
        return
    others = set(multiprocessing.active_children())
    context = multiprocessing.get_context("fork" if forked and sys.platform == "linux" else "spawn")
    try:
        pool = ProcessPoolExecutor(workers, context, _begin, (own_code.environment(),))
    except (OSError, ImportError) as error:
        do = f"Make /dev/shm writable, or give {CORES}=1 in the environment: one process."
        raise UserError(f"processes cannot share memory ({error})", "/dev/shm", do) from None
    try:
        with _without_program():
            futures = {pool.submit(_run, task): number for number, task in enumerate(tasks)}
        for future in as_completed(list(futures)):
            done(futures.pop(future), future.result())
    except BrokenProcessPool:
        fault = "a process was killed by the system, most likely for lack of memory, or could not start"
        raise UserError(fault, None, "Run fewer at once: --set workers=1.") from None
    except BaseException:
        for process in set(multiprocessing.active_children()) - others:
            process.terminate()
        raise
    finally:
        pool.shutdown(cancel_futures=True)


@contextmanager
def _without_program() -> Iterator[None]:
    """Keep processes that are spawned within the block from running the program, unless its code is asked for."""
    program = sys.modules["__main__"]
    if not own_code.is_in_program():
        sys.modules["__main__"] = ModuleType("__main__")
    try:
        yield
    finally:
        sys.modules["__main__"] = program


def _begin(environment: Mapping[str, str]) -> None:
    """Do what a child process does first: set its environment and its handlers of signals, and watch its parent."""
    os.environ.update(environment)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent handles Ctrl-C, and ends this process
    signal.signal(signal.SIGTERM, signal.SIG_DFL)  # a fork has its parent's handler, which would end only a task
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """End this process when its parent ends, because an orphan would write beside its successor."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


def _run(task: Callable[[], T]) -> T:
    try:
        return task()
    except BaseException as error:
        user_error = own_code.of_user(error)  # here, because tracebacks, which tell the place, are not sent on
        if user_error is None:
            raise
        raise user_error from error


@contextmanager
def surroundings() -> Iterator[None]:
    """Give this process, within the block, the environment variables that its child processes get."""
    before = dict(os.environ)
    # A process that starts others imports no random.py from the current folder.
    os.environ.update({**dict.fromkeys(THREADS, "1"), **before, **own_code.environment(), "PYTHONSAFEPATH": "1"})
    try:
        yield
    finally:
        os.environ.clear()
        os.environ.update(before)


def prepare(device: str = "auto") -> str:
    """Set torch to one thread, and without denormal numbers. Return ``cpu`` or ``cuda`` (``auto`` is the CPU).

    One thread per process is as fast on small networks and does not suffer from busy neighbours. It gives the same
    bytes again on the same machine, while other processors round differently. Denormal numbers are below 1e-38, which
    is where Adam's moments of unused weights end. They count as 0, because arithmetic with them takes many times as
    long. Raises ``UserError`` if the device is unknown, or if torch does not find it.
    """
    import numpy
    import torch

    for kind in (numpy.float32, numpy.float64):
        numpy.finfo(kind)  # before denormal numbers are off, because NumPy 2.3 and older warn if there are none
    torch.set_num_threads(1)
    torch.set_flush_denormal(True)
    if device not in DEVICES:
        raise UserError("unknown device", device, f"Choose one of {', '.join(DEVICES)}.")
    if device == "cuda" and not torch.cuda.is_available():
        raise UserError("torch finds no GPU", f"torch {torch.__version__}", "Use --device cpu, or see docs/cluster.md.")
    return "cuda" if device == "cuda" else "cpu"


@contextmanager
def own_settings() -> Iterator[None]:
    """Run the block with torch's default settings, and restore the caller's settings afterwards.

    Most of the settings belong to the whole process, so its threads take turns.
    """
    import torch

    with _turn:
        # torch 2.8 cannot be asked for its default device again once that was set back to None.
        threads, dtype, device = torch.get_num_threads(), torch.get_default_dtype(), torch.empty(0).device
        torch.set_default_dtype(torch.float32)
        torch.set_default_device(None)
        try:
            with torch.inference_mode(False), torch.enable_grad(), torch.autocast("cpu", enabled=False):
                yield
        finally:
            torch.set_num_threads(threads)
            torch.set_flush_denormal(False)
            torch.set_default_dtype(dtype)
            torch.set_default_device(device if device.type != "cpu" else None)
