"""Any Gymnasium environment as an engine: many copies stepped in turn, states by id, each distinct one kept once."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np

from hypogoal.core.arrays import Bools, Ints
from hypogoal.core.checkpoints import ANEW
from hypogoal.core.errors import UserError
from hypogoal.domains.base import Layouts, Step, TurnEngine
from hypogoal.observations import Observations, digest

if TYPE_CHECKING:
    from hypogoal.domains.gymnasium.domain import GymnasiumDomain

Label = Callable[[gymnasium.Env], bool]
Success = Callable[[gymnasium.Env, dict[str, Any], float, bool], bool]
MEMORY = 110_000  # the replay's 1e5 transitions and those not yet in it


def labels_of(env: gymnasium.Env, functions: Mapping[str, Label]) -> Bools:
    """Which sub-goals hold in an environment's state, bool (G,), by a function each; ``UserError`` if one is unsure."""
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
    return np.array(labels, np.bool_)


class GymnasiumEngine(TurnEngine):
    """Environments of one layout or several, stepped one after the other.

    Every episode begins with ``reset(seed=layout_seed)``. An observation and its labels identify a state, in whichever
    layout: it keeps its id while it is among the newest ``memory`` distinct ones. Twice as many are kept, so that a
    replay of ``memory`` steps finds its states; older ones are forgotten.

    Episodes are truncated after ``max_steps`` steps, or earlier by the environment. ``success`` is called at the end of
    each, see ``GymnasiumDomain``.
    """

    CHANGING = (*TurnEngine.CHANGING, "_played")

    def __init__(
        self,
        domain: GymnasiumDomain,
        layouts: int | Layouts,
        count: int,
        *,
        max_steps: int,
        memory: int = MEMORY,
        **arguments: Any,
    ):
        self.domain, self.count, self.max_steps = domain, count, max_steps
        self.layouts: Layouts = layouts if isinstance(layouts, Layouts) else Layouts((layouts,))
        self.memory: int = memory
        self.room = 2 * memory
        self._envs: list[Any] = [domain.make_env(**arguments) for _ in range(count)]
        self._earned = [0.0] * count  # in the episode so far
        self._succeeded = [False] * count  # whether it just ended with a success
        self._played: list[list[int]] = [[] for _ in range(count)]  # the episode's actions
        self.observation_shape = domain.observation_shape
        self.observation_dtype = domain.observation_dtype
        self.n_actions = int(self._envs[0].action_space.n)
        self._ring: list[Observations] = []
        self._labels = bytearray()
        self._ids: OrderedDict[bytes, int] = OrderedDict()  # of the states in the ring by digest, oldest first
        self.reset()

    @property
    def n_states(self) -> int:
        return len(self._labels) // len(self.domain.sub_goals)

    def _begin(self, number: int) -> int:
        env = self._envs[number]
        seed = self.layouts.begin(number)
        observation, _info = env.reset(seed=seed)
        self._played[number], self._earned[number] = [], 0.0
        return self._remember(env, observation)

    def _play(self, number: int, action: int, elapsed: int) -> tuple[int, float, bool, bool]:
        env = self._envs[number]
        observation, reward, terminated, cut, info = env.step(action)
        earned, terminated = float(reward), bool(terminated)
        truncated = (bool(cut) or elapsed >= self.max_steps) and not terminated
        self._played[number].append(action)
        self._earned[number] += earned
        success = self.domain.success
        if success:
            over = terminated or truncated
            so_far = self._earned[number]
            self._succeeded[number] = over and bool(success(env, info, so_far, terminated))
        state = self._remember(env, observation)
        return state, earned, terminated, truncated

    def step(self, actions: Ints) -> Step:
        step = super().step(actions)
        if not self.domain.success:
            return step
        return step._replace(succeeded=np.array(self._succeeded))

    def _remember(self, env: gymnasium.Env, observation: Any) -> int:
        """The id of an environment's current state."""
        image = self.domain.reader.read(observation)
        labels = labels_of(env, self.domain.label_functions).tobytes()
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

    def images(self, ids: Ints) -> Observations:
        images = self._room_for(len(ids))
        for row, state in enumerate(self._kept(ids)):
            images[row] = self._ring[self._place(state)]
        return images

    def labels(self, ids: Ints) -> Bools:
        every = np.frombuffer(self._labels, np.bool_)
        rows = every.reshape(-1, len(self.domain.sub_goals))
        return rows[ids]

    def snapshot(self) -> dict[str, Any]:
        """All that a resumed run needs: the states, and the actions played since each episode began."""
        return {
            **super().snapshot(),
            "images": np.stack(self._ring),
            "labels": np.frombuffer(self._labels, np.uint8).copy(),
        }

    def restore(self, snapshot: Mapping[str, Any]) -> None:
        """Continue from a ``snapshot`` of an engine made with the same arguments: replays the current episodes.

        A ``UserError`` if they lead to other states: the environment is not deterministic.
        """
        super().restore(snapshot)
        self._labels = bytearray(snapshot["labels"].tobytes())
        self._ring = list(snapshot["images"])
        self._ids.clear()
        states = np.arange(self.oldest, self.n_states)
        of_states = self.labels(states)
        for state, labels in zip(states.tolist(), of_states, strict=True):
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
        if not np.array_equal(self.domain.reader.read(observation), kept):
            fault = "the environment does not repeat itself for the same seed, so this cannot be resumed"
            raise UserError(
                fault,
                f"layout_seed={seed}",
                ANEW,
            )
