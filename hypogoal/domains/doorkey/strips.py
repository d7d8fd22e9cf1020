"""Pictures of states, put together from strips, which are rows of cells. Few strips differ, so each is drawn once."""

from collections.abc import Callable

import numpy as np

from hypogoal.core.arrays import Array, Bytes, Ints
from hypogoal.domains.doorkey.env import OBSERVATION_SHAPE, SIZE
from hypogoal.domains.doorkey.rules import tiles
from hypogoal.domains.tiles import TILE

UNKNOWN = -1
STRIP = SIZE * TILE * TILE * 3  # bytes of a strip


class Strips:
    """The strips that were drawn, and the strips of each state whose picture was asked for.

    Args:
        codes: a function from state ids (n,) to cell codes, uint8 (n, 64).
        rows: the number of states to have room for.
    """

    def __init__(self, codes: Callable[[Ints], Bytes], rows: int):
        self._codes = codes
        self._of_state = np.full((rows, SIZE), UNKNOWN)
        self._drawn = np.zeros((256, STRIP), np.uint8)
        self._numbers: dict[int, int] = {}  # the number of a strip, by its eight cell codes as one number

    def make_room(self) -> None:
        """Double the number of states."""
        self._of_state = lengthen(self._of_state)

    def images(self, ids: Ints) -> Bytes:
        """Return the pictures of states, uint8 (n, 64, 64, 3)."""
        strips = self._of_state.take(ids, axis=0)
        undrawn = strips[:, 0] == UNKNOWN
        if undrawn.any():
            self._draw(np.unique(ids[undrawn]))
            strips = self._of_state.take(ids, axis=0)
        rows = self._drawn.take(strips, axis=0)
        return rows.reshape(-1, *OBSERVATION_SHAPE)

    def _draw(self, ids: Ints) -> None:
        """Find the strips of states, and draw those strips that were not drawn yet."""
        codes = self._codes(ids).reshape(-1, SIZE)
        keys = codes.view(np.uint64)[:, 0]
        for row, key in enumerate(keys.tolist()):
            if key not in self._numbers:
                strip = self._numbers[key] = len(self._numbers)
                if strip == len(self._drawn):
                    self._drawn = lengthen(self._drawn)
                cells = tiles()[codes[row]]  # (cell, y, x, colour)
                self._drawn[strip] = cells.swapaxes(0, 1).ravel()
            state, place = divmod(row, SIZE)
            self._of_state[ids[state], place] = self._numbers[key]


def lengthen(table: Array) -> Array:
    """Return the table with twice as many rows. Integers in new rows are ``UNKNOWN``, and other values are 0."""
    filling = UNKNOWN if table.dtype == int else 0
    return np.concatenate([table, np.full_like(table, filling)])
