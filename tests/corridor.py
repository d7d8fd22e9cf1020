"""A corridor with the engine's interface: small enough to learn in seconds, with states that look alike."""

import numpy as np

from hypogoal.domains.base import Step

LENGTH = 6


class Corridor:
    """Cells 0..5, start at 2; action 0 goes left, 1 right; the task ends at the right end with reward 1.

    Sub-goals: be at the left end, be at the right end. The image shows the agent's cell as white, unless ``blind``,
    where only the first step of an episode shows anything.
    """

    n_actions = 2
    observation_shape = (16, 64, 3)
    sub_goals = ("left-end", "right-end")

    def __init__(self, count: int, max_steps: int = 30):
        self.count, self.max_steps = count, max_steps
        self.n_states = LENGTH
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

    def images(self, ids: np.ndarray, out: np.ndarray | None = None) -> np.ndarray:
        images = np.zeros((len(ids), *self.observation_shape), dtype=np.uint8) if out is None else out
        for row, cell in enumerate(ids):
            images[row] = 0
            images[row, :, 8 * cell : 8 * cell + 8] = 255
        return images

    def labels(self, ids: np.ndarray) -> np.ndarray:
        return np.stack([ids == 0, ids == LENGTH - 1], axis=1)
