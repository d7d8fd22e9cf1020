"""Sub-goal classifiers as rewards and ends of episodes for any agent, without an engine (Spec D1, I6)."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any, SupportsFloat, SupportsIndex, TypeAlias

import gymnasium
import numpy as np
from gymnasium.utils import RecordConstructorArgs
from numpy.typing import NDArray

from hypogoal.core.artefacts import open_artefact
from hypogoal.core.errors import UserError
from hypogoal.core.own_code import as_number
from hypogoal.domains.gymnasium_engine import Reader, reader_of, stepped
from hypogoal.hypotheses.ensemble import Ensemble, read_ensemble
from hypogoal.hypotheses.thresholds import ENOUGH, fallen

Env: TypeAlias = gymnasium.Env[Any, Any]
By: TypeAlias = str | SupportsIndex
RULES = ("any", "vote", "all", "mean")


def require_observations(env: Env, ensemble: Ensemble) -> Reader:
    """A reader of an environment's observations; a ``UserError`` if the ensemble was trained on others."""
    reader, dtype, shape = reader_of(env), ensemble.view.dtype, ensemble.observation_shape
    if (reader.shape, reader.dtype) != (shape, dtype):
        mismatch = f"{reader.dtype} {reader.shape}, not {dtype} {shape}"
        do = "Use the environment they were trained on, with its wrappers."
        raise UserError("these members were trained on other observations", mismatch, do)
    return reader


def ensemble_at(path: Path, sub_goal: str) -> Ensemble:
    """One sub-goal's ensemble in an artefact; without a name its only one."""
    artefact = open_artefact(path, "ensemble").whole()
    goals = artefact.config["sub_goals"]
    return read_ensemble(artefact.path, artefact.config, sub_goal or (goals[0] if len(goals) == 1 else ""))


class SubgoalReward:
    """A sub-goal's classifier as a reward (Spec D1): a function of observations, which environments can be wrapped in.

    Args:
        source: an ensemble artefact's folder, or an ensemble from :func:`hypogoal.load_ensemble`.
        sub_goal: which of the artefact's; may be left out where there is one.
        by: who decides: ``any`` member, more than half of them (``vote``), ``all``, which is the strictest, their
            ``mean`` probability above 0.5, or one member by its number.
        patience: of wrapped environments. Thresholds of .5 and more fall after so many steps in which less than 5 % of
            episodes were rewarded, as in ``termination=patience``; 0: they stay.

    ``reward(observations)`` are rewards float32 (N,), 1 where the sub-goal holds, of observations as
    :meth:`Ensemble.predict` takes them; ``reward.holds(observations)`` the same as bool (N,).

    Raises:
        UserError: no such ensemble, sub-goal, member or rule, or members that need the agent's positions.
    """

    def __init__(
        self, source: str | os.PathLike[str] | Ensemble, sub_goal: str = "", by: By = "vote", *, patience: int = 0
    ):
        if isinstance(source, gymnasium.Env):  # so it was called until version 0.18
            do = "Give SubgoalReward(ensemble).wrap(env)."
            raise UserError("SubgoalReward takes an ensemble, not an environment", None, do)
        ensemble = source if isinstance(source, Ensemble) else ensemble_at(Path(source), sub_goal)
        rule = by if isinstance(by, str) else as_number(by)
        if ensemble.needs_positions:
            do = "Train it with localiser=learned."
            raise UserError("the ensemble needs the agent's positions (localiser=ram)", None, do)
        if rule not in RULES and rule not in range(len(ensemble)):
            do = f"Choose one of {', '.join(RULES)}, or a member, 0 to {len(ensemble) - 1}."
            raise UserError("unknown rule for whether the sub-goal holds", f"by={by!r}", do)
        if patience and rule == "mean":
            raise UserError(
                "the mean has no threshold that can fall", "by=mean", "Choose another rule, or no patience."
            )
        self.ensemble, self.by, self.patience = ensemble, rule, patience

    def __call__(self, observations: Any) -> NDArray[np.float32]:
        """The rewards (N,) of observations."""
        return self.holds(observations).astype(np.float32)

    def holds(self, observations: Any) -> NDArray[np.bool_]:
        """Whether the sub-goal holds in observations: bool (N,)."""
        if self.by == "mean":
            return np.asarray(self.ensemble.predict(observations).mean(1) > 0.5)
        return self.decide(self.ensemble.predictions(observations))

    def decide(self, predictions: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """What members' predictions (N, K) make together: bool (N,)."""
        if not isinstance(self.by, str):
            return np.asarray(predictions[:, self.by])
        members = predictions.shape[1]
        return np.asarray(predictions.sum(1) >= {"any": 1, "vote": members // 2 + 1, "all": members}[self.by])

    def wrap(self, env: Env, *, scale: float = 1.0, add: bool = False, ends: bool = True) -> RewardedEnv:
        """An environment that pays ``scale`` where the sub-goal holds, else 0.

        ``add``: that is added to its own reward instead of replacing it. ``ends``: its episode terminates there; else
        an agent can stay where it is rewarded. ``info["subgoal"]`` is whether the sub-goal holds. An environment with
        other observations than those of training is a ``UserError``.
        """
        return RewardedEnv(env, self, scale=scale, add=add, ends=ends)


class RewardedEnv(gymnasium.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """See :meth:`SubgoalReward.wrap`."""

    def __init__(self, env: Env, reward: SubgoalReward, *, scale: float = 1.0, add: bool = False, ends: bool = True):
        kept = {"reward": reward, "scale": scale, "add": add, "ends": ends}
        RecordConstructorArgs.__init__(self, _disable_deepcopy=True, **kept)
        gymnasium.Wrapper.__init__(self, env)
        self._reader = require_observations(env, reward.ensemble)
        self.reward, self.scale, self.add, self.ends = reward, scale, add, ends
        self.thresholds = self._first = reward.ensemble.thresholds_as_log_odds()  # log-odds (K,)
        self._highest = np.full(len(self._first), -np.inf, np.float32)
        self._steps = self._episodes = self._rewarded = 0
        self._paid = False

    def _holds(self, observation: Any) -> bool:
        seen = self._reader.read(self.env, observation)[None]
        if not self.reward.patience:
            return bool(self.reward.holds(seen)[0])
        log_odds = self.reward.ensemble.log_odds(seen)
        self._highest, self._steps = np.maximum(self._highest, log_odds[0]), self._steps + 1
        return bool(self.reward.decide(log_odds > self.thresholds)[0])

    def _count(self) -> None:
        """Count an episode that ended; then lower the thresholds if that is due."""
        self._episodes, self._rewarded, self._paid = self._episodes + 1, self._rewarded + self._paid, False
        if self._steps >= self.reward.patience:
            if self._rewarded < ENOUGH * self._episodes:
                self.thresholds = fallen(self.thresholds, self._first, self._highest)
            self._highest = np.full_like(self._highest, -np.inf)
            self._steps = self._episodes = self._rewarded = 0

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        """The environment's step with reward and end changed."""
        observation, reward, terminated, truncated, info = stepped(self.env, action)
        holds = self._holds(observation)
        self._paid |= holds
        terminated |= holds and self.ends
        if self.reward.patience and (terminated or truncated):
            self._count()
        bonus = self.scale if holds else 0.0
        return observation, reward + bonus if self.add else bonus, terminated, truncated, info | {"subgoal": holds}
