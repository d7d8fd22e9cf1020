"""An engine that plays its environments in turn."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from hypogoal.core.arrays import Bytes, Ints
from hypogoal.core.checkpoints import State
from hypogoal.domains.base import Engine, Step
from hypogoal.observations import Observations


class TurnEngine(Engine):
    """An engine that steps its environments one after the other, and keeps what was seen in the newest states.

    Subclasses define how an episode begins and how a step is played. A step is in plain Python, because NumPy's
    operations slow down an emulator's next frames (see ``montezuma.emulator``).

    Attributes:
        room: the number of states, besides start states, of which is kept what was seen.
        width: the number of bytes of the facts that are kept of every state.
    """

    restarts = resumes = True
    room: int
    width: int

    def __init__(self) -> None:
        self._seen: dict[int, Any] = {}  # what was seen, by state, in the order of states
        self._facts = bytearray()

    @property
    def n_states(self) -> int:
        return len(self._facts) // self.width

    @property
    def oldest(self) -> int:
        return max(len(self.starts), self.n_states - self.room)

    @property
    def kept(self) -> list[int]:
        """The states of which is kept what was seen, in order."""
        return [*range(len(self.starts)), *range(self.oldest, self.n_states)]

    def _add(self, seen: Any, facts: bytes) -> int:
        """Keep what was seen in a new state, and the state's facts. Return the state's id."""
        state = self.n_states
        self._seen[state] = seen
        self._facts += facts
        forgotten = state - self.room
        if forgotten >= len(self.starts):
            del self._seen[forgotten]
        return state

    def read_facts(self, ids: Ints | Sequence[int]) -> Bytes:
        """Return the facts of states, uint8 (n, ``width``), also of forgotten states."""
        every = np.frombuffer(self._facts, np.uint8)
        return every.reshape(-1, self.width)[ids]

    def images(self, ids: Ints) -> Observations:
        """Return observations as ``Engine.images`` does. Raises ``ValueError`` if a state is unknown or forgotten."""
        images = np.empty((len(ids), *self.observation_shape), self.observation_dtype)
        for row, state in enumerate(ids.tolist()):
            if state not in self._seen:
                raise ValueError(f"state {state} is unknown, or forgotten: the engine keeps the last {self.room}")
            images[row] = self._image(self._seen[state])
        return images

    def _image(self, seen: Any) -> Any:
        """Return the observation of a state, made of what was seen in the state."""
        return seen

    def snapshot(self) -> State:
        return super().snapshot() | {"facts": np.frombuffer(self._facts, np.uint8).copy()}

    def restore(self, snapshot: Mapping[str, Any]) -> None:
        super().restore(snapshot)
        self._facts = bytearray(snapshot["facts"].tobytes())

    @abstractmethod
    def _play(self, number: int, action: int, elapsed: int) -> tuple[Any, ...]:
        """Play step number ``elapsed`` of one environment's episode. Return the environment's entries of a ``Step``."""

    def step(self, actions: Ints) -> Step:
        elapsed = [steps + 1 for steps in self.elapsed.tolist()]
        outcomes = []
        ids = []
        for number, action in enumerate(actions.tolist()):
            outcome = self._play(number, action, elapsed[number])
            outcomes.append(outcome)
            state, _reward, terminated, truncated, *_ = outcome
            if terminated or truncated:
                state, elapsed[number] = self._begin(number), 0
            ids.append(state)
        self.ids, self.elapsed = np.array(ids), np.array(elapsed)
        following, rewards, *others = map(np.array, zip(*outcomes, strict=True))
        return Step(following, rewards.astype(np.float32), *others)
