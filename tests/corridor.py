"""A corridor with the engine's interface: small enough to learn in seconds, with states that look alike."""

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from hypogoal.domains.base import Engine, Step

LENGTH = 6


class Corridor(Engine):
    """Cells 0..5, start at 2; action 0 goes left, 1 right; the task ends at the right end with reward 1.

    Sub-goals: be at the left end, be at the right end. The image shows the agent's cell as white, unless ``blind``,
    where only the first step of an episode shows anything.
    """

    n_actions = 2
    n_states = LENGTH
    observation_shape = (16, 64, 3)
    resumes = True
    sub_goals = ("left-end", "right-end")

    def __init__(self, count: int, max_steps: int = 30):
        self.count, self.max_steps = count, max_steps
        self.reset()

    def reset(self) -> np.ndarray:
        self.ids = np.full(self.count, 2, dtype=np.int64)
        self.elapsed = np.zeros(self.count, dtype=np.int64)
        return self.ids.copy()

    def step(self, actions: np.ndarray) -> Step:
        following = np.clip(self.ids + np.where(actions == 1, 1, -1), 0, LENGTH - 1)
        terminated = following == LENGTH - 1
        self.elapsed += 1
        truncated = self.elapsed >= self.max_steps
        over = terminated | truncated
        self.ids = np.where(over, 2, following)
        self.elapsed = np.where(over, 0, self.elapsed)
        return Step(following, terminated.astype(np.float32), terminated, truncated & ~terminated)

    def snapshot(self) -> dict[str, Any]:
        return {"ids": self.ids.copy(), "elapsed": self.elapsed.copy()}

    def restore(self, snapshot: dict[str, Any]) -> None:
        self.ids, self.elapsed = snapshot["ids"], snapshot["elapsed"]

    def images(self, ids: np.ndarray) -> np.ndarray:
        images = np.zeros((len(ids), *self.observation_shape), dtype=np.uint8)
        for row, cell in enumerate(ids):
            images[row, :, 8 * cell : 8 * cell + 8] = 255
        return images

    def labels(self, ids: np.ndarray) -> np.ndarray:
        return np.stack([ids == 0, ids == LENGTH - 1], axis=1)


@dataclass(frozen=True)
class Start:
    """Where an episode may begin."""

    cell: int


class LongCorridor(Corridor):
    """The corridor with what Montezuma's engine has: a new id at each step, the newest ``memory`` remembered.

    Episodes begin at a named cell. Actions 2 and 3 go left and right, 0 and 1 do nothing. The right end kills.
    Positions are (0, cell, 0).
    """

    n_actions = 4
    position_names = ("room", "x", "y")
    restarts = True
    observation_shape = (20, 42, 4)  # not made of cells
    cells: ClassVar[dict[str, int]] = {"middle": 2, "left": 0}

    def __init__(self, count: int, max_steps: int = 30, *, start: str = "middle", memory: int = 200_000, seed: int = 0):
        self.memory = memory
        self.starts = [Start(self.cells[start])]
        self.cell = [start.cell for start in self.starts]
        self.n_states = len(self.starts)
        self.count, self.max_steps = count, max_steps
        self.reset()

    @property
    def oldest(self) -> int:
        lost = self.n_states - len(self.starts) - self.memory
        return len(self.starts) + (lost + 3 * self.count if lost > 0 else 0)  # with their oldest frame

    def reset(self) -> np.ndarray:
        self.ids = np.zeros(self.count, dtype=np.int64)
        self.elapsed = np.zeros(self.count, dtype=np.int64)
        self.restart(np.ones(self.count, dtype=bool))
        return self.ids.copy()

    def restart(self, where: np.ndarray) -> None:
        self.ids = np.where(where, 0, self.ids)
        self.elapsed = np.where(where, 0, self.elapsed)

    def step(self, actions: np.ndarray) -> Step:
        here = np.array([self.cell[identity] for identity in self.ids])
        following = np.clip(here + np.array([0, 0, -1, 1])[actions], 0, LENGTH - 1)
        ids = self.n_states + np.arange(self.count)
        self.cell.extend(following.tolist())
        self.n_states += self.count
        terminated = following == LENGTH - 1
        self.elapsed = self.elapsed + 1
        truncated = (self.elapsed >= self.max_steps) & ~terminated
        self.ids = ids.copy()
        self.restart(terminated | truncated)
        return Step(ids, np.zeros(self.count, np.float32), terminated, truncated)

    def snapshot(self) -> dict[str, Any]:
        return {**super().snapshot(), "cell": list(self.cell)}

    def restore(self, snapshot: dict[str, Any]) -> None:
        super().restore(snapshot)
        self.cell = snapshot["cell"]
        self.n_states = len(self.cell)

    def images(self, ids: np.ndarray) -> np.ndarray:
        if ((ids >= len(self.starts)) & (ids < self.oldest)).any():
            raise ValueError("a forgotten state")
        images = np.zeros((len(ids), *self.observation_shape), dtype=np.uint8)
        for row, identity in enumerate(ids):
            images[row, :, 7 * self.cell[identity] : 7 * self.cell[identity] + 7] = 255
        return images

    def positions(self, ids: np.ndarray) -> np.ndarray:
        return np.array([(0, self.cell[identity], 0) for identity in ids], dtype=np.int64).reshape(-1, 3)

    def labels(self, ids: np.ndarray) -> np.ndarray:
        cells = self.positions(ids)[:, 1]
        return np.stack([cells == 0, cells == LENGTH - 1], axis=1)
