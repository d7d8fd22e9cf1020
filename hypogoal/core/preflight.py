"""Before a stage starts: how much memory and disk it will need, and whether they are free (Spec G1)."""

import shutil
from pathlib import Path
from typing import NamedTuple

from hypogoal.core.drafts import unfinished
from hypogoal.core.errors import UserError
from hypogoal.core.progress import duration
from hypogoal.core.terminal import say

CGROUP = Path("/sys/fs/cgroup")


class Needs(NamedTuple):
    """What a stage will need: bytes of memory for all its processes, bytes of disk including temporary files."""

    memory: float
    disk: float
    seconds: float = 0.0  # 0: unknown
    smaller: str = "See 'hypogoal config'."  # what to do if memory is short


def preflight(stage: str, out: Path, needs: Needs, *, resume: bool = False, quiet: bool = False) -> None:
    """Print, unless ``quiet``, what a stage will need, and refuse (``UserError``) to start if it does not fit.

    With ``resume`` a complete output needs nothing. ``out`` and its folders need not exist.
    """
    if resume and out.exists() and not unfinished(out):
        return
    memory, disk, seconds, smaller = needs
    free, free_text = available(), "unknown"
    space = shutil.disk_usage(next(folder for folder in out.absolute().parents if folder.is_dir())).free
    if free is not None:
        free_text = human(free)
        if memory > free:
            fault = f"not enough memory: about {human(memory)} needed, {free_text} free"
            raise UserError(fault, stage, smaller)
    if disk > space:
        raise UserError(f"not enough disk: about {human(disk)} needed, {human(space)} free", out, "Free some of it.")
    if not quiet:
        needed = (
            f"needs about {human(memory)} of memory ({free_text} free), {human(disk)} of disk ({human(space)} free)"
        )
        say(f"{stage}: {needed}{f', {duration(seconds)}' if seconds else ''}", err=True, wrap=True)


def available() -> int | None:
    """Bytes available to a stage: free memory and what this process already has, which counts towards the need."""
    free = free_memory()
    return None if free is None else free + own_memory()


def free_memory() -> int | None:
    """Free bytes of memory: the system's, or less if a control group allows less; None if unknown."""
    limits = [amount for amount in (_amount("/proc/meminfo", "MemAvailable:"), *_groups()) if amount is not None]
    return min(limits) if limits else None


def own_memory() -> int:
    """Bytes of memory of this process, without mapped files; 0 if unknown."""
    return _amount("/proc/self/status", "RssAnon:") or 0


def _amount(path: str, name: str) -> int | None:
    """The bytes in a file's line ``name 123 kB``; None if there is no such line."""
    try:
        for line in Path(path).read_text(encoding="ascii", errors="replace").splitlines():
            if line.startswith(name):
                return int(line.split()[1]) * 1024
    except (OSError, ValueError, IndexError):
        return None
    return None


def _groups() -> list[int]:
    """The bytes that each control group of this process (a container's, a cluster job's) leaves free."""
    left = []
    for folder in _folders():
        try:
            limit, used = (int((folder / f"memory.{name}").read_text("ascii")) for name in ("max", "current"))
            rows = (line.split() for line in (folder / "memory.stat").read_text("ascii").splitlines())
            cache = next((int(row[1]) for row in rows if row[0] == "file"), 0)
        except (OSError, ValueError, IndexError):  # no such file, or "max": no limit
            continue
        left.append(max(0, limit - (used - cache)))  # the file cache is freed on demand
    return left


def _folders() -> list[Path]:
    """The folders of this process's control group and of those above it (version 2)."""
    try:
        lines = Path("/proc/self/cgroup").read_text(encoding="utf-8").splitlines()
    except (OSError, ValueError):
        return []
    groups = [CGROUP / line[3:].lstrip("/") for line in lines if line.startswith("0::")]
    return [folder for place in groups for folder in (place, *place.parents) if folder.is_relative_to(CGROUP)]


def human(amount: float) -> str:
    """Bytes in readable units: 1.4 GB."""
    for unit in ("bytes", "kB", "MB", "GB"):
        if amount < 1000:
            return f"{amount:.0f} {unit}" if unit == "bytes" or amount >= 100 else f"{amount:.1f} {unit}"
        amount /= 1000
    return f"{amount:.1f} TB"
