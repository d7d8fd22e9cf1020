"""The ladders of Montezuma's Revenge: their positions, when one is climbed down, and distances (Spec B4, B5, F3).

Positions are in RAM units (see ``emulator``), read off the emulator while the agent climbed down; a test
marked ``atari`` repeats every descent.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from hypogoal.domains.montezuma.emulator import FIRST_ROOM_OF_ROW, ROOMS, Position, row_of

REACH = 2  # at a place: at most this far from it, in x and in y


@dataclass(frozen=True)
class Ladder:
    """A ladder, from where the agent mounts it to where it gets off."""

    name: str  # its rooms, or its place in room 1 (left, middle, right)
    top: Position
    base: Position
    steps_down: int  # agent steps of DOWN from the top to the base
    runs_on: bool = False  # the base is the top of the next ladder; by Spec B5 such states are not labelled

    @property
    def steps_up(self) -> int:
        """Agent steps of UP from the base to the top: one more where that is another room."""
        return self.steps_down + (self.top.room != self.base.room)


LADDERS = (
    Ladder("1L", Position(1, 21, 192), Position(1, 21, 148), 9),
    Ladder("1M", Position(1, 77, 235), Position(1, 76, 192), 8),
    Ladder("1R", Position(1, 133, 192), Position(1, 133, 148), 9),
    Ladder("0-4", Position(0, 77, 235), Position(4, 77, 235), 28, runs_on=True),
    Ladder("2-6", Position(2, 77, 235), Position(6, 77, 235), 28),
    Ladder("3-9", Position(3, 77, 235), Position(9, 77, 235), 28),
    Ladder("4-10", Position(4, 77, 235), Position(10, 77, 235), 28),
    Ladder("5-11", Position(5, 77, 157), Position(11, 77, 235), 9, runs_on=True),
    Ladder("7-13", Position(7, 77, 235), Position(13, 77, 235), 28, runs_on=True),
    Ladder("11-19", Position(11, 77, 235), Position(19, 77, 235), 28),
    Ladder("13-21", Position(13, 77, 235), Position(21, 77, 235), 28),
    Ladder("14-22", Position(14, 77, 160), Position(22, 77, 235), 10),
)
GROUPS: tuple[tuple[int, ...], ...] = ((1,), (2, 6), (0, 4, 10), (3, 9), (7, 13, 21), (5, 11, 19), (14, 22))
BASES, TOPS = [ladder.base for ladder in LADDERS], [ladder.top for ladder in LADDERS]

# The rooms side by side and row upon row, in one plane. Each row begins half a step of the pyramid further left: below
# room c of a row lies room c + 1 of the next.
ROOM_WIDTH, ROOM_HEIGHT = 149, 121  # so that crossing, x 149 to 1, y 134 to 254, is one unit
SHAFT_EXIT, SHAFT_ENTRY = 134, 254  # y on leaving a room through its floor, and y right after
# Neighbours with a wall between them, tried at y 235. Doors that take a key count as open.
WALLS = frozenset({(9, 10), (20, 21)})
FAR = 10**9  # longer than any path


def within(positions: NDArray[np.integer], places: Sequence[Position], reach: int) -> NDArray[np.bool_]:
    """Whether positions (n, 3) of room, x, y are within ``reach``, in x and in y, of places (m); bool (n, m)."""
    distance = np.abs(positions[:, None] - np.array(places))
    near: NDArray[np.bool_] = (distance[..., 1:] <= reach).all(-1)
    return near & (distance[..., 0] == 0)


def place_of(positions: NDArray[np.integer], places: Sequence[Position]) -> NDArray[np.int64]:
    """The index of the place at which positions (n, 3) are, -1 for none; int64 (n,)."""
    at = within(positions, places, REACH)
    return np.where(at.any(1), at.argmax(1), -1)


def ladders_of(positions: NDArray[np.integer]) -> NDArray[np.int64]:
    """The index in ``LADDERS`` of the base at which positions (n, 3) are, -1 for none; int64 (n,)."""
    return place_of(positions, BASES)


def at_base(positions: NDArray[np.integer]) -> NDArray[np.bool_]:
    """Spec B4: whether positions (n, 3) are at the base of a ladder, alive or not; bool (n,)."""
    return ladders_of(positions) >= 0


def plane(positions: NDArray[np.int64]) -> NDArray[np.int64]:
    """Positions (n, 3) as coordinates (n, 2) in one plane, x to the right, y upwards."""
    row = np.searchsorted(FIRST_ROOM_OF_ROW, positions[:, 0], side="right") - 1
    column = positions[:, 0] - np.array(FIRST_ROOM_OF_ROW)[row] - row
    return np.stack([positions[:, 1] + ROOM_WIDTH * column, positions[:, 2] - ROOM_HEIGHT * row], axis=1)


@cache
def _regions() -> NDArray[np.int64]:
    """The region of each room, by number: the agent can walk between the rooms of a region."""
    region = [0]
    for room in range(1, ROOMS):
        together = row_of(room) == row_of(room - 1) and (room - 1, room) not in WALLS
        region.append(region[-1] + (not together))
    return np.array(region)


@cache
def _landmarks(places: tuple[Position, ...]) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """All places and both ends of each shaft between rooms: regions (m,), plane (m, 2), distance to a place (m,)."""
    shafts = [ladder for ladder in LADDERS if ladder.top.room != ladder.base.room]
    exits = [Position(ladder.top.room, ladder.top.x, SHAFT_EXIT) for ladder in shafts]
    entries = [Position(ladder.base.room, ladder.base.x, SHAFT_ENTRY) for ladder in shafts]
    positions = np.array([*places, *exits, *entries])
    region, at = _regions()[positions[:, 0]], plane(positions)
    joined = region[:, None] == region
    out = len(places) + np.arange(len(shafts))
    into = out + len(shafts)
    joined[out, into] = joined[into, out] = True
    away = np.where(joined, np.abs(at[:, None] - at).sum(2), FAR)
    distance = np.where(np.arange(len(positions)) < len(places), 0, FAR)
    for _ in positions:  # Bellman-Ford: a shortest path has at most as many legs as there are landmarks
        distance = (away + distance).min(1)
    return region, at, distance


def distance_to_base(positions: NDArray[np.int64]) -> NDArray[np.int64]:
    """Spec F3: :func:`distance_to` the nearest base."""
    return distance_to(positions, tuple(BASES))


def distance_to(positions: NDArray[np.int64], places: tuple[Position, ...]) -> NDArray[np.int64]:
    """Spec F3: the Manhattan distance from positions (n, 3) to the nearest place, through the rooms; int (n,).

    Paths go sideways from room to room within a row of the pyramid, except through ``WALLS``, freely up and down, and
    from row to row only through the nine ladders that join rooms. Platforms and walls inside a room are ignored, so it
    is a lower bound. 0 at a place itself.
    """
    region, at, onwards = _landmarks(places)
    away = np.abs(plane(positions)[:, None] - at).sum(2) + onwards
    same = _regions()[positions[:, 0]][:, None] == region
    return np.where(same, away, np.iinfo(np.int64).max).min(1)
