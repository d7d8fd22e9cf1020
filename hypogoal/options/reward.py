"""Sub-goal classifiers as rewards and ends of episodes for any agent, without an engine."""

from __future__ import annotations

import copy
import os
import warnings
from pathlib import Path
from typing import Any, SupportsFloat

import gymnasium
import numpy as np
from gymnasium.utils import RecordConstructorArgs

from hypogoal.core.arrays import Bools, Floats
from hypogoal.core.artefacts import open_artefact
from hypogoal.core.errors import UserError
from hypogoal.domains.gymnasium.reader import Reader, reader_of
from hypogoal.hypotheses.ensemble import Ensemble, read_ensemble
from hypogoal.options.termination import load_rule

Env = gymnasium.Env[Any, Any]
STARTS = ("unpaid", "paid", "refuse")
MEANINGS = {
    "unpaid": "nothing is paid until it has been negative (start='unpaid')",
    "paid": "a policy that does nothing is paid (start='paid')",
}


def require_observations(env: Env, ensemble: Ensemble) -> Reader:
    """Return a reader of the environment's observations.

    Raises ``UserError`` if the ensemble was trained on observations of another shape or type.
    """
    reader, dtype, shape = reader_of(env.observation_space), ensemble.view.dtype, ensemble.observation_shape
    if (reader.shape, reader.dtype) != (shape, dtype):
        raise UserError(
            "these members were trained on other observations",
            f"{reader.dtype} {reader.shape}, not {dtype} {shape}",
            "Use the environment they were trained on, with its wrappers.",
        )
    return reader


def ensemble_at(path: Path, sub_goal: str) -> Ensemble:
    """Return the ensemble of ``sub_goal`` in an artefact. An empty name stands for the artefact's only sub-goal."""
    artefact = open_artefact(path, "ensemble")
    goals = artefact.config["sub_goals"]
    if not sub_goal and len(goals) == 1:
        [sub_goal] = goals
    return read_ensemble(artefact.path, artefact.config, sub_goal)


class SubgoalReward:
    """A sub-goal's classifier as a reward: a function of observations, which environments can be wrapped in.

    Args:
        source: an ensemble artefact's folder, or an ensemble from :func:`hypogoal.load_ensemble`.
        sub_goal: which of the artefact's sub-goals. It may be left out if there is only one.
        by: who decides: ``any`` member, more than half of them (``vote``), ``all``, which is the strictest, or one
            member by its number.
        termination: when a member says that the sub-goal holds. With ``learned``, that is where its prediction is
            positive. It may be a rule of your own, as in training, which :meth:`wrap` asks at every step.

    ``reward(observations)`` returns rewards float32 (N,), which are 1 where the sub-goal holds.
    ``reward.holds(observations)`` returns the same as bool (N,). Both take observations as :meth:`Ensemble.predict`
    takes them, and look at each observation alone. So predictions decide there, whatever the rule.

    Raises:
        UserError: if there is no such ensemble, sub-goal, member or rule.
    """

    def __init__(
        self,
        source: str | os.PathLike[str] | Ensemble,
        sub_goal: str = "",
        by: str | int = "vote",
        termination: str = "learned",
    ):
        self.ensemble = source if isinstance(source, Ensemble) else ensemble_at(Path(source), sub_goal)
        count = len(self.ensemble)
        self.by = by
        self.least = {"any": 1, "vote": count // 2 + 1, "all": count}  # how many members must say so
        if by not in self.least and by not in range(count):
            raise UserError(
                "unknown rule for whether the sub-goal holds",
                f"by={by!r}",
                f"Choose one of {', '.join(self.least)}, or a member, 0 to {count - 1}.",
            )
        self.rule = load_rule(termination)(self.ensemble.thresholds_as_log_odds(), count)

    def __call__(self, observations: Any) -> Floats:
        """Return the rewards of observations, float32 (N,)."""
        return self.holds(observations).astype(np.float32)

    def holds(self, observations: Any) -> Bools:
        """Return whether the sub-goal holds in observations, bool (N,)."""
        return self.decide(self.rule.positive(self.ensemble.log_odds(observations)))

    def decide(self, members: Bools) -> Bools:
        """Return whether the sub-goal holds, bool (N,), given what each member says, bool (N, K)."""
        if self.by in self.least:
            return np.asarray(members.sum(1) >= self.least[self.by])
        return members[:, int(self.by)]

    def wrap(
        self,
        env: Env,
        *,
        scale: float = 1.0,
        add: bool = False,
        ends: bool = True,
        start: str = "unpaid",
        away: int = 1,
    ) -> RewardedEnv:
        """Return ``env``, wrapped so that it pays ``scale`` where the sub-goal holds, and 0 elsewhere.

        Args:
            env: an environment with the observations of training.
            scale: the reward where the sub-goal holds.
            add: add the reward to the environment's own reward instead of replacing it.
            ends: terminate the episode where it pays. Otherwise an agent can stay where it is rewarded.
            start: what to do if an episode begins where the prediction is positive, so that doing nothing would be
                paid. With ``unpaid``, nothing is paid until the prediction has been negative. With ``paid``, doing
                nothing is paid. With ``refuse``, ``reset`` raises ``UserError``. Otherwise the first episode that
                begins there gives a warning.
            away: with ``unpaid``, for how many steps in a row the prediction has to be negative before anything is
                paid. Give more than 1 if a prediction flickers: positive, negative, positive, while nothing has
                happened.

        In a forked process, such as those of :class:`gymnasium.vector.AsyncVectorEnv`, torch uses one thread.

        After ``reset`` and every step, ``info["subgoal"]`` is ``{"predicted": bool, "paid": float}``.

        Raises:
            UserError: if the observations are not those of training, ``start`` is unknown, or ``away`` is below 1.
        """
        return RewardedEnv(env, self, scale, add, ends, start, away)


class RewardedEnv(gymnasium.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """What :meth:`SubgoalReward.wrap` returns. To each member, an episode is an execution of its option."""

    def __init__(
        self,
        env: Env,
        reward: SubgoalReward,
        scale: float,
        add: bool,
        ends: bool,
        start: str,
        away: int,
    ):
        kept = {"reward": reward, "scale": scale, "add": add, "ends": ends, "start": start, "away": away}
        RecordConstructorArgs.__init__(self, _disable_deepcopy=True, **kept)
        gymnasium.Wrapper.__init__(self, env)
        if start not in STARTS:
            raise UserError("unknown way with starts inside", f"start={start!r}", f"Choose one of {', '.join(STARTS)}.")
        if away < 1:
            raise UserError("a prediction is negative for at least one step", f"away={away}", "Give 1 or more.")
        self._reader = require_observations(env, reward.ensemble)
        self.reward, self.scale, self.add, self.ends = reward, scale, add, ends
        self.start, self.away = start, away
        self._rule = copy.deepcopy(reward.rule)
        self._age = 0
        self._negatives = 0  # the number of steps in a row until now with a negative prediction
        self._pays = True  # whether a positive prediction is paid by now
        self._warned = False

    def reset(self, **kwargs: Any) -> tuple[Any, dict[str, Any]]:
        """Reset the environment. Nothing is paid."""
        observation, info = self.env.reset(**kwargs)
        self._age = self._negatives = 0
        self._rule.begin_episodes(np.arange(len(self.reward.ensemble)))
        [inside] = self.reward.holds(self._reader.read(observation)[None]).tolist()
        if inside:
            self._meet_start_inside()
        self._pays = not inside or self.start == "paid"
        return observation, info | {"subgoal": {"predicted": inside, "paid": 0.0}}

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        """Step the environment, and return the step with the sub-goal's reward and end."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        [log_odds] = self.reward.ensemble.log_odds(self._reader.read(observation)[None])
        members = np.arange(len(log_odds))
        reached = self._rule.reached(log_odds, members, np.full_like(members, self._age))
        self._age += 1
        [predicted] = self.reward.decide(reached[None]).tolist()
        if not self._pays:
            [positive] = self.reward.decide(self._rule.positive(log_odds)[None]).tolist()
            self._negatives = 0 if positive else self._negatives + 1
            self._pays = self._negatives >= self.away
        holds = predicted and self._pays
        of_sub_goal = self.scale if holds else 0.0
        paid = of_sub_goal + float(reward) if self.add else of_sub_goal
        terminated = bool(terminated) or (holds and self.ends)
        shown = {"predicted": predicted, "paid": of_sub_goal}
        return observation, paid, terminated, truncated, info | {"subgoal": shown}

    def _meet_start_inside(self) -> None:
        fault = "an episode begins where the sub-goal's prediction is positive"
        if self.start == "refuse":
            raise UserError(fault, "start='refuse'", 'Give start="unpaid", or label such states as failures.')
        if not self._warned:
            warnings.warn(f"{fault}: {MEANINGS[self.start]}", stacklevel=3)
            self._warned = True
