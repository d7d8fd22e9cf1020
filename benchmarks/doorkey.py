"""DoorKey steps per second: MiniGrid's RGB wrapper against the engine that training uses, in one run.

    python -m benchmarks doorkey [--short] [--json PATH]

All play uniformly random actions, drawn beforehand, on the same layouts, and deliver the full image as uint8
(64, 64, 3) at every step: MiniGrid as ``RGBImgObsWrapper(tile_size=8)`` around the same three-key env; the engine, of
64 environments, into the caller's buffer. The last row delivers the cells' codes, which the light networks read.
MiniGrid has no way to step many at once that is faster than one, so its figure is the yardstick for all.
Engines start cold in every repeat: what they remember of a layout, they work out within the time measured.
"""

from __future__ import annotations

import statistics
import time
from typing import Any, NamedTuple

import numpy as np
from minigrid.envs import DoorKeyEnv as DoorKeyOfMiniGrid
from minigrid.wrappers import RGBImgObsWrapper

from benchmarks import timing
from hypogoal.domains.doorkey.engine import DoorKeyEngine
from hypogoal.domains.doorkey.env import DoorKeyGrid

WANTED_RATIO = 300
MANY = 64
N_ACTIONS = 7


class Timing(NamedTuple):
    """One repeat: environment steps per second of CPU time, and the share of steps that met nothing new."""

    rate: float
    hits: float


def time_minigrid(env: Any, actions: list[int]) -> Timing:
    """MiniGrid behind its RGB wrapper."""
    env.reset(seed=0)
    for action in range(N_ACTIONS):  # its cache of drawn tiles is warm
        env.step(action)
    begin = time.process_time()
    for action in actions:
        _, _, terminated, truncated, _ = env.step(action)
        if terminated or truncated:
            env.reset()
    return Timing(len(actions) / (time.process_time() - begin), 1.0)


def time_many(engine: DoorKeyEngine, actions: np.ndarray, images: bool) -> Timing:
    """The engine: every step's images are drawn into the caller's buffer, or the cells' codes read."""
    buffer = np.empty((engine.count, *engine.observation_shape), np.uint8)
    begin = time.process_time()
    for row in actions:
        engine.step(row)
        _ = engine.images(engine.ids, buffer) if images else engine.codes(engine.ids)
    seconds = time.process_time() - begin
    new = len(engine.changes) + engine.n_states
    return Timing(actions.size / seconds, 1 - new / actions.size)


def measure(repeats: int, minigrid_steps: int, engine_steps: int) -> dict[str, list[Timing]]:
    """Time all in turn, so that a busy machine slows all alike; the layout seed is the repeat's number."""
    timings: dict[str, list[Timing]] = {}
    for layout_seed in range(repeats):
        rng = np.random.default_rng(layout_seed)
        actions = rng.integers(N_ACTIONS, size=engine_steps).tolist()
        rows = rng.integers(N_ACTIONS, size=(engine_steps // MANY, MANY))
        stock = RGBImgObsWrapper(DoorKeyOfMiniGrid(size=8, max_steps=500), tile_size=8)
        three_keys = RGBImgObsWrapper(DoorKeyGrid(layout_seed=layout_seed), tile_size=8)
        for name, timed in (
            ("MiniGrid, stock DoorKey-8x8", time_minigrid(stock, actions[:minigrid_steps])),
            ("MiniGrid, three keys", time_minigrid(three_keys, actions[:minigrid_steps])),
            (f"engine, {MANY} environments, images", time_many(DoorKeyEngine(layout_seed, MANY), rows, True)),
            (f"engine, {MANY} environments, codes", time_many(DoorKeyEngine(layout_seed, MANY), rows, False)),
        ):
            timings.setdefault(name, []).append(timed)
    return timings


def summary(name: str, repeated: list[Timing], yardstick: list[float]) -> dict[str, Any]:
    """Median, lowest and highest steps/s; median ratio to MiniGrid in the same repeat; median hit rate."""
    rates = [timed.rate for timed in repeated]
    ratios = [rate / reference for rate, reference in zip(rates, yardstick, strict=True)]
    return {
        "name": name,
        "steps_per_second": statistics.median(rates),
        "lowest": min(rates),
        "highest": max(rates),
        "ratio": statistics.median(ratios),
        "hit_rate": statistics.median(timed.hits for timed in repeated),
    }


def main() -> None:
    """Measure, print the table, write the JSON."""
    given = timing.arguments(__doc__, "doorkey")
    repeats, minigrid_steps, engine_steps = (3, 300, 32_000) if given.short else (7, 3000, 320_000)
    timings = measure(repeats, minigrid_steps, engine_steps)
    yardstick = [timed.rate for timed in timings["MiniGrid, three keys"]]
    results = [summary(name, repeated, yardstick) for name, repeated in timings.items()]
    about = timing.machine("minigrid", "gymnasium", "numpy")
    print(", ".join(f"{name} {value}" for name, value in about.items()))
    print(f"image uint8 (64, 64, 3) at each of {minigrid_steps:,} MiniGrid and {engine_steps:,} engine steps,")
    print(f"CPU time of one thread, {repeats} repeats (layout seeds 0-{repeats - 1}), engines from cold")
    print(f"{'':34}{'steps/s (median)':>18}{'lowest':>12}{'highest':>12}{'ratio':>9}{'hits':>8}")
    for row in results:
        print(
            f"{row['name']:34}{row['steps_per_second']:18,.0f}{row['lowest']:12,.0f}{row['highest']:12,.0f}"
            f"{row['ratio']:8.1f}x{row['hit_rate']:8.1%}"
        )
    print(f"ratio: median over repeats, to MiniGrid in the same repeat; wanted: {WANTED_RATIO}x")
    print("hits: steps that met no state, and no change of keys or door, for the first time")
    timing.write(given.json, about, {"repeats": repeats, "engine_steps": engine_steps, "results": results})


if __name__ == "__main__":
    main()
