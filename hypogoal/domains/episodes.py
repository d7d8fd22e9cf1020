"""The episodes played so far: how long each was, what it earned, how it ended (Spec E7, F5)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from statistics import fmean
from typing import TYPE_CHECKING, Any

import numpy as np

from hypogoal.core.checkpoints import Resumable, State

if TYPE_CHECKING:
    from hypogoal.domains.base import Step

LAST = 100  # an agent is judged by its last so many episodes, an option by its last so many executions (Spec F3)


class EpisodeRecorder(list[tuple[Any, ...]], Resumable):
    """Every finished episode of E environments, in the order in which they ended.

    A row is step, length, reward, terminated, succeeded: the columns of :class:`hypogoal.options.tables.Episodes`.

    ``steps`` are environment steps so far, summed over the environments.
    """

    CHANGING = ("steps", "lengths", "rewards")  # and the rows

    def __init__(self, environments: int):
        super().__init__()
        self.steps = 0
        self.lengths = np.zeros(environments, int)  # so far, of the episodes that run
        self.rewards = np.zeros(environments)

    def see(self, step: Step) -> None:
        """One step of every environment."""
        self.steps += len(step.rewards)
        self.lengths += 1
        self.rewards += step.rewards
        over = step.terminated | step.truncated
        succeeded = step.succeeded
        if succeeded is None:
            succeeded = step.terminated & (self.rewards > 0)
        columns = [
            self.lengths,
            self.rewards,
            step.terminated * 1,
            succeeded * 1,
        ]
        ended = [column[over].tolist() for column in columns]
        for facts in zip(*ended, strict=True):
            self.append((self.steps, *facts))
        self.lengths[over] = 0
        self.rewards[over] = 0.0

    def counts(self) -> dict[str, int]:
        """Environment steps and episodes so far."""
        return {"steps": self.steps, "episodes": len(self)}

    def recent(self) -> dict[str, float]:
        """Of the last episodes the share that succeeded, see ``Step``, and the mean steps; NaN before the first."""
        last = self[-LAST:]
        if not last:
            return {"success": math.nan, "length": math.nan}
        return {
            "success": fmean(row[4] for row in last),
            "length": fmean(row[1] for row in last),
        }

    def solved(self, share: float) -> bool:
        """Whether at least ``share`` of the last ``LAST`` episodes succeeded; never where there are fewer, or at 0."""
        return share > 0 and len(self) >= LAST and self.recent()["success"] >= share

    def snapshot(self) -> State:
        return super().snapshot() | {"rows": list(self)}

    def restore(self, snapshot: Mapping[str, Any]) -> None:
        super().restore(snapshot)
        self[:] = map(tuple, snapshot["rows"])
