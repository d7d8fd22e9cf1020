"""The episodes played so far: how long each was, what it earned, how it ended (Spec E7, F5)."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from hypogoal.core.checkpoints import Resumable, State, growing
from hypogoal.core.files import write_table
from hypogoal.domains.base import Step

EPISODE_COLUMNS = ("step", "length", "reward", "terminated", "succeeded")
LAST = 100  # episodes, of which success and length are told


class Episodes(list[tuple[int, int, float, int, int]], Resumable):
    """A row of ``EPISODE_COLUMNS`` for every finished episode of E environments, in the order in which they ended.

    ``steps`` are environment steps so far, summed over the environments.
    """

    CHANGING = ("steps", "_length", "_reward")

    def __init__(self, environments: int):
        super().__init__()
        self.steps = 0
        self._length, self._reward = np.zeros(environments, dtype=np.int64), np.zeros(environments)

    def see(self, step: Step) -> None:
        """One step of every environment."""
        self.steps += len(step.rewards)
        self._length += 1
        self._reward += step.rewards
        over = step.terminated | step.truncated
        for place in np.flatnonzero(over):
            length, reward, done = int(self._length[place]), float(self._reward[place]), bool(step.terminated[place])
            success = done and reward > 0 if step.succeeded is None else step.succeeded[place]
            self.append((self.steps, length, reward, int(done), int(success)))
        self._length[over], self._reward[over] = 0, 0.0

    def success(self) -> float:
        """Share of the last episodes that succeeded, see ``Step``; NaN before the first."""
        last = self[-LAST:]
        return sum(row[4] for row in last) / len(last) if last else float("nan")

    def solved(self, share: float) -> bool:
        """Whether at least ``share`` of the last ``LAST`` episodes succeeded; never where there are fewer, or at 0."""
        return share > 0 and len(self) >= LAST and self.success() >= share

    def length(self) -> float:
        """Mean steps of the last episodes; NaN before the first."""
        last = self[-LAST:]
        return sum(row[1] for row in last) / len(last) if last else float("nan")

    def write(self, folder: Path) -> None:
        """``episodes.csv`` into ``folder``."""
        write_table(folder / "episodes.csv", EPISODE_COLUMNS, self)

    def snapshot(self) -> State:
        return {**super().snapshot(), "rows": growing(np.array(self, np.float64).reshape(-1, len(EPISODE_COLUMNS)))}

    def restore(self, snapshot: Mapping[str, Any]) -> None:
        super().restore(snapshot)
        rows = snapshot["rows"].tolist()
        self[:] = [(int(row[0]), int(row[1]), row[2], int(row[3]), int(row[4])) for row in rows]
