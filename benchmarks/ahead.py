"""Two cores on Montezuma's Revenge: ``train-options`` with ``play_ahead`` and without, by the clock on the wall.

    python -m benchmarks ahead [--short] [--json PATH]

The ceiling is the emulator alone in one process: random actions with a stack at each step. Times are of a joint step,
sixteen games at ladder 1L with oracle terminations and one update; start-up is left out. Neighbours that take a core
slow down the pair most. So the share of the ceiling is also reckoned from CPU times, as of two cores that do nothing
else: what one process does while the other waits, and the longer of what both do at once.
"""

from __future__ import annotations

import multiprocessing
import os
import statistics
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from unittest.mock import patch

from benchmarks import timing

timing.alone()

from benchmarks.loop import quietly  # noqa: E402
from benchmarks.montezuma import time_ceiling  # noqa: E402
from hypogoal.domains.montezuma_emulator import N_ACTIONS, Emulator  # noqa: E402
from hypogoal.domains.montezuma_ladders import LADDERS  # noqa: E402
from hypogoal.options.light import LightLearner  # noqa: E402
from hypogoal.options.loop import OptionLoop  # noqa: E402
from hypogoal.stages import train_options  # noqa: E402

GAMES = 16
HALF, AHEAD = "policy_pixels=half", "play_ahead=true"
CANDIDATES = {
    "one process": (),
    "play_ahead": (AHEAD,),
    "one process, half the pixels": (HALF,),
    "play_ahead, half the pixels": (HALF, AHEAD),
}
CEILING = "the emulator's ceiling"
PARTS = ("wall", "cpu", "learning", "second")  # ms of a joint step: by the clock; CPU; CPU of it; CPU of the second


def second_process() -> float:
    """CPU seconds that the processes started here and still there have taken."""
    ticks = 0
    for child in multiprocessing.active_children():
        fields = Path(f"/proc/{child.pid}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()
        ticks += int(fields[11]) + int(fields[12])
    return ticks / os.sysconf("SC_CLK_TCK")


def climbing(ensemble: Path, steps: int, folder: Path, *more: str) -> dict[str, float]:
    """Milliseconds of a joint step by ``PARTS``."""
    spent = dict.fromkeys(PARTS, 0.0)
    train, learn = train_options.train, LightLearner.learn

    def learning(learner: LightLearner) -> Any:
        begin = time.process_time()
        numbers = learn(learner)
        spent["learning"] += time.process_time() - begin
        return numbers

    def training(loop: OptionLoop, *arguments: Any) -> Any:
        loop.engine.snapshot()  # the second process has started
        begin, cpu, second = time.perf_counter(), time.process_time(), second_process()
        solved = train(loop, *arguments)
        spent["wall"], spent["cpu"] = time.perf_counter() - begin, time.process_time() - cpu
        spent["second"] = second_process() - second
        return solved

    settings = ("start=1L", "termination=oracle", "warm_up=100", f"environments={GAMES}", f"steps={steps}", *more)
    with patch.object(train_options, "train", training), patch.object(LightLearner, "learn", learning):
        out = folder / f"out-{time.monotonic_ns()}"
        quietly("train-options", ensemble, "--out", out, *(word for pair in settings for word in ("--set", pair)))
    return {part: 1e3 * seconds * GAMES / steps for part, seconds in spent.items()}


def undisturbed(spent: Mapping[str, float]) -> float:
    """Milliseconds of a joint step by the clock if each process had a core of its own."""
    if not spent["second"]:
        return spent["cpu"]
    return spent["cpu"] - spent["learning"] + max(spent["learning"], spent["second"])


def ceiling(steps: int) -> dict[str, float]:
    """The same of the emulator alone."""
    import numpy as np

    actions = np.random.default_rng(0).integers(N_ACTIONS, size=steps).tolist()
    emulator, spent = Emulator(0), dict.fromkeys(PARTS, 0.0)
    cpu = time.process_time()
    spent["wall"] = 1e3 * GAMES / time_ceiling(emulator, LADDERS[0].top, actions, time.perf_counter)
    spent["cpu"] = 1e3 * GAMES * (time.process_time() - cpu) / steps
    return spent


def main() -> None:
    """Measure, print, write."""
    given = timing.arguments(__doc__, "ahead")
    repeats, steps = (1, 800) if given.short else (3, 12_000)
    machine = timing.machine("torch", "ale-py")
    print(", ".join(f"{name} {value}" for name, value in machine.items()))
    before = os.getloadavg()
    measured: dict[str, list[dict[str, float]]] = {name: [] for name in (CEILING, *CANDIDATES)}
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        rooms, ensemble = folder / "rooms.h5", folder / "ensemble"
        few = ("states_per_room=60", "unlabelled_per_room=30", "heldout_per_room=6", "workers=1")
        quietly("collect", "montezuma", "--out", rooms, *(word for pair in few for word in ("--set", pair)))
        quietly("train-ensemble", rooms, "--out", ensemble, "--set", "steps=2", "--set", "members=2")
        for _ in range(repeats):
            measured[CEILING].append(ceiling(steps))
            for name, more in CANDIDATES.items():
                measured[name].append(climbing(ensemble, steps, folder, *more))
    rows = []
    for name, repeated in measured.items():
        row: dict[str, Any] = {part: statistics.median(each[part] for each in repeated) for part in PARTS}
        pairs = [*zip(measured[CEILING], repeated, strict=True)]
        shares = {
            "by_the_clock": [alone["wall"] / each["wall"] for alone, each in pairs],
            "reckoned": [alone["cpu"] / undisturbed(each) for alone, each in pairs],
        }
        rows.append({"name": name, **row, **{share: statistics.median(each) for share, each in shares.items()}})
        rows[-1]["repeats"] = shares
    loads = [*before, *os.getloadavg()]
    print(f"load average {loads[0]:.1f} before, {loads[3]:.1f} after; ms of a joint step, medians of {repeats}")
    print(f"{'':30}" + "".join(f"{part:>10}" for part in PARTS) + "   of ceiling    reckoned")
    for row in rows:
        figures = "".join(f"{row[part]:10.2f}" for part in PARTS)
        print(f"{row['name']:30}{figures}{row['by_the_clock']:13.2f}{row['reckoned']:12.2f}")
    timing.write(given.json, machine, {"loads": loads, "steps": steps, "repeats": repeats, "montezuma": rows})


if __name__ == "__main__":
    main()
