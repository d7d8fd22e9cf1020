"""RGB of stock MiniGrid environments, steps per second: ``RGBImgObsWrapper`` against ``hypogoal.make_vec``, in one run.

    python -m benchmarks pixels [--short] [--json PATH]

Both play uniformly random actions, drawn beforehand, one of each kind of MiniGrid's environments, and deliver the whole
image with the view highlighted, cells of 8 pixels, at each step, resets included: MiniGrid one environment behind its
wrapper (it has no way to step many at once that is faster than one), ``make_vec`` 64, each step's images in an array of
their own. Both play a little before the time begins, so that most tiles, which both keep, are drawn. Before that each
kind is compared, 20 steps of 64 environments, to the pixel.
"""

from __future__ import annotations

import statistics
from collections.abc import Iterable
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import SyncVectorEnv
from minigrid.wrappers import RGBImgObsWrapper

import hypogoal
from benchmarks import timing

WANTED = 20
MANY = 64
COUNTS = (1, 4, 16, 256)  # of environments, on DoorKey-8x8
KINDS = (
    *("Empty-8x8", "FourRooms", "DoorKey-8x8", "MultiRoom-N6", "KeyCorridorS3R3", "LavaCrossingS9N2"),
    *("SimpleCrossingS9N2", "Dynamic-Obstacles-8x8", "ObstructedMaze-1Dlhb", "UnlockPickup", "BlockedUnlockPickup"),
    *("Unlock", "MemoryS13", "PutNear-8x8-N3", "GoToDoor-8x8", "GoToObject-8x8-N2", "Fetch-8x8-N3", "LockedRoom"),
    *("RedBlueDoors-8x8", "DistShift1", "LavaGapS7", "Playground"),
)


def wrapped(kind: str) -> gymnasium.Env:
    """MiniGrid as it is."""
    return RGBImgObsWrapper(gymnasium.make(f"MiniGrid-{kind}-v0", disable_env_checker=True), tile_size=8)


def play_one(env: gymnasium.Env, actions: Iterable[int]) -> None:
    """MiniGrid behind its RGB wrapper, episode after episode."""
    for action in actions:
        _, _, terminated, truncated, _ = env.step(action)
        if terminated or truncated:
            env.reset()


def play_many(envs: Any, rows: np.ndarray) -> None:
    """The same of many: an episode's last image and the next one's first belong to one step, as above."""
    for row in rows:
        envs.step(row)


def compare(kind: str, rows: np.ndarray) -> None:
    """That both show the same."""
    fast: Any = hypogoal.make_vec(f"MiniGrid-{kind}-v0", rows.shape[1])
    slow: Any = SyncVectorEnv([lambda: wrapped(kind)] * rows.shape[1])
    shown, wanted = fast.reset(seed=0)[0], slow.reset(seed=0)[0]
    for row in rows:
        for key in ("image", "direction"):
            np.testing.assert_array_equal(shown[key], wanted[key])
        assert shown["mission"] == wanted["mission"]
        shown, wanted = fast.step(row)[0], slow.step(row)[0]


def measure(kind: str, repeats: int, steps: int, many: int = MANY) -> dict[str, Any]:
    """Microseconds of CPU a step of one environment, median, and the ratio in the same repeat, with its range."""
    one, slow, fast = wrapped(kind), [], []
    envs = hypogoal.make_vec(f"MiniGrid-{kind}-v0", many, autoreset_mode="SameStep")
    n: int = one.action_space.n  # type: ignore[attr-defined]
    for repeat in range(repeats):
        rng = np.random.default_rng(repeat)
        rows = rng.integers(n, size=(max(10 * steps, many) // many, many))
        one.reset(seed=repeat)
        envs.reset(seed=repeat)
        if not repeat:
            play_one(one, range(n))
            play_many(envs, rows[:50])
        actions = rng.integers(n, size=steps).tolist()
        slow.append(timing.cpu_seconds(lambda actions=actions: play_one(one, actions)) / steps)  # type: ignore[misc]
        fast.append(timing.cpu_seconds(lambda rows=rows: play_many(envs, rows)) / rows.size)  # type: ignore[misc]
    ratios = [theirs / ours for theirs, ours in zip(slow, fast, strict=True)]
    inner: Any = one.unwrapped
    return {
        "kind": kind,
        "cells": [inner.width, inner.height],
        "environments": many,
        "wrapper_microseconds": 1e6 * statistics.median(slow),
        "microseconds": 1e6 * statistics.median(fast),
        "ratio": statistics.median(ratios),
        "lowest": min(ratios),
        "highest": max(ratios),
        "wanted": WANTED,
    }


def main() -> None:
    """Compare, measure, print, write."""
    given = timing.arguments(__doc__, "pixels")
    repeats, steps, compared = (3, 100, 3) if given.short else (7, 800, 20)
    about = timing.machine("minigrid", "gymnasium", "numpy")
    print(", ".join(f"{name} {value}" for name, value in about.items()))
    print(f"{'':24}{'cells':>8}{'wrapper':>12}{'make_vec':>12}{'ratio':>9}   lowest to highest of {repeats}")
    rows = []
    for kind, many in [(kind, MANY) for kind in KINDS] + [("DoorKey-8x8", count) for count in COUNTS]:
        if many == MANY:
            n: int = wrapped(kind).action_space.n  # type: ignore[attr-defined]
            compare(kind, np.random.default_rng(0).integers(n, size=(compared, MANY)))
        rows.append(measure(kind, repeats, steps, many))
        row, size = rows[-1], "x".join(map(str, rows[-1]["cells"]))
        print(
            f"{kind if many == MANY else f'{kind}, {many} at once':24}{size:>8}{row['wrapper_microseconds']:9,.0f} us"
            f"{row['microseconds']:9.1f} us{row['ratio']:8.1f}x   {row['lowest']:.1f} to {row['highest']:.1f}",
            flush=True,
        )
    reached = sum(row["ratio"] >= WANTED for row in rows[: len(KINDS)])
    print(f"wanted: {WANTED}x with {MANY} at once; {reached} of {len(KINDS)} kinds reach it")
    timing.write(given.json, about, {"repeats": repeats, "wrapper_steps": steps, "results": rows})


if __name__ == "__main__":
    main()
