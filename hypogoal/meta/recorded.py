"""Episodes that a trained agent plays, step by step: for other software to learn from."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hypogoal.domains.base import Step
from hypogoal.options.execution import OptionLoop


@dataclass(frozen=True)
class Episode:
    """T steps.

    Attributes:
        observations: uint8 (T + 1, *obs), the last one that of the state it ended in.
        actions: int64 (T,), primitive ones.
        options: int64 (T,), which option ran.
        rewards: float32 (T,).
        terminated: the task was over; otherwise the episode was cut.
    """

    observations: NDArray[np.uint8]
    actions: NDArray[np.int64]
    options: NDArray[np.int64]
    rewards: NDArray[np.float32]
    terminated: bool


def play_episodes(loop: OptionLoop, count: int) -> Iterator[Episode]:
    """So many episodes one after the other, with greedy options; options are drawn as in training.

    Args:
        loop: from :func:`hypogoal.meta.watched.loop_of`.
        count: episodes.
    """
    engine: Any = loop.engine
    play = engine.step
    pictures: list[NDArray[np.uint8]] = []
    rows: list[tuple[int, int, float]] = []
    arrived: list[Step] = []

    def step(actions: NDArray[np.int64]) -> Step:
        pictures.append(engine.images(engine.ids)[0].copy())
        found: Step = play(actions)
        rows.append((int(actions[0]), int(loop.option[0]), float(found.rewards[0])))
        arrived.append(found)
        return found

    engine.step = step
    for _ in range(count):
        for part in (pictures, rows, arrived):
            part.clear()
        episodes = len(loop.recorder.episodes)
        while len(loop.recorder.episodes) == episodes:
            loop.step(explore=False, learn=False)
        pictures.append(engine.images(arrived[-1].next_ids)[0].copy())
        actions, options, rewards = zip(*rows, strict=True)
        yield Episode(
            np.stack(pictures),
            np.array(actions, dtype=np.int64),
            np.array(options, dtype=np.int64),
            np.array(rewards, dtype=np.float32),
            bool(loop.recorder.episodes[-1][3]),
        )
