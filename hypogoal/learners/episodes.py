"""The episodes played so far: how long each was, what it earned, how it ended (Spec E7, F5)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from hypogoal.core.checkpoints import Resumable, State

if TYPE_CHECKING:
    from hypogoal.domains.base import Step

LAST = 100  # an agent is judged by its last so many episodes, an option by its last so many executions (Spec F3)


class EpisodeRecorder(list[tuple[int, int, float, int, int]], Resumable):
    """Every finished episode of E environments, in the order in which they ended.

    A row is step, length, reward, terminated, succeeded: the columns of :class:`hypogoal.options.tables.Episodes`.

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
        for e in np.flatnonzero(over):
            length, reward, terminated = int(self._length[e]), float(self._reward[e]), bool(step.terminated[e])
            succeeded = terminated and reward > 0 if step.succeeded is None else step.succeeded[e]
            self.append((self.steps, length, reward, int(terminated), int(succeeded)))
        self._length[over], self._reward[over] = 0, 0.0

    def counts(self) -> dict[str, int]:
        """Environment steps and episodes so far."""
        return {"steps": self.steps, "episodes": len(self)}

    def recent(self) -> dict[str, float]:
        """Success and length over the last episodes."""
        return {"success": self.success(), "length": self.length()}

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

    def snapshot(self) -> State:
        return {**super().snapshot(), "rows": np.array(self, np.float64).reshape(-1, 5)}

    def restore(self, snapshot: Mapping[str, Any]) -> None:
        super().restore(snapshot)
        rows = snapshot["rows"].tolist()
        self[:] = [(int(row[0]), int(row[1]), row[2], int(row[3]), int(row[4])) for row in rows]
