"""A walk through an environment, which finds what follows on each action in each state of a layout."""

from __future__ import annotations

from typing import TYPE_CHECKING

import gymnasium
import numpy as np

from hypogoal.core.errors import UserError
from hypogoal.domains.base import Plan

if TYPE_CHECKING:
    from hypogoal.domains.gymnasium.engine import GymnasiumEngine

MOST = 50_000  # the most states that are walked through
UNTRIED = -1


class Walk:
    """A walk that tries every action in every state that episodes reach.

    The walk goes the shortest way to an action that was not tried yet. Where no way leads to such an action, the walk
    begins an episode anew. So the environment need not be copied, and steps that are walked twice show whether the
    environment is deterministic.

    Attributes:
        engine: gives states their ids.
        env: the environment that is walked through.
        following: by state, the states after each action, or ``UNTRIED`` if no episode lasts long enough.
        final: the states in which the task is over.
        solved: the final states in which ``success`` says so, or by default, which were reached with a reward above 0.
    """

    def __init__(self, engine: GymnasiumEngine, env: gymnasium.Env):
        self.engine, self.env = engine, env
        self.following: dict[int, list[int]] = {}
        self.final: set[int] = set()
        self.solved: set[int] = set()

    def through(self, seed: int) -> None:
        """Walk through a layout. Raises ``UserError`` if it has too many states, or is not deterministic."""
        state = self._begin(seed)
        is_start = True
        while True:
            way = self.way(state)
            if is_start and not way:
                return
            left = len(way)
            is_over = not way
            for action in way:
                state, is_over = self._play(state, action, seed)
                left -= 1
                if is_over:
                    break
            if is_start and left:  # the episode was cut on the shortest way, so all actions that are left are too far
                return
            is_start = is_over
            if is_over:
                state = self._begin(seed)

    def way(self, state: int) -> list[int]:
        """Return the fewest actions from a state of which the last was never tried, or no actions if all were tried."""
        ways: dict[int, list[int]] = {state: []}
        queue = [state]
        for passed in queue:
            for action, after in enumerate(self.following[passed]):
                way = [*ways[passed], action]
                if after == UNTRIED:
                    return way
                if after not in ways:
                    ways[after] = way
                    queue.append(after)
        return []

    def require(self, state: int, action: int, after: int, seed: int) -> None:
        """Raise ``UserError`` if the same step led elsewhere before."""
        if self.following[state][action] not in (UNTRIED, after):
            raise UserError(
                "the same action led from the same state to another one, so this cannot be planned",
                f"layout_seed={seed}, action={action}",
                "Give plan=f, a function of the environment that returns what its observations hide, or no plan.",
            )

    def plan(self) -> Plan:
        """Return what follows in all states that were found. An action that was not tried leads to the state itself."""
        ids = np.array(sorted(self.following))
        following = np.array([self.following[state] for state in ids.tolist()])
        return Plan(
            ids,
            np.arange(self.engine.n_actions),
            np.where(following == UNTRIED, ids[:, None], following),
            np.isin(ids, [*self.final]),
            np.isin(ids, [*self.solved]),
        )

    def _begin(self, seed: int) -> int:
        observation, _info = self.env.reset(seed=seed)
        self.earned = 0.0
        state = self.engine.remember(self.env, observation, seed)
        self._enter(state, seed)
        return state

    def _play(self, state: int, action: int, seed: int) -> tuple[int, bool]:
        """Take a step. Return the state reached, and whether the episode is over.

        Raises ``UserError`` if the episode is a success, but not by the reward of this step.
        """
        observation, reward, terminated, cut, info = self.env.step(action)
        last = float(reward)
        self.earned += last
        after = self.engine.remember(self.env, observation, seed, bool(terminated))
        self._enter(after, seed)
        self.require(state, action, after, seed)
        self.following[state][action] = after
        if terminated:
            self.final.add(after)
            self.following[after] = [after] * self.engine.n_actions
            success = self.engine.domain.success
            if success is None and self.earned > 0 >= last:
                raise UserError(
                    "an episode succeeds by rewards before its last, so the states that solve the task are not known",
                    f"layout_seed={seed}, action={action}",
                    "Give success=f, a function that says at an episode's end whether it was a success.",
                )
            if success(self.env, info, self.earned, True) if success else last > 0:
                self.solved.add(after)
        return after, bool(terminated or cut)

    def _enter(self, state: int, seed: int) -> None:
        """Enter a state among the known states. Raises ``UserError`` if there are too many."""
        most = min(MOST, self.engine.memory)
        if len(self.following) == most and state not in self.following:
            raise UserError(
                f"there are more than {most} states, too many to plan in",
                f"layout_seed={seed}",
                "Give --set network=light, or fewer layouts; what plan=f returns must not count steps.",
            )
        self.following.setdefault(state, [UNTRIED] * self.engine.n_actions)
