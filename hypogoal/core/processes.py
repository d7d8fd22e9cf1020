"""Where work runs: in processes of their own, on a device, with one thread of torch's; how it is stopped."""

import ctypes
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
from typing import Any, TypeVar

from hypogoal.core import own_code
from hypogoal.core.errors import UserError

T = TypeVar("T")
CORES = "HYPOGOAL_CORES"  # in the environment: how many cores a stage may use
DEVICES = ("auto", "cpu", "cuda")
# Libraries use one thread per process, unless the user sets these.
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
SIGNALS = (signal.SIGINT, signal.SIGTERM)  # Ctrl-C, and a cancelled job
GROUPS = (Path("/proc/self/cgroup"), Path("/sys/fs/cgroup"))  # Linux's: those of this process, their limits
M_TRIM_THRESHOLD, M_MMAP_MAX = -1, -4  # parameters of the C library's mallopt

_turn = threading.RLock()  # a stage may call another one


def stop(number: int, _frame: FrameType | None) -> None:
    """A handler of signals: ``KeyboardInterrupt`` wherever Python is, with the signal's number as its argument."""
    for each in SIGNALS:  # another one would interrupt the clean-up
        signal.signal(each, signal.SIG_IGN)
    raise KeyboardInterrupt(number)


def cores() -> int:
    """How many cores this process may use: those the system allows, or fewer with ``HYPOGOAL_CORES``.

    A quota of its control groups counts in whole cores, rounded up.
    """
    affinity = getattr(os, "sched_getaffinity", None)  # not on every system
    count = len(affinity(0)) if affinity else os.cpu_count()
    return allowed(ceil(min(count or 1, quota(*GROUPS))))


def quota(groups: Path, limits: Path) -> float:
    """How many cores' time the control groups of a process have, of either version; infinite without a limit."""
    least = inf
    if not groups.is_file():
        return least
    for line in groups.read_text().splitlines():
        _, controllers, place = line.split(":", 2)
        for within in (Path(place), *Path(place).parents):  # a container sees its own group as the root
            folder = limits / controllers / within.relative_to("/")
            with suppress(OSError, ValueError, ZeroDivisionError):  # no file: not limited here; "max"
                if controllers:
                    texts = [(folder / f"cpu.cfs_{name}_us").read_text() for name in ("quota", "period")]
                else:
                    texts = (folder / "cpu.max").read_text().split()
                time, period = map(float, texts)
                if time > 0:
                    least = min(least, time / period)
    return least


def allowed(wanted: int) -> int:
    """How many of ``wanted`` processes (0: one per core) a stage may use."""
    return min(wanted, int(os.environ.get(CORES, wanted))) if wanted else cores()


def in_processes(
    tasks: Sequence[Callable[[], T]],
    workers: int,
    done: Callable[[int, T], None],
    *,
    forked: bool = False,
) -> None:
    """Run tasks, ``workers`` at once; ``done`` gets each task's number and result.

    One at once runs in this process, and so do all in a process that may not have others, as those of a ``Pool``. In
    other processes tasks and results must be picklable. If a task fails, or at Ctrl-C, running ones are ended.

    Processes are spawned, and import what they need, for some 3 s each: a fork copies the caller's locks, and CUDA does
    not survive it. ``forked`` is for tasks that need neither; it holds on Linux only. The program that called is not
    run again in spawned ones: it may have no file, or no main guard.
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
    """Processes that are spawned within it do not run the program, unless code of it is asked for."""
    program = sys.modules["__main__"]
    if not own_code.is_in_program():
        sys.modules["__main__"] = ModuleType("__main__")
    try:
        yield
    finally:
        sys.modules["__main__"] = program


def _begin(environment: Mapping[str, str]) -> None:
    """What a process does first."""
    os.environ.update(environment)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent handles Ctrl-C, and ends this process
    signal.signal(signal.SIGTERM, signal.SIG_DFL)  # at once: a fork has its parent's handler, which ends a task alone
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """An orphan would write beside its successor."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


def _run(task: Callable[[], T]) -> T:
    try:
        return task()
    except BaseException as error:
        user_error = own_code.of_user(error)  # its place is only known here: tracebacks are not sent to the parent
        if user_error is None:
            raise
        raise user_error from error


@contextmanager
def surroundings() -> Iterator[None]:
    """Within it this process has the environment of those that it starts."""
    before = dict(os.environ)
    # A process that starts others imports no random.py from the current folder.
    os.environ.update({**dict.fromkeys(THREADS, "1"), **before, **own_code.environment(), "PYTHONSAFEPATH": "1"})
    try:
        yield
    finally:
        os.environ.clear()
        os.environ.update(before)


def prepare(device: str = "auto") -> str:
    """Use one torch thread, no denormal numbers, and memory again; returns ``cpu`` or ``cuda`` (``auto`` is the CPU).

    One thread per process is as fast on small networks, does not suffer from busy neighbours, and gives the same bytes
    again on the same machine; other processors round differently. Denormal numbers (below 1e-38, where Adam's moments
    of unused weights end) count as 0: arithmetic with them takes many times as long. An unknown device, or one that
    torch does not find, is a ``UserError``.
    """
    import numpy
    import torch

    for kind in (numpy.float32, numpy.float64):
        numpy.finfo(kind)  # while there are denormal numbers: else NumPy 2.3 and older warn that there are none
    torch.set_num_threads(1)
    torch.set_flush_denormal(True)
    keep_freed(True)
    if device not in DEVICES:
        raise UserError("unknown device", device, f"Choose one of {', '.join(DEVICES)}.")
    if device == "cuda" and not torch.cuda.is_available():
        raise UserError("torch finds no GPU", f"torch {torch.__version__}", "Use --device cpu, or see docs/cluster.md.")
    return "cuda" if device == "cuda" else "cpu"


def keep_freed(keep: bool) -> None:
    """Whether memory that is freed stays with this process, for its next tensors; on Linux with GNU's C library.

    Where it does not, a large tensor's goes back to the system, which clears all pages of the next one.
    """
    library: Any = ctypes.CDLL(None) if sys.platform == "linux" else None
    if hasattr(library, "mallopt"):
        library.mallopt(M_MMAP_MAX, 0 if keep else 65_536)
        library.mallopt(M_TRIM_THRESHOLD, 2**31 - 1 if keep else 131_072)


@contextmanager
def own_settings() -> Iterator[None]:
    """torch as if nobody had changed its settings; afterwards they are the caller's again.

    Most are of the whole process, so its threads take turns.
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
            keep_freed(False)
            torch.set_default_dtype(dtype)
            torch.set_default_device(device if device.type != "cpu" else None)
