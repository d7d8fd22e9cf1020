"""What an experiment will cost on this machine, said before it starts (Spec G4)."""

from __future__ import annotations

import time
from collections.abc import Sequence

from hypogoal.core.preflight import human
from hypogoal.experiments.cells import Cell

# CPU seconds of the piece of training below on the core that costs are of, idle (2.5 GHz, torch 2.13).
REFERENCE_SECONDS = 0.1
REPEATS = 3
LONG_SECONDS = 3600.0  # from here on one is asked first


def machine_factor() -> float:
    """How many times as long as on the machine of docs/performance.md training takes on a core of this one.

    A short piece of it is timed (CPU time, the best of three): gradient steps of a small convolutional network.
    """
    import torch

    torch.set_num_threads(1)
    generator = torch.Generator().manual_seed(0)
    images = torch.rand(32, 3, 64, 64, generator=generator)
    layers = (torch.nn.Conv2d(3, 16, 3), torch.nn.ReLU(), torch.nn.Conv2d(16, 16, 3), torch.nn.Flatten())
    network = torch.nn.Sequential(*layers)

    def work() -> float:
        begun = time.process_time()
        for _ in range(2):
            network(images).square().mean().backward()
        return time.process_time() - begun

    work()  # the first one makes ready
    return min(work() for _ in range(REPEATS)) / REFERENCE_SECONDS


def wall_seconds(cells: Sequence[Cell], workers: int, factor: float) -> float:
    """How long the cells take with so many at once, at least; those whose cost is not known count nothing."""
    seconds = [factor * cell.cost.seconds for cell in cells]
    alone = [own / min(workers, cell.cost.cores) for own, cell in zip(seconds, cells, strict=True)]
    return max(sum(seconds) / workers, max(alone, default=0.0))


def cost_lines(cells: Sequence[Cell], workers: int, factor: float) -> list[str]:
    """What the cells take, stage by stage and in all."""
    lines = []
    for stage in dict.fromkeys(cell.stage for cell in cells):
        own = [cell.cost for cell in cells if cell.stage == stage]
        each = factor * sum(cost.seconds for cost in own) / len(own)
        memory, disk = max(cost.memory for cost in own), max(cost.disk for cost in own)
        parts = [duration(each) if each else "", f"{human(memory)} of memory" if memory else ""]
        parts.append(f"{human(disk)} of disk" if disk else "")
        told = ", ".join(part for part in parts if part) or "not known"
        lines.append(f"  {stage:15s} {len(own):5d} x {told}")
    seconds = factor * sum(cell.cost.seconds for cell in cells)
    unknown = sum(cell.cost.seconds == 0 and cell.stage != "report" for cell in cells)
    wall = duration(wall_seconds(cells, workers, factor))
    told = f"about {duration(seconds)} of one core, {wall} with {workers} at once" if seconds else "time not known"
    memory, disk = (
        sum(sorted((getattr(cell.cost, what) for cell in cells), reverse=True)[:workers]) for what in ("memory", "disk")
    )
    most = f"; at once at most {human(memory)} of memory, {human(disk)} of disk, checkpoints included" if disk else ""
    text = f"{len(cells)} commands: {told}{most}"
    text += f" ({factor:.2g} times what docs/performance.md's machine takes)" if seconds else ""
    lines.append(text + (f"; {unknown} of unknown length" if unknown and seconds else ""))
    return lines


def duration(seconds: float) -> str:
    """As a person says it: 12 min, 3.4 h."""
    if seconds < 90:
        return f"{max(1, round(seconds))} s"
    if seconds < 90 * 60:
        return f"{round(seconds / 60)} min"
    return f"{seconds / 3600:.1f} h" if seconds < 48 * 3600 else f"{seconds / 86400:.1f} days"
