"""An engine of copies of any Gymnasium environment, which are stepped in turn. Each distinct state is kept once."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np

from hypogoal.core.arrays import Bools, Ints
from hypogoal.core.checkpoints import ANEW, State
from hypogoal.core.errors import UserError
from hypogoal.domains.base import Layouts, Plan
from hypogoal.domains.gymnasium.walk import Walk
from hypogoal.domains.turns import TurnEngine
from hypogoal.observations import DIGEST, digest

if TYPE_CHECKING:
    from hypogoal.domains.gymnasium.domain import GymnasiumDomain

Label = Callable[[gymnasium.Env], bool]
Success = Callable[[gymnasium.Env, dict[str, Any], float, bool], bool]
MEMORY = 110_000  # states, for the replay's 1e5 transitions and those that are not yet in the replay


def ask_labels(env: gymnasium.Env, functions: Mapping[str, Label]) -> Bools:
    """Return which sub-goals hold in an environment's state, bool (G,), by a function for each.

    Raises ``UserError`` if a function returns no truth value.
    """
    labels = []
    for name, function in functions.items():
        holds = function(env)
        if np.ndim(holds) or holds not in (0, 1):
            raise UserError(
                f"the label of {name} is no truth value",
                f"{holds!r:.200}",
                "Give True or False.",
            )
        labels.append(bool(holds))
    return np.array(labels, bool)


class GymnasiumEngine(TurnEngine):
    """Gymnasium environments of one layout or several, which are stepped one after the other.

    Every episode begins with ``reset(seed=layout_seed)``. An observation and its labels identify a state, whatever the
    layout. A state keeps its id while it is among the newest ``memory`` distinct states. Twice as many states are kept,
    so that a replay of ``memory`` steps finds its states. Older states are forgotten.

    If the domain has ``plan``, a state is also identified by its layout, by whether it is terminal, and by what
    ``plan`` returns.

    An episode is truncated after ``max_steps`` steps, or earlier by the environment. ``success`` is called at the end
    of each episode, see ``GymnasiumDomain``.
    """

    CHANGING = (*TurnEngine.CHANGING, "_earned", "_played")

    def __init__(
        self,
        domain: GymnasiumDomain,
        layouts: Layouts,
        count: int,
        *,
        max_steps: int,
        memory: int,
        **arguments: Any,
    ):
        super().__init__()
        self.domain, self.count, self.max_steps = domain, count, max_steps
        self.layouts: Layouts = layouts
        self.memory: int = memory
        self.room = 2 * memory
        self.width = len(domain.sub_goals) + DIGEST  # the facts are the labels and the digest that identifies the state
        self._envs = [domain.make_env(**arguments) for _ in range(count)]
        self._walk = Walk(self, domain.make_env(**arguments)) if domain.plan else None
        self._is_planned = False
        self._earned = [0.0] * count  # the sum of rewards in the episode so far, by environment
        self._played: list[list[int]] = [[] for _ in range(count)]  # the actions of the episode so far, by environment
        self.observation_shape = domain.observation_shape
        self.observation_dtype = domain.observation_dtype
        actions: Any = self._envs[0].action_space
        self.n_actions = int(actions.n)
        self._ids: dict[bytes, int] = {}  # ids of the states that are kept, by digest, the oldest first
        self.reset()

    def _begin(self, number: int) -> int:
        env = self._envs[number]
        seed = self.layouts.begin(number)
        observation, _info = env.reset(seed=seed)
        self._played[number], self._earned[number] = [], 0.0
        return self.remember(env, observation, seed)

    def _play(self, number: int, action: int, elapsed: int) -> tuple[Any, ...]:
        env = self._envs[number]
        observation, reward, terminated, cut, info = env.step(action)
        earned = float(reward)
        terminated = bool(terminated)
        is_over = bool(cut) or elapsed >= self.max_steps
        truncated = is_over and not terminated
        self._played[number].append(action)
        self._earned[number] += earned
        seed = self.layouts.now[number]
        state = self.remember(env, observation, seed, terminated)
        if self._walk and self._is_planned:
            before = int(self.ids[number])
            self._walk.require(before, action, state, seed)
        success = self.domain.success
        if success is None:
            return state, earned, terminated, truncated
        succeeded = False
        if terminated or truncated:
            so_far = self._earned[number]
            succeeded = bool(success(env, info, so_far, terminated))
        return state, earned, terminated, truncated, succeeded

    def remember(self, env: gymnasium.Env, observation: Any, seed: int, terminated: bool = False) -> int:
        """Return the id of an environment's current state, in the layout of ``seed``. A new state gets an id."""
        domain = self.domain
        image = domain.reader.read(observation)
        labels = ask_labels(env, domain.label_functions)
        besides = labels.tobytes()
        if domain.plan:
            hidden = domain.plan(env) if callable(domain.plan) else None
            besides += repr((seed, terminated, hidden)).encode()
        look = digest(image, besides)
        state = self._ids.get(look)
        if state is None or state < self.n_states - self.memory:
            state = self._add(image, labels.tobytes() + look)
            self._file(look, state)
        return state

    def plan(self, starts: Ints | None = None) -> Plan | None:
        """Return what follows in all states of the layouts, whatever ``starts``. None: the domain has no ``plan``."""
        if self._walk is None:
            return None
        if not self._is_planned:
            for seed in self.layouts.seeds:
                self._walk.through(seed)
            self._is_planned = True
        return self._walk.plan()

    def _file(self, look: bytes, state: int) -> None:
        """Enter a digest's newest id. If there are more digests than kept states, drop that of a forgotten state."""
        self._ids.pop(look, None)
        self._ids[look] = state
        if len(self._ids) > self.room:
            oldest = next(iter(self._ids))
            del self._ids[oldest]

    def labels(self, ids: Ints) -> Bools:
        labels = len(self.domain.sub_goals)
        return self.read_facts(ids)[:, :labels].view(bool)

    def snapshot(self) -> State:
        """Return all that a resumed run needs: the states, and the actions played since each episode began."""
        return super().snapshot() | {"images": np.stack([*self._seen.values()])}

    def restore(self, snapshot: Mapping[str, Any]) -> None:
        """Continue from a ``snapshot`` of an engine made with the same arguments, by playing its episodes again.

        Raises ``UserError`` if the episodes lead to other states, because the environment is not deterministic.
        """
        super().restore(snapshot)
        looks = self.read_facts(self.kept)[:, -DIGEST:]
        self._seen = dict(zip(self.kept, snapshot["images"], strict=True))
        self._ids.clear()
        for state, look in zip(self.kept, looks, strict=True):
            self._file(look.tobytes(), state)
        for number in range(self.count):
            self._replay(number)

    def _replay(self, number: int) -> None:
        """Play one environment's current episode again. Raises ``UserError`` if it leads to another state."""
        env = self._envs[number]
        seed = self.layouts.now[number]
        observation, _info = env.reset(seed=seed)
        for action in self._played[number]:
            observation, *_ = env.step(action)
        [kept] = self.images(self.ids[number : number + 1])
        if not np.array_equal(self.domain.reader.read(observation), kept):
            raise UserError(
                "the environment does not repeat itself for the same seed, so this cannot be resumed",
                f"layout_seed={seed}",
                ANEW,
            )
