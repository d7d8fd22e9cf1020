"""Observations of two cameras and a state vector, whose sub-goal is seen by one camera and felt in the state."""

from collections.abc import Mapping
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

GOAL = "door-open"
FRONT, WRIST, STATE = (48, 64, 3), (44, 44, 3), (4,)


def observation(open_: bool, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """One state: where the door is open, the front camera sees a white patch and the state's last number is high."""
    front, wrist = (rng.integers(0, 90, size=shape, dtype=np.uint8) for shape in (FRONT, WRIST))
    state = rng.normal(size=STATE).astype(np.float32)
    if open_:
        front[8:40, 20:44], state[-1] = 255, state[-1] + 6
    return {"front": front, "wrist": wrist, "state": state}


def states(count: int, seed: int = 0) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Arrays by key, (count, ...) each, and labels (count,)."""
    rng, labels = np.random.default_rng(seed), np.arange(count) % 2 == 1
    rows = [observation(bool(label), rng) for label in labels]
    return {key: np.stack([row[key] for row in rows]) for key in rows[0]}, labels


def arrays() -> dict[str, Any]:
    """What ``numpy.savez`` is to write."""
    (seen, labels), (others, _), (test, truth) = states(40), states(20, 1), states(16, 2)
    by_name: dict[str, Mapping[str, np.ndarray]] = {
        "observations": seen, "unlabelled": others, "heldout_observations": test,
    }  # fmt: skip
    keyed = {f"{name}/{key}": part for name, parts in by_name.items() for key, part in parts.items()}
    return {**keyed, "labels": labels, "heldout_labels": truth}


class DoorEnv(gymnasium.Env[dict[str, np.ndarray], int]):
    """Action 1 opens the door, 0 closes it; the episode has eight steps, none is rewarded."""

    observation_space = spaces.Dict(
        {
            "wrist": spaces.Box(0, 255, WRIST, np.uint8),
            "front": spaces.Box(0, 255, FRONT, np.uint8),
            "state": spaces.Box(-np.inf, np.inf, STATE, np.float32),
        }
    )
    action_space = spaces.Discrete(2)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.steps, self.open = 0, False
        return observation(self.open, self.np_random), {}

    def step(self, action: int) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.steps, self.open = self.steps + 1, bool(action == 1)
        return observation(self.open, self.np_random), 0.0, False, self.steps == 8, {}
