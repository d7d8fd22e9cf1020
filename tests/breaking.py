"""A training that breaks off, to be gone on with."""

from collections.abc import Callable
from pathlib import Path

from hypogoal.core.checkpoints import Checkpoints, State


class Broken(Exception):
    """The end of a process."""


class Breaking(Checkpoints):
    """Saves after some steps, else after the one before the last, and breaks off after the last."""

    def __init__(self, path: Path, last: int, saves: tuple[int, ...] = ()):
        super().__init__(path)
        self.last, self.saves = last, saves or (last - 1,)
        self.steps = 0

    def offer(self, state: Callable[[], State]) -> None:
        self.steps += 1
        if self.steps in self.saves:
            self.save(state())
        if self.steps == self.last:
            raise Broken
