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
    """A reader of an environment's observations; a ``UserError`` if the ensemble was trained on others."""
    reader, dtype, shape = reader_of(env.observation_space), ensemble.view.dtype, ensemble.observation_shape
    if (reader.shape, reader.dtype) != (shape, dtype):
        raise UserError(
            "these members were trained on other observations",
            f"{reader.dtype} {reader.shape}, not {dtype} {shape}",
            "Use the environment they were trained on, with its wrappers.",
        )
    return reader


def ensemble_at(path: Path, sub_goal: str) -> Ensemble:
    """One sub-goal's ensemble in an artefact; without a name its only one."""
    artefact = open_artefact(path, "ensemble")
    goals = artefact.config["sub_goals"]
    if not sub_goal and len(goals) == 1:
        [sub_goal] = goals
    return read_ensemble(artefact.path, artefact.config, sub_goal)


class SubgoalReward:
    """A sub-goal's classifier as a reward: a function of observations, which environments can be wrapped in.

    Args:
        source: an ensemble artefact's folder, or an ensemble from :func:`hypogoal.load_ensemble`.
        sub_goal: which of the artefact's; may be left out where there is one.
        by: who decides: ``any`` member, more than half of them (``vote``), ``all``, which is the strictest, or one
            member by its number.
        termination: when a member says so: ``learned``, where its prediction is positive; or a rule of one's own, as in
            training, which :meth:`wrap` asks at every step.

    ``reward(observations)`` are rewards float32 (N,), 1 where the sub-goal holds, of observations as
    :meth:`Ensemble.predict` takes them; ``reward.holds(observations)`` the same as bool (N,). Each observation stands
    alone there, so that predictions decide, whatever the rule.

    Raises:
        UserError: no such ensemble, sub-goal, member or rule.
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
        self.least = {"any": 1, "vote": count // 2 + 1, "all": count}  # members that have to say so
        if by not in self.least and by not in range(count):
            raise UserError(
                "unknown rule for whether the sub-goal holds",
                f"by={by!r}",
                f"Choose one of {', '.join(self.least)}, or a member, 0 to {count - 1}.",
            )
        self.rule = load_rule(termination)(self.ensemble.thresholds_as_log_odds(), count)

    def __call__(self, observations: Any) -> Floats:
        """The rewards (N,) of observations."""
        return self.holds(observations).astype(np.float32)

    def holds(self, observations: Any) -> Bools:
        """Whether the sub-goal holds in observations: bool (N,)."""
        return self.decide(self.rule.positive(self.ensemble.log_odds(observations)))

    def decide(self, members: Bools) -> Bools:
        """Whether the sub-goal holds where members say so: bool (N, K) to (N,)."""
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
        """An environment that pays ``scale`` where the sub-goal holds, else 0.

        Args:
            env: one whose observations are those of training.
            scale: what it pays.
            add: that is added to its own reward instead of replacing it.
            ends: its episode terminates where it pays; else an agent can stay where it is rewarded.
            start: of an episode that begins where the prediction is positive, so that doing nothing would be paid:
                ``unpaid`` until the prediction has been negative, ``paid``, or ``refuse``, a ``UserError`` by
                ``reset``. The first such start is a warning.
            away: how many steps in a row the prediction has to be negative before what is ``unpaid`` pays. More than 1
                is for a prediction that flickers: positive, negative, positive, while nothing has happened.

        In a forked process, as :class:`gymnasium.vector.AsyncVectorEnv` has them, torch uses one thread.

        ``info["subgoal"]`` is ``{"predicted": bool, "paid": float}``, of ``reset`` and of every step.

        Raises:
            UserError: other observations than those of training; an unknown ``start``; ``away`` below 1.
        """
        return RewardedEnv(env, self, scale, add, ends, start, away)


class RewardedEnv(gymnasium.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """See :meth:`SubgoalReward.wrap`: an episode is to each member an execution of its option."""

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
        self._negatives = 0  # steps in a row
        self._pays = True  # the prediction has been negative since the episode began
        self._warned = False

    def reset(self, **kwargs: Any) -> tuple[Any, dict[str, Any]]:
        """Like the environment's own; nothing is paid."""
        observation, info = self.env.reset(**kwargs)
        self._age = self._negatives = 0
        [inside] = self.reward.holds(self._reader.read(observation)[None]).tolist()
        if inside:
            self._meet_start_inside()
        self._pays = not inside or self.start == "paid"
        return observation, info | {"subgoal": {"predicted": inside, "paid": 0.0}}

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        """The environment's step with reward and end changed."""
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
