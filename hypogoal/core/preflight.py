"""Before a stage starts: what it will need of memory and disk, and whether that is there (Spec G1)."""

import shutil
from pathlib import Path
from typing import NamedTuple

from hypogoal.core.drafts import unfinished
from hypogoal.core.errors import UserError
from hypogoal.core.progress import duration
from hypogoal.core.terminal import say

CGROUP = Path("/sys/fs/cgroup")


class Needs(NamedTuple):
    """What a stage will need: bytes of memory, of all its processes together, and of disk, what it removes included."""

    memory: float
    disk: float
    seconds: float = 0.0  # 0: not known
    smaller: str = "See 'hypogoal config'."  # what to do where the memory is not there


def preflight(stage: str, out: Path, needs: Needs, *, resume: bool = False, quiet: bool = False) -> None:
    """Say, unless ``quiet``, what a stage will need, and refuse (``UserError``) to start where that does not fit.

    With ``resume`` nothing is needed for what is complete. Nothing of ``out`` need be there yet.
    """
    if resume and out.exists() and not unfinished(out):
        return
    memory, disk, seconds, smaller = needs
    free, free_text = available(), "unknown"
    space = shutil.disk_usage(next(folder for folder in out.absolute().parents if folder.is_dir())).free
    if free is not None:
        free_text = human(free)
        if memory > free:
            what = f"not enough memory: about {human(memory)} needed, {free_text} free"
            raise UserError(what, stage, smaller)
    if disk > space:
        raise UserError(f"not enough disk: about {human(disk)} needed, {human(space)} free", out, "Free some of it.")
    if not quiet:
        needed = (
            f"needs about {human(memory)} of memory ({free_text} free), {human(disk)} of disk ({human(space)} free)"
        )
        say(f"{stage}: {needed}{f', {duration(seconds)}' if seconds else ''}", err=True)


def available() -> int | None:
    """Bytes that a stage can have: what is free, and what this process has, which is part of what the stage needs."""
    free = free_memory()
    return None if free is None else free + own_memory()


def free_memory() -> int | None:
    """Bytes of memory that can be had: the system's, or less where a control group allows less; None if unknown."""
    limits = [amount for amount in (_told("/proc/meminfo", "MemAvailable:"), *_groups()) if amount is not None]
    return min(limits) if limits else None


def own_memory() -> int:
    """Bytes that this process has of its own, files that it maps not counted; 0 if unknown."""
    return _told("/proc/self/status", "RssAnon:") or 0


def _told(path: str, name: str) -> int | None:
    """The bytes that the system says in a line ``name 123 kB``; None where it does not."""
    try:
        for line in Path(path).read_text(encoding="ascii", errors="replace").splitlines():
            if line.startswith(name):
                return int(line.split()[1]) * 1024
    except (OSError, ValueError, IndexError):
        return None
    return None


def _groups() -> list[int]:
    """What each control group that we are in leaves: a container's, a cluster job's."""
    left = []
    for folder in _folders():
        try:
            limit, used = (int((folder / f"memory.{name}").read_text("ascii")) for name in ("max", "current"))
            rows = (line.split() for line in (folder / "memory.stat").read_text("ascii").splitlines())
            cache = next((int(row[1]) for row in rows if row[0] == "file"), 0)
        except (OSError, ValueError, IndexError):  # no such file, or "max": no limit
            continue
        left.append(max(0, limit - (used - cache)))  # the cache of files is given up when memory is asked for
    return left


def _folders() -> list[Path]:
    """The folders of our control group and of those above it (version 2)."""
    try:
        lines = Path("/proc/self/cgroup").read_text(encoding="utf-8").splitlines()
    except (OSError, ValueError):
        return []
    groups = [CGROUP / line[3:].lstrip("/") for line in lines if line.startswith("0::")]
    return [folder for place in groups for folder in (place, *place.parents) if folder.is_relative_to(CGROUP)]


def human(amount: float) -> str:
    """Bytes as a person reads them: 1.4 GB."""
    for unit in ("bytes", "kB", "MB", "GB"):
        if amount < 1000:
            return f"{amount:.0f} {unit}" if unit == "bytes" or amount >= 100 else f"{amount:.1f} {unit}"
        amount /= 1000
    return f"{amount:.1f} TB"
