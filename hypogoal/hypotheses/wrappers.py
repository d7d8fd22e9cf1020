"""Sub-goal classifiers as rewards and ends of episodes for any agent, without an engine (Spec D1, I6)."""

from __future__ import annotations

import operator
import os
from pathlib import Path
from typing import (
    Any,
    SupportsFloat,
    SupportsIndex,
    TypeAlias,
)

import gymnasium
import numpy as np
from gymnasium.utils import RecordConstructorArgs

from hypogoal.core.arrays import Bools, Floats
from hypogoal.core.artefacts import open_artefact
from hypogoal.core.errors import UserError
from hypogoal.domains.gymnasium.reader import Reader, reader_of
from hypogoal.hypotheses.ensemble import Ensemble, read_ensemble

Env: TypeAlias = gymnasium.Env[Any, Any]
By: TypeAlias = str | SupportsIndex
RULES = ("any", "vote", "all", "mean")


def require_observations(env: Env, ensemble: Ensemble) -> Reader:
    """A reader of an environment's observations; a ``UserError`` if the ensemble was trained on others."""
    reader, dtype, shape = reader_of(env), ensemble.view.dtype, ensemble.observation_shape
    if (reader.shape, reader.dtype) != (shape, dtype):
        mismatch = f"{reader.dtype} {reader.shape}, not {dtype} {shape}"
        do = "Use the environment they were trained on, with its wrappers."
        raise UserError(
            "these members were trained on other observations",
            mismatch,
            do,
        )
    return reader


def ensemble_at(path: Path, sub_goal: str) -> Ensemble:
    """One sub-goal's ensemble in an artefact; without a name its only one."""
    artefact = open_artefact(path, "ensemble")
    goals = artefact.config["sub_goals"]
    return read_ensemble(
        artefact.path,
        artefact.config,
        sub_goal or (goals[0] if len(goals) == 1 else ""),
    )


class SubgoalReward:
    """A sub-goal's classifier as a reward (Spec D1): a function of observations, which environments can be wrapped in.

    Args:
        source: an ensemble artefact's folder, or an ensemble from :func:`hypogoal.load_ensemble`.
        sub_goal: which of the artefact's; may be left out where there is one.
        by: who decides: ``any`` member, more than half of them (``vote``), ``all``, which is the strictest, their
            ``mean`` probability above 0.5, or one member by its number.

    ``reward(observations)`` are rewards float32 (N,), 1 where the sub-goal holds, of observations as
    :meth:`Ensemble.predict` takes them; ``reward.holds(observations)`` the same as bool (N,).

    Raises:
        UserError: no such ensemble, sub-goal, member or rule.
    """

    def __init__(
        self,
        source: str | os.PathLike[str] | Ensemble,
        sub_goal: str = "",
        by: By = "vote",
    ):
        self.ensemble = source if isinstance(source, Ensemble) else ensemble_at(Path(source), sub_goal)
        self.by = by if isinstance(by, str) else _member(by)
        if self.by not in RULES and self.by not in range(len(self.ensemble)):
            do = f"Choose one of {', '.join(RULES)}, or a member, 0 to {len(self.ensemble) - 1}."
            raise UserError(
                "unknown rule for whether the sub-goal holds",
                f"by={by!r}",
                do,
            )

    def __call__(self, observations: Any) -> Floats:
        """The rewards (N,) of observations."""
        return self.holds(observations).astype(np.float32)

    def holds(self, observations: Any) -> Bools:
        """Whether the sub-goal holds in observations: bool (N,)."""
        if self.by == "mean":
            return np.asarray(self.ensemble.predict(observations).mean(1) > 0.5)
        predictions = self.ensemble.predictions(observations)
        if not isinstance(self.by, str):
            return np.asarray(predictions[:, self.by])
        members = len(self.ensemble)
        least = {"any": 1, "vote": members // 2 + 1, "all": members}[self.by]
        return np.asarray(predictions.sum(1) >= least)

    def wrap(
        self,
        env: Env,
        *,
        scale: float = 1.0,
        add: bool = False,
        ends: bool = True,
    ) -> RewardedEnv:
        """An environment that pays ``scale`` where the sub-goal holds, else 0.

        ``add``: that is added to its own reward instead of replacing it. ``ends``: its episode terminates there; else
        an agent can stay where it is rewarded. ``info["subgoal"]`` is whether the sub-goal holds. An environment with
        other observations than those of training is a ``UserError``.
        """
        return RewardedEnv(env, self, scale=scale, add=add, ends=ends)


def _member(by: Any) -> int | None:
    """The number of a member, from Python or any array library; None for anything else."""
    try:
        return None if isinstance(by, bool) else operator.index(by)
    except TypeError:
        return None


class RewardedEnv(gymnasium.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """See :meth:`SubgoalReward.wrap`."""

    def __init__(
        self,
        env: Env,
        reward: SubgoalReward,
        *,
        scale: float = 1.0,
        add: bool = False,
        ends: bool = True,
    ):
        kept = {"reward": reward, "scale": scale, "add": add, "ends": ends}
        RecordConstructorArgs.__init__(self, _disable_deepcopy=True, **kept)
        gymnasium.Wrapper.__init__(self, env)
        self._reader = require_observations(env, reward.ensemble)
        self.reward, self.scale, self.add, self.ends = reward, scale, add, ends

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        """The environment's step with reward and end changed."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        seen = self._reader.read(observation)[None]
        holds = bool(self.reward.holds(seen)[0])
        terminated = bool(terminated) or (holds and self.ends)
        paid = self.scale if holds else 0.0
        if self.add:
            paid += float(reward)
        return observation, paid, terminated, truncated, info | {"subgoal": holds}
