"""Two cores on Montezuma's Revenge: ``train-options`` with ``play_ahead`` and without, by the clock on the wall.

    python -m benchmarks ahead [--short] [--json PATH]

The ceiling is the emulator alone in one process: random actions with a stack at each step. Times are of a joint step,
sixteen games at ladder 1L with oracle terminations and one update; start-up is left out. Neighbours that take a core
slow down the pair most: compare the load average, and the CPU time of both processes, which says what the clock would
say at best.
"""

from __future__ import annotations

import multiprocessing
import os
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest.mock import patch

from benchmarks import timing

timing.alone()

from benchmarks.loop import quietly  # noqa: E402
from benchmarks.montezuma import time_ceiling  # noqa: E402
from hypogoal.core.workers import Companion  # noqa: E402
from hypogoal.domains.montezuma_emulator import N_ACTIONS, Emulator  # noqa: E402
from hypogoal.domains.montezuma_ladders import LADDERS  # noqa: E402
from hypogoal.options.light import LightLearner  # noqa: E402
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
PARTS = ("wall", "cpu", "learning", "waiting", "second")  # ms of a joint step; the second process: CPU time


def second_process() -> float:
    """CPU seconds that the second process has taken, 0 where there is none."""
    children = multiprocessing.active_children()
    fields = Path(f"/proc/{children[0].pid}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK") if children else 0.0


def climbing(ensemble: Path, steps: int, folder: Path, *more: str) -> dict[str, float]:
    """Milliseconds of a joint step by ``PARTS``."""
    spent = dict.fromkeys(PARTS, 0.0)
    train, learn, receive = train_options.train, LightLearner.learn, Companion.receive

    def timed(part: str, work: Callable[..., Any]) -> Callable[..., Any]:
        def measured(*arguments: Any) -> Any:
            begin = time.perf_counter()
            answer = work(*arguments)
            spent[part] += time.perf_counter() - begin
            return answer

        return measured

    def training(*arguments: Any) -> Any:
        begin, cpu, second = time.perf_counter(), time.process_time(), second_process() if AHEAD in more else 0.0
        solved = train(*arguments)
        spent["wall"], spent["cpu"] = time.perf_counter() - begin, time.process_time() - cpu
        spent["second"] = second_process() - second if AHEAD in more else 0.0
        return solved

    settings = ("start=1L", "termination=oracle", "warm_up=100", f"environments={GAMES}", f"steps={steps}", *more)
    patches = (
        patch.object(train_options, "train", training),
        patch.object(LightLearner, "learn", timed("learning", learn)),
        patch.object(Companion, "receive", timed("waiting", receive)),
    )
    with patches[0], patches[1], patches[2]:
        out = folder / f"out-{time.monotonic_ns()}"
        quietly("train-options", ensemble, "--out", out, *(word for pair in settings for word in ("--set", pair)))
    return {part: 1e3 * seconds * GAMES / steps for part, seconds in spent.items()}


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
        shares = [at_best["wall"] / each["wall"] for at_best, each in zip(measured[CEILING], repeated, strict=True)]
        rows.append({"name": name, **row, "of_ceiling": statistics.median(shares), "shares": shares})
    loads = [*before, *os.getloadavg()]
    print(f"load average {loads[0]:.1f} before, {loads[3]:.1f} after; ms of a joint step, medians of {repeats}")
    print(f"{'':30}" + "".join(f"{part:>10}" for part in PARTS) + f"{'of ceiling':>12}")
    for row in rows:
        print(f"{row['name']:30}" + "".join(f"{row[part]:10.2f}" for part in PARTS) + f"{row['of_ceiling']:12.2f}")
    timing.write(given.json, machine, {"loads": loads, "steps": steps, "repeats": repeats, "montezuma": rows})


if __name__ == "__main__":
    main()
