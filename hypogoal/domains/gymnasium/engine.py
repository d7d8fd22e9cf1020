"""Any Gymnasium environment as an engine: many copies stepped in turn, states by id, each distinct one kept once."""

import math
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from typing import Any, SupportsFloat

import gymnasium
import numpy as np
from gymnasium import spaces

from hypogoal.core.arrays import Bools, Ints
from hypogoal.core.checkpoints import ANEW
from hypogoal.core.errors import UserError
from hypogoal.domains.base import Layouts, Step, TurnEngine
from hypogoal.domains.gymnasium.reader import reader_of
from hypogoal.observations import Observations, digest

MakeEnv = Callable[..., gymnasium.Env]
Label = Callable[[gymnasium.Env], bool]
LabelAll = Callable[[gymnasium.Env], Mapping[str, bool]]
Success = Callable[[gymnasium.Env, dict[str, Any], float, bool], bool]
MEMORY = 110_000  # the replay's 1e5 transitions and those not yet in it


def make_checked(make: MakeEnv) -> gymnasium.Env:
    """An environment with readable observations and ``Discrete`` actions; else a ``UserError``."""
    env: Any = make()
    if not isinstance(env, gymnasium.Env):
        do = "Give a function that returns a gymnasium.Env."
        raise UserError("the environment is none of Gymnasium's", type(env).__name__, do)
    reader_of(env)
    actions = env.action_space
    if not isinstance(actions, spaces.Discrete) or actions.start != 0:
        raise UserError("actions must be Discrete(n), from 0", actions, "Wrap it so that they are.")
    return env


def check_step(result: Any) -> None:
    """Refuse (``UserError``) a malformed result of ``env.step``; engines call it for the first one."""
    try:
        _observation, reward, terminated, truncated, info = result
        fits = isinstance(reward, SupportsFloat) and math.isfinite(float(reward))
        fits = fits and is_truth(terminated) and is_truth(truncated)
        fits = fits and isinstance(info, dict)
    except (TypeError, ValueError):
        fits = False
    if not fits:
        do = "Give (observation, reward, terminated, truncated, info): a finite number, True or False twice, a dict."
        raise UserError("the environment's step gave something else than Gymnasium says", f"{result!r:.200}", do)


def is_truth(value: Any) -> bool:
    """Whether this is a single truth value, or 0 or 1."""
    return not np.ndim(value) and value in (0, 1)


class Labels:
    """Which of G sub-goals hold in an environment's current state, by the user's functions.

    Either one function per name, or names and one function for all. Names alone, or both kinds of functions, are a
    ``UserError``.
    """

    def __init__(
        self,
        sub_goals: Mapping[str, Label] | Sequence[str],
        together: LabelAll | None = None,
    ):
        if isinstance(sub_goals, str):
            sub_goals = [sub_goals]
        self.names = tuple(sub_goals)
        self._each = sub_goals if isinstance(sub_goals, Mapping) else {}
        self._together = together
        self._checked = False
        if isinstance(sub_goals, Mapping) == (together is not None):
            fault = "sub-goals have functions and labels= too" if together else "nothing says where sub-goals hold"
            do = "Give {name: function}, or names and labels=, a function from the environment to {name: bool}."
            names = ", ".join(map(str, self.names))
            raise UserError(fault, names, do)

    def of(self, env: gymnasium.Env) -> Bools:
        """The labels of an environment's state, bool (G,); ``UserError`` if the first ones are no truth values."""
        if self._together:
            labels: Any = self._together(env)
        else:
            labels = {name: label(env) for name, label in self._each.items()}
        if not self._checked:
            self._check(labels)
        holds = [bool(labels[name]) for name in self.names]
        return np.array(holds, np.bool_)

    def _check(self, labels: Any) -> None:
        do = f"Give True or False for each of {', '.join(self.names)}."
        if not isinstance(labels, Mapping) or {*labels} != {*self.names}:
            raise UserError("the function of all labels gave something else", f"{labels!r:.200}", do)
        for name, value in labels.items():
            if not is_truth(value):
                raise UserError(f"the label of {name} is no truth value", f"{value!r:.200}", do)
        self._checked = True


class GymnasiumEngine(TurnEngine):
    """Environments of one layout or several, stepped one after the other.

    Every episode begins with ``reset(seed=layout_seed)``. An observation and its labels identify a state, in whichever
    layout: it keeps its id while it is among the newest ``memory`` distinct ones. Twice as many are kept, so that a
    replay of ``memory`` steps finds its states; older ones are forgotten.

    Episodes are truncated after ``max_steps`` steps, or earlier by the environment. ``success`` is called at the end of
    each, see ``GymnasiumDomain``.
    """

    def __init__(
        self,
        make: MakeEnv,
        labels: Labels,
        layouts: int | Layouts,
        count: int,
        *,
        max_steps: int,
        memory: int = MEMORY,
        success: Success | None = None,
    ):
        self.count, self.max_steps = count, max_steps
        self.layouts: Layouts = layouts if isinstance(layouts, Layouts) else Layouts((layouts,))
        self.memory: int = memory
        self.room = 2 * memory
        self._envs: list[Any] = [make_checked(make) for _ in range(count)]
        self._labeller = labels
        self._success = success
        self._checked = False  # the first step
        self._earned = [0.0] * count  # in the episode so far
        self._succeeded = [False] * count  # whether it just ended with a success
        self._played: list[list[int]] = [[] for _ in range(count)]  # the episode's actions
        self.reader = reader_of(self._envs[0])
        self.observation_shape = self.reader.shape
        self.observation_dtype = self.reader.dtype
        self.n_actions = int(self._envs[0].action_space.n)
        self._ring: list[Observations] = []
        self._labels = bytearray()
        self._ids: OrderedDict[bytes, int] = OrderedDict()  # of the states in the ring by digest, oldest first
        self.reset()

    @property
    def n_states(self) -> int:
        width = max(1, len(self._labeller.names))
        return len(self._labels) // width

    def _begin(self, number: int) -> int:
        env = self._envs[number]
        observation, _info = env.reset(seed=self.layouts.begin(number))
        self._played[number], self._earned[number] = [], 0.0
        return self._remember(env, observation)

    def _play(self, number: int, action: int, elapsed: int) -> tuple[int, float, bool, bool]:
        env = self._envs[number]
        result = env.step(action)
        if not self._checked:
            check_step(result)
            self._checked = True
        observation, reward, terminated, truncated, info = result
        reward = float(reward)
        terminated = bool(terminated)
        cut = bool(truncated) or elapsed >= self.max_steps
        truncated = cut and not terminated
        self._played[number].append(action)
        self._earned[number] += reward
        if self._success:
            over = terminated or truncated
            earned = self._earned[number]
            self._succeeded[number] = over and bool(self._success(env, info, earned, terminated))
        return self._remember(env, observation), reward, terminated, truncated

    def step(self, actions: Ints) -> Step:
        step = super().step(actions)
        if not self._success:
            return step
        return step._replace(succeeded=np.array(self._succeeded))

    def _remember(self, env: gymnasium.Env, observation: Any) -> int:
        """The id of an environment's current state."""
        image = self.reader.read(observation)
        labels = self._labeller.of(env).tobytes()
        look = digest(image, labels)
        new = self.n_states
        state = self._ids.get(look)
        if state is not None and state >= new - self.memory:
            return state
        self._keep(new, image)
        self._labels += labels
        self._file(look, new)
        return new

    def _file(self, look: bytes, state: int) -> None:
        """Enter a digest's newest id, and drop that of a forgotten state."""
        self._ids[look] = state
        self._ids.move_to_end(look)
        oldest_look = next(iter(self._ids))
        if self._ids[oldest_look] < self.oldest:
            del self._ids[oldest_look]

    def images(self, ids: Ints, out: Observations | None = None) -> Observations:
        out = self.room_for(len(ids), out)
        for row, state in enumerate(self._kept(ids)):
            out[row] = self._ring[self._place(state)]
        return out

    def labels(self, ids: Ints) -> Bools:
        width = len(self._labeller.names)
        every = np.frombuffer(self._labels, np.bool_).reshape(-1, width)
        return every[ids].copy()

    def labels_now(self) -> Bools:
        rows = [self._labeller.of(env) for env in self._envs]
        return np.stack(rows)

    def snapshot(self) -> dict[str, Any]:
        """All that a resumed run needs: the states, and the actions played since each episode began."""
        return {
            **super().snapshot(),
            "images": np.stack(self._ring),
            "labels": np.frombuffer(self._labels, np.uint8).copy(),
            "played": [list(actions) for actions in self._played],
        }

    def restore(self, snapshot: Mapping[str, Any]) -> None:
        """Continue from a ``snapshot`` of an engine made with the same arguments: replays the current episodes.

        A ``UserError`` if they lead to other states: the environment is not deterministic.
        """
        super().restore(snapshot)
        self._labels = bytearray(snapshot["labels"].tobytes())
        self._ring = list(snapshot["images"])
        self._played = [list(actions) for actions in snapshot["played"]]
        self._ids.clear()
        states = np.arange(self.oldest, self.n_states)
        for state, labels in zip(states.tolist(), self.labels(states), strict=True):
            image = self._ring[self._place(state)]
            self._file(digest(image, labels.tobytes()), state)
        for number in range(self.count):
            self._replay(number)

    def _replay(self, number: int) -> None:
        """Play one environment's current episode again."""
        env = self._envs[number]
        seed = self.layouts.now[number]
        observation, _info = env.reset(seed=seed)
        self._earned[number] = 0.0
        for action in self._played[number]:
            observation, reward, *_ = env.step(action)
            self._earned[number] += float(reward)
        [kept] = self.images(self.ids[number : number + 1])
        if not np.array_equal(self.reader.read(observation), kept):
            fault = "the environment does not repeat itself for the same seed, so this cannot be resumed"
            raise UserError(fault, f"layout_seed={seed}", ANEW)
