"""A record of the episodes played so far, with their length, their reward, and how they ended."""

from __future__ import annotations

import math
from collections.abc import Mapping
from statistics import fmean
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from hypogoal.core.checkpoints import Resumable

if TYPE_CHECKING:
    from hypogoal.domains.base import Step

LAST = 100  # the number of last episodes by which an agent is judged, and of last executions, for an option


class PlayedEpisode(NamedTuple):
    """A finished episode, which is a row of :class:`hypogoal.options.tables.Episodes`."""

    step: int  # environment steps, summed over the environments, when the episode ended
    length: int  # steps of the episode
    reward: float  # the sum of its rewards, not discounted
    terminated: int  # 1 if the episode ended in a terminal state, 0 if it was cut
    succeeded: int  # 1 or 0


class EpisodeRecorder(Resumable):
    """A recorder of the finished episodes of E environments.

    Attributes:
        steps: the number of environment steps so far, summed over the environments.
        rows: the finished episodes, in the order in which they ended.
    """

    CHANGING = ("steps", "lengths", "rewards", "rows")

    def __init__(self, environments: int):
        self.steps = 0
        self.lengths = np.zeros(environments, int)  # the steps so far of the episodes that run
        self.rewards = np.zeros(environments)
        self.rows: list[PlayedEpisode] = []

    def see(self, step: Step) -> None:
        """Record one step of every environment."""
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
        """Return the numbers of environment steps and of episodes so far."""
        return {"steps": self.steps, "episodes": len(self.rows)}

    def recent(self) -> dict[str, float]:
        """Return the share of successes (see ``Step``) and the mean length of the last ``LAST`` episodes.

        The two numbers are NaN before the first episode has ended.
        """
        last = self.rows[-LAST:]
        if not last:
            return {"success": math.nan, "length": math.nan}
        return {
            "success": fmean(episode.succeeded for episode in last),
            "length": fmean(episode.length for episode in last),
        }

    def solved(self, share: float) -> bool:
        """Return whether at least ``share`` of the last ``LAST`` episodes succeeded.

        Return false if ``share`` is 0, or if fewer than ``LAST`` episodes have ended.
        """
        return share > 0 and len(self.rows) >= LAST and self.recent()["success"] >= share

    def restore(self, snapshot: Mapping[str, Any]) -> None:
        super().restore(snapshot)
        self.rows = [PlayedEpisode(*row) for row in snapshot["rows"]]
