"""Sub-goal classifiers as Gymnasium wrappers: as a reward or as the end of an episode, for any agent."""

from __future__ import annotations

from typing import Any, SupportsFloat, SupportsIndex, TypeAlias

import gymnasium
from gymnasium.utils import RecordConstructorArgs

from hypogoal.core.errors import UserError
from hypogoal.core.own_code import as_number
from hypogoal.domains.gymnasium_engine import Reader, reader_of, stepped
from hypogoal.hypotheses.ensemble import Ensemble

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


class _Subgoal(gymnasium.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """What both wrappers share: the rule for whether the sub-goal holds in an observation."""

    def __init__(self, env: Env, ensemble: Ensemble, by: By, **arguments: Any):
        rule = by if isinstance(by, str) else as_number(by)
        RecordConstructorArgs.__init__(self, _disable_deepcopy=True, ensemble=ensemble, by=rule, **arguments)
        gymnasium.Wrapper.__init__(self, env)
        self._reader = require_observations(env, ensemble)
        if ensemble.needs_positions:
            do = "Train it with localiser=learned."
            raise UserError("the ensemble needs the agent's positions (localiser=ram)", None, do)
        if rule not in RULES and rule not in range(len(ensemble)):
            do = f"Choose one of {', '.join(RULES)}, or a member, 0 to {len(ensemble) - 1}."
            raise UserError("unknown rule for whether the sub-goal holds", f"by={by!r}", do)
        self.ensemble, self.by = ensemble, rule

    def holds(self, observation: Any) -> bool:
        """Whether the sub-goal holds in an observation of the environment, by the chosen rule."""
        observation = self._reader.read(self.env, observation)
        if self.by == "mean":
            return bool(self.ensemble.predict(observation[None])[0].mean() > 0.5)
        predictions = self.ensemble.predictions(observation[None])[0]
        if isinstance(self.by, str):
            return bool({"any": predictions.any(), "all": predictions.all(), "vote": predictions.mean() > 0.5}[self.by])
        return bool(predictions[self.by])


class SubgoalReward(_Subgoal):
    """Reward where a sub-goal's classifier fires (Spec D1): ``scale`` there, 0 elsewhere.

    An agent can stay where it is rewarded; to prevent that, wrap the result in :class:`SubgoalTermination` too.

    Args:
        env: an environment with the observations that the ensemble was trained on.
        ensemble: from :func:`hypogoal.load_ensemble`.
        by: who decides: ``any`` member, more than half of them (``vote``), ``all``, their ``mean`` probability above
            0.5, or one member by its number.
        scale: the reward.
        add: add to the environment's own reward instead of replacing it.

    ``info["subgoal"]`` is whether the sub-goal holds.
    """

    def __init__(self, env: Env, ensemble: Ensemble, by: By = "vote", *, scale: float = 1.0, add: bool = False):
        super().__init__(env, ensemble, by, scale=scale, add=add)
        self.scale, self.add = scale, add

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        """The environment's step with the reward changed."""
        observation, reward, terminated, truncated, info = stepped(self.env, action)
        holds = self.holds(observation)
        bonus = self.scale if holds else 0.0
        return observation, reward + bonus if self.add else bonus, terminated, truncated, info | {"subgoal": holds}


class SubgoalTermination(_Subgoal):
    """The episode terminates where a sub-goal's classifier fires (Spec D1); arguments as for :class:`SubgoalReward`.

    ``info["subgoal"]`` is whether the sub-goal holds.
    """

    def __init__(self, env: Env, ensemble: Ensemble, by: By = "vote"):
        super().__init__(env, ensemble, by)

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        """The environment's step, ``terminated`` where the sub-goal holds."""
        observation, reward, terminated, truncated, info = stepped(self.env, action)
        holds = self.holds(observation)
        return observation, reward, terminated or holds, truncated, info | {"subgoal": holds}
