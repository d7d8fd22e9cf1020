"""Montezuma's Revenge in a second process, which plays a step while this one learns (``play_ahead``).

It is the engine of ``montezuma_engine`` but for its emulators. Their frames come through shared memory, 113 kB for
sixteen games; the rest, 3 kB, through a pipe.
"""

from collections.abc import Mapping
from multiprocessing import get_context
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hypogoal.core.workers import Companion
from hypogoal.domains import montezuma_emulator as game
from hypogoal.domains.base import Step
from hypogoal.domains.montezuma_engine import MontezumaEngine


class Saved(NamedTuple):
    """A state of an emulator as plain data; frames stay in the process of the engine."""

    state: bytes  # a serialized ``ALEState``
    screen: NDArray[np.uint8]


class Emulators:
    """The emulators in the second process; ``frames``: shared memory for a frame of each."""

    def __init__(self, count: int, seed: int, frames: Any):
        self.emulators = [game.Emulator(seed + number) for number in range(count)]
        self.frames = _frames_in(frames, count)

    def __call__(self, message: tuple[Mapping[int, Saved], list[int] | None]) -> list[game.Outcome] | list[Saved]:
        """Return to states, by emulator; then play the actions, or, where there are none, save all emulators."""
        from ale_py import ALEState

        restored, actions = message
        for number, (state, screen) in restored.items():
            emulator = self.emulators[number]
            emulator.restore(game.Snapshot(ALEState(state), emulator.seen, screen))
        if actions is None:
            return [_saved(emulator.save()) for emulator in self.emulators]
        outcomes = [emulator.play(action) for emulator, action in zip(self.emulators, actions, strict=True)]
        for frame, emulator in zip(self.frames, self.emulators, strict=True):
            frame[:] = emulator.seen[-1]
        return outcomes


class Away:
    """An emulator of the second process as the engine sees it, with the methods of ``Emulator`` that it calls.

    Attributes:
        frame: where its latest frame lies in shared memory, uint8 (84, 84).
        restored: the state to which it is to return before it plays on, if any.
        outcome, saved: what the second process has answered.
    """

    seen: game.Frames
    outcome: game.Outcome
    saved: Saved

    def __init__(self, frame: NDArray[np.uint8]):
        self.frame = frame
        self.restored: game.Snapshot | None = None

    def restore(self, snapshot: game.Snapshot) -> None:
        """See ``Emulator.restore``."""
        self.seen, self.restored = snapshot.seen, snapshot

    def play(self, action: int) -> game.Outcome:
        """The outcome of the step that was played."""
        self.seen = (*self.seen[1:], self.frame.copy())
        return self.outcome

    def save(self) -> game.Snapshot:
        """The state that was saved."""
        from ale_py import ALEState

        return game.Snapshot(ALEState(self.saved.state), self.seen, self.saved.screen)


class AheadEngine(MontezumaEngine):
    """``MontezumaEngine`` whose games a second process plays from :meth:`begin_step` on; all it says is the same."""

    ahead = True

    def _make_emulators(self, seed: int) -> list[Any]:
        frames = get_context("spawn").RawArray("B", self.count * game.SIDE**2)
        self._companion, self._begun = Companion(Emulators, self.count, seed, frames), False
        return [Away(frame) for frame in _frames_in(frames, self.count)]

    def begin_step(self, actions: NDArray[np.int64]) -> None:
        """Have the second process play these actions (E,)."""
        self._send(self._valid(actions))
        self._begun = True

    def step(self, actions: NDArray[np.int64]) -> Step:
        """Wait for the step that was begun with these actions, or play one; errors as of :meth:`Companion.receive`."""
        if not self._begun:
            self.begin_step(actions)
        self._begun = False
        for emulator, outcome in zip(self._emulators, self._companion.receive(), strict=True):
            emulator.outcome = outcome
        return super().step(actions)

    def snapshot(self) -> dict[str, NDArray[Any]]:
        self._send(None)
        for emulator, saved in zip(self._emulators, self._companion.receive(), strict=True):
            emulator.saved = saved
        return super().snapshot()

    def _send(self, actions: list[int] | None) -> None:
        away = enumerate(self._emulators)
        restored = {number: _saved(emulator.restored) for number, emulator in away if emulator.restored}
        self._companion.send((restored, actions))
        for emulator in self._emulators:
            emulator.restored = None


def _frames_in(memory: Any, count: int) -> NDArray[np.uint8]:
    return np.frombuffer(memory, np.uint8).reshape(count, game.SIDE, game.SIDE)


def _saved(snapshot: game.Snapshot) -> Saved:
    return Saved(snapshot.state.serialize(), snapshot.screen)
