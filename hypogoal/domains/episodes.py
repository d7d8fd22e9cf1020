"""The episodes played so far: how long each was, what it earned, how it ended."""

from __future__ import annotations

import math
from collections.abc import Mapping
from statistics import fmean
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from hypogoal.core.checkpoints import Resumable

if TYPE_CHECKING:
    from hypogoal.domains.base import Step

LAST = 100  # an agent is judged by its last so many episodes, an option by its last so many executions


class PlayedEpisode(NamedTuple):
    """A finished episode: a row of :class:`hypogoal.options.tables.Episodes`."""

    step: int  # environment steps when it ended, summed over the environments
    length: int  # its steps
    reward: float  # undiscounted
    terminated: int  # 1: it ended in a terminal state; 0: it was cut
    succeeded: int


class EpisodeRecorder(Resumable):
    """Every finished episode of E environments, ``rows``, in the order in which they ended.

    ``steps`` are environment steps so far, summed over the environments.
    """

    CHANGING = ("steps", "lengths", "rewards", "rows")

    def __init__(self, environments: int):
        self.steps = 0
        self.lengths = np.zeros(environments, int)  # so far, of the episodes that run
        self.rewards = np.zeros(environments)
        self.rows: list[PlayedEpisode] = []

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
            self.rows.append(PlayedEpisode(self.steps, *facts))
        self.lengths[over] = 0
        self.rewards[over] = 0.0

    def counts(self) -> dict[str, int]:
        """Environment steps and episodes so far."""
        return {"steps": self.steps, "episodes": len(self.rows)}

    def recent(self) -> dict[str, float]:
        """Of the last episodes the share that succeeded, see ``Step``, and the mean steps; NaN before the first."""
        last = self.rows[-LAST:]
        if not last:
            return {"success": math.nan, "length": math.nan}
        return {
            "success": fmean(episode.succeeded for episode in last),
            "length": fmean(episode.length for episode in last),
        }

    def solved(self, share: float) -> bool:
        """Whether at least ``share`` of the last ``LAST`` episodes succeeded; never where there are fewer, or at 0."""
        return share > 0 and len(self.rows) >= LAST and self.recent()["success"] >= share

    def restore(self, snapshot: Mapping[str, Any]) -> None:
        super().restore(snapshot)
        self.rows = [PlayedEpisode(*row) for row in snapshot["rows"]]
