"""End to end: agents that learn, environment steps per second of CPU time of one thread, in one run.

    python -m benchmarks.loop [--short] [--json PATH]

On DoorKey ``train-meta`` in the light setting, 15 learned members, over a run of its default length, against
stable-baselines3's PPO and DQN with its own defaults for pictures, on MiniGrid's class with
``RGBImgObsWrapper(tile_size=8)``: what one would use instead. On Montezuma's Revenge ``train-options`` against the
emulator's ceiling, random actions with a stack at each step.
"""

from __future__ import annotations

import contextlib
import io
import tempfile
import time
from pathlib import Path
from typing import Any
from unittest.mock import patch

from benchmarks import timing

timing.alone()

from minigrid.wrappers import ImgObsWrapper, RGBImgObsWrapper  # noqa: E402

from hypogoal.cli import main as hypogoal  # noqa: E402

LAYOUT = 100
WANTED = {"train-meta": 15.0}
HALF = "update_interval=16"  # half as often as the default
RESTORE_EVERY = 40  # steps of the emulator alone
CLIMBING = "train-options at a ladder"
WANTED_OF_CEILING = {CLIMBING: 0.8}


def quietly(*command: object) -> None:
    """A command of ours that must succeed."""
    with contextlib.redirect_stdout(io.StringIO()):
        if hypogoal([*map(str, command), "-q"]):
            raise SystemExit(f"failed: {command}")


def baseline(algorithm: str, steps: int) -> float:
    """Stable-baselines3's own, learning."""
    from stable_baselines3 import DQN, PPO

    from hypogoal.domains.doorkey.env import DoorKeyGrid

    env = ImgObsWrapper(RGBImgObsWrapper(DoorKeyGrid(layout_seed=LAYOUT), tile_size=8))
    if algorithm == "ppo":
        rollout = min(2048, steps)
        agent: Any = PPO("CnnPolicy", env, seed=0, device="cpu", n_steps=rollout, batch_size=min(64, rollout))
    else:
        agent = DQN("CnnPolicy", env, seed=0, device="cpu", learning_starts=100, buffer_size=10_000)
    return timing.cpu_seconds(lambda: agent.learn(steps)) / steps


def meta(ensemble: Path, steps: int, folder: Path, *more: str) -> float:
    """An environment step of ``train-meta`` on DoorKey with ``more`` settings, CPU seconds.

    The loop alone: start-up and the measures at the end are not counted.
    """
    from hypogoal.stages import agents

    loop, played = agents.train, 0.0

    def train(*given: Any) -> bool:
        nonlocal played
        begin = time.process_time()
        solved = loop(*given)
        played = time.process_time() - begin
        return solved

    changes = (word for pair in (f"steps={steps}", *more) for word in ("--set", pair))
    with patch.object(agents, "train", train):
        out = folder / f"out-{time.monotonic_ns()}"
        quietly("train-meta", ensemble, "--layout-seed", LAYOUT, "--out", out, *changes)
    return played / steps


def stage(steps: int, folder: Path, *command: object) -> float:
    """Ours, CPU seconds of a step; start-up and the measures at the end are not counted: the difference of two runs."""
    few = steps // 5
    seconds = []
    for count in (steps, few):
        words = (*command, "--out", folder / f"out-{time.monotonic_ns()}", "--set", f"steps={count}")
        seconds.append(timing.cpu_seconds(lambda words=words: quietly(*words)))  # type: ignore[misc]
    return (seconds[0] - seconds[1]) / (steps - few)


def climbing(ensemble: Path, steps: int, folder: Path) -> float:
    """An agent step of ``train-options`` at a ladder."""
    changes = ("start=1L", "termination=oracle")
    return stage(steps, folder, "train-options", ensemble, *(word for pair in changes for word in ("--set", pair)))


def ceiling(steps: int) -> float:
    """CPU seconds of an agent step of the emulator itself: random actions, a stack at each, often a state restored."""
    import numpy as np

    from hypogoal.domains.montezuma.emulator import N_ACTIONS, Emulator
    from hypogoal.domains.montezuma.ladders import LADDERS

    actions = np.random.default_rng(0).integers(N_ACTIONS, size=steps).tolist()
    emulator = Emulator()
    state = emulator.place(*LADDERS[0].top)
    assert state is not None

    def play() -> None:
        for step, action in enumerate(actions):
            if step % RESTORE_EVERY == 0:
                emulator.restore(state)
            emulator.step(action)
            _observation = emulator.stack

    return timing.cpu_seconds(play) / steps


def main() -> None:
    """Measure, print, write."""
    given = timing.arguments(__doc__, "loop")
    repeats, ours, theirs = (1, 2_500, 256) if given.short else (3, 300_000, 4_096)
    about = timing.machine("torch", "stable-baselines3", "minigrid", "ale-py")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        quietly("collect", "doorkey", "--out", folder / "data.h5", "--set", "heldout_layouts=1")
        learned = 3 if given.short else 150
        quietly("train-ensemble", folder / "data.h5", "--out", folder / "ensemble", "--set", f"steps={learned}")
        found = timing.alternated(
            {
                "PPO, stable-baselines3 on MiniGrid": lambda: baseline("ppo", theirs),
                "DQN, stable-baselines3 on MiniGrid": lambda: baseline("dqn", theirs),
                "train-meta": lambda: meta(folder / "ensemble", ours, folder),
                "train-meta, half the updates": lambda: meta(folder / "ensemble", ours, folder, HALF),
            },
            repeats,
        )
        rows = timing.rows_of(found, "PPO, stable-baselines3 on MiniGrid", WANTED)
        rooms = ("groups=1", "states_per_room=60", "unlabelled_per_room=30", "heldout_per_room=6", "workers=1")
        quietly("collect", "montezuma", "--out", folder / "rooms.h5", *(x for pair in rooms for x in ("--set", pair)))
        few = ("--set", "steps=2", "--set", "members=1", "--set", "workers=1")
        quietly("train-ensemble", folder / "rooms.h5", "--out", folder / "climbers", *few)
        climbs = 2_500 if given.short else 10_000
        climbed = timing.alternated(
            {
                "the emulator's ceiling": lambda: ceiling(1_000),
                CLIMBING: lambda: climbing(folder / "climbers", climbs, folder),
            },
            repeats,
        )
        climb = timing.rows_of(climbed, "the emulator's ceiling", WANTED_OF_CEILING)
    timing.show(f"\nDoorKey: an environment step, learning included ({ours:,} of ours)", rows)
    timing.show("\nMontezuma's Revenge: an agent step, learning included", climb)
    results = {"doorkey": rows, "steps": ours, "montezuma": climb, "repeats": repeats}
    timing.write(given.json, about, results)


if __name__ == "__main__":
    main()
