"""The ladders of Montezuma's Revenge: where they are, when one is climbed down, and how far it is (Spec B4, B5, F3).

Positions are the RAM's (see ``montezuma_emulator``). They were read off the emulator while the agent climbed down; a
test marked ``atari`` plays every descent again.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from hypogoal.core.errors import UserError
from hypogoal.domains.montezuma_emulator import FIRST_ROOM_OF_ROW, ROOMS, Position, row_of

SUB_GOAL = "climb-down-ladder"
REACH = 2  # at a base: this far from it at most, in x and in y


@dataclass(frozen=True)
class Ladder:
    """A ladder, from where the agent mounts it to where it gets off."""

    name: str  # its rooms, or its place in room 1 (left, middle, right)
    top: Position
    base: Position
    steps_down: int  # agent steps of DOWN from the top to the base
    runs_on: bool = False  # the base is the top of the next ladder; by Spec B5 such states get no label


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
BY_NAME = {ladder.name: ladder for ladder in LADDERS}
GROUPS: tuple[tuple[int, ...], ...] = ((1,), (2, 6), (0, 4, 10), (3, 9), (7, 13, 21), (5, 11, 19), (14, 22))
BASES, TOPS = [ladder.base for ladder in LADDERS], [ladder.top for ladder in LADDERS]

# The rooms side by side and row upon row, in one plane. Each row begins half a step of the pyramid further left: the
# room below room c of a row is c + 1 of the next.
ROOM_WIDTH, ROOM_HEIGHT = 149, 121  # so that crossing, x 149 to 1, y 134 to 254, is one unit
SHAFT_EXIT, SHAFT_ENTRY = 134, 254  # y where one leaves a room through its floor, and where one then is
# Neighbours with a wall between them, tried at y 235. Doors that take a key count as open.
WALLS = frozenset({(9, 10), (20, 21)})
FAR = 10**9  # more than any way is long


def ladder_named(name: str) -> Ladder:
    """A ladder by its name; a ``UserError`` where there is none."""
    if name not in BY_NAME:
        raise UserError("unknown ladder", name, f"Choose one of {', '.join(BY_NAME)}.")
    return BY_NAME[name]


def within(positions: NDArray[np.integer], places: Sequence[Position], reach: int) -> NDArray[np.bool_]:
    """Which positions (n, 3) of room, x, y are at which places (m): that far at most, in x and in y; bool (n, m)."""
    away = np.abs(positions[:, None] - np.array(places))
    near: NDArray[np.bool_] = (away[..., 1:] <= reach).all(-1)
    return near & (away[..., 0] == 0)


def ladders_of(positions: NDArray[np.integer]) -> NDArray[np.int64]:
    """The index in ``LADDERS`` of the base that positions (n, 3) are at, -1 for none; int64 (n,)."""
    at = within(positions, BASES, REACH)
    return np.where(at.any(1), at.argmax(1), -1)


def at_base(positions: NDArray[np.integer]) -> NDArray[np.bool_]:
    """Spec B4: whether positions (n, 3) are at the base of a ladder, bool (n,); whether alive is not looked at."""
    return ladders_of(positions) >= 0


def plane(positions: NDArray[np.int64]) -> NDArray[np.int64]:
    """Positions (n, 3) as coordinates (n, 2) in one plane, x to the right, y upwards."""
    row = np.searchsorted(FIRST_ROOM_OF_ROW, positions[:, 0], side="right") - 1
    column = positions[:, 0] - np.array(FIRST_ROOM_OF_ROW)[row] - row
    return np.stack([positions[:, 1] + ROOM_WIDTH * column, positions[:, 2] - ROOM_HEIGHT * row], axis=1)


@cache
def _regions() -> NDArray[np.int64]:
    """Per room the number of its region: rooms that one walks between, side by side."""
    region = [0]
    for room in range(1, ROOMS):
        together = row_of(room) == row_of(room - 1) and (room - 1, room) not in WALLS
        region.append(region[-1] + (not together))
    return np.array(region)


@cache
def _landmarks() -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """All bases and both ends of each shaft between rooms: regions (m,), plane (m, 2), distance to a base (m,)."""
    shafts = [ladder for ladder in LADDERS if ladder.top.room != ladder.base.room]
    exits = [Position(ladder.top.room, ladder.top.x, SHAFT_EXIT) for ladder in shafts]
    entries = [Position(ladder.base.room, ladder.base.x, SHAFT_ENTRY) for ladder in shafts]
    positions = np.array([*BASES, *exits, *entries])
    region, at = _regions()[positions[:, 0]], plane(positions)
    joined = region[:, None] == region
    out = len(BASES) + np.arange(len(shafts))
    into = out + len(shafts)
    joined[out, into] = joined[into, out] = True
    away = np.where(joined, np.abs(at[:, None] - at).sum(2), FAR)
    distance = np.where(np.arange(len(positions)) < len(BASES), 0, FAR)
    for _ in positions:  # Bellman and Ford: no shortest way has more legs than there are landmarks
        distance = (away + distance).min(1)
    return region, at, distance


def distance_to_base(positions: NDArray[np.int64]) -> NDArray[np.int64]:
    """Spec F3: Manhattan distance from positions (n, 3) to the nearest base, on a way through the rooms; int (n,).

    Within a row of the pyramid one goes sideways from room to room, except where ``WALLS`` stand, and up and down
    freely; from row to row only through the nine ladders that join rooms. Platforms and walls inside a room are not
    looked at, so that this is the least it can be. 0 at a base's own position.
    """
    region, at, onwards = _landmarks()
    away = np.abs(plane(positions)[:, None] - at).sum(2) + onwards
    same = _regions()[positions[:, 0]][:, None] == region
    return np.where(same, away, np.iinfo(np.int64).max).min(1)
