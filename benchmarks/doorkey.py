"""DoorKey steps per second: MiniGrid's RGB wrapper against the engine that training uses, in one run.

    python -m benchmarks.doorkey [--short] [--json PATH]

All play uniformly random actions, drawn beforehand, on the same layouts, and deliver the full image as uint8
(64, 64, 3) at every step: MiniGrid as ``RGBImgObsWrapper(tile_size=8)`` around the same three-key env; the engine of
64 environments. The last row delivers the cells' codes, which the light networks read.
MiniGrid has no way to step many at once that is faster than one, so its figure is the yardstick for all.
Engines start cold in every repeat, which has a layout of its own: what they remember of it, they work out within the
time measured.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from minigrid.envs import DoorKeyEnv as DoorKeyOfMiniGrid
from minigrid.wrappers import RGBImgObsWrapper

from benchmarks import timing
from hypogoal.domains.doorkey.engine import DoorKeyEngine
from hypogoal.domains.doorkey.env import DoorKeyGrid

MANY = 64
N_ACTIONS = 7
YARDSTICK = "MiniGrid, three keys"
WANTED = {f"engine, {MANY} environments, images": 300.0}


def minigrid(env: Any, actions: list[int]) -> float:
    """CPU seconds of a step of MiniGrid behind its RGB wrapper."""
    env = RGBImgObsWrapper(env, tile_size=8)
    env.reset(seed=0)
    for action in range(N_ACTIONS):  # its cache of drawn tiles is warm
        env.step(action)

    def play() -> None:
        for action in actions:
            _, _, terminated, truncated, _ = env.step(action)
            if terminated or truncated:
                env.reset()

    return timing.cpu_seconds(play) / len(actions)


def engine(layout_seed: int, actions: np.ndarray, images: bool) -> float:
    """CPU seconds of a step of ours: its images are drawn, or the cells' codes read."""
    played = DoorKeyEngine(layout_seed, MANY)

    def play() -> None:
        for row in actions:
            played.step(row)
            _ = played.images(played.ids) if images else played.codes(played.ids)

    return timing.cpu_seconds(play) / actions.size


def candidates(layout_seed: int, theirs: int, ours: int) -> dict[str, Callable[[], float]]:
    """All, on one layout."""
    rng = np.random.default_rng(layout_seed)
    actions = rng.integers(N_ACTIONS, size=theirs).tolist()
    rows = rng.integers(N_ACTIONS, size=(ours // MANY, MANY))
    return {
        "MiniGrid, stock DoorKey-8x8": lambda: minigrid(DoorKeyOfMiniGrid(size=8, max_steps=500), actions),
        YARDSTICK: lambda: minigrid(DoorKeyGrid(layout_seed=layout_seed), actions),
        f"engine, {MANY} environments, images": lambda: engine(layout_seed, rows, True),
        f"engine, {MANY} environments, codes": lambda: engine(layout_seed, rows, False),
    }


def main() -> None:
    """Measure, print the table, write the JSON."""
    given = timing.arguments(__doc__, "doorkey")
    repeats, theirs, ours = (3, 300, 32_000) if given.short else (7, 3000, 320_000)
    about = timing.machine("minigrid", "gymnasium", "numpy")
    found: dict[str, list[float]] = {}
    for layout_seed in range(repeats):
        for name, seconds in timing.alternated(candidates(layout_seed, theirs, ours), 1).items():
            found.setdefault(name, []).extend(seconds)
    rows = timing.rows_of(found, YARDSTICK, WANTED)
    timing.show(f"a step, {repeats} layouts, {theirs:,} steps of MiniGrid's and {ours:,} of ours on each", rows)
    timing.write(given.json, about, {"repeats": repeats, "engine_steps": ours, "results": rows})


if __name__ == "__main__":
    main()
