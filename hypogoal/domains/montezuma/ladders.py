"""The ladders of Montezuma's Revenge: their positions, and distances through the rooms (Spec B4, B5, F3).

Positions are in RAM units (see ``emulator``). What was measured is in ``measured.toml``.
"""

import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np

from hypogoal.core.arrays import Bools, Ints
from hypogoal.domains.montezuma.emulator import FIRST_ROOM_OF_ROW, Position, row_of

REACH = 2  # at a place: at most this far from it, in x and in y


@dataclass(frozen=True)
class Ladder:
    """A ladder, from where the agent mounts it to where it gets off."""

    name: str  # its rooms, or its place in room 1 (left, middle, right)
    top: Position
    base: Position
    steps_down: int  # agent steps of DOWN from the top to the base

    @property
    def joins_rooms(self) -> bool:
        """Whether it leads through the floor."""
        return self.top.room != self.base.room

    @property
    def steps_up(self) -> int:
        """Agent steps of UP from the base to the top: one more where that is another room."""
        return self.steps_down + self.joins_rooms


_FILE = Path(__file__).with_name("measured.toml")
MEASURED = tomllib.loads(_FILE.read_text(encoding="utf-8"))
LADDERS = []
for _name, _facts in MEASURED["ladders"].items():
    LADDERS.append(Ladder(_name, Position(*_facts["top"]), Position(*_facts["base"]), _facts["steps_down"]))
BASES = tuple(ladder.base for ladder in LADDERS)
TOPS = tuple(ladder.top for ladder in LADDERS)

# The rooms side by side and row upon row, in one plane. Each row begins half a step of the pyramid further left: below
# room c of a row lies room c + 1 of the next.
ROOM_WIDTH, ROOM_HEIGHT = 149, 121  # so that crossing, x 149 to 1, y 134 to 254, is one unit
SHAFT_EXIT, SHAFT_ENTRY = 134, 254  # y on leaving a room through its floor, and y right after
# The agent can walk between the rooms of a region, tried at y 235: from one of these to before the next. A region ends
# with a row of the pyramid, or at a wall. Doors that take a key count as open.
FIRST_ROOM_OF_REGION = (0, 3, 8, 10, 15, 21)
FAR = 10**9  # longer than any path


def within(positions: Ints, places: Sequence[Position], reach: int) -> Bools:
    """Whether positions (n, 3) of room, x, y are within ``reach``, in x and in y, of places (m); bool (n, m)."""
    differences = positions[:, None] - np.array(places)
    apart = np.abs(differences)
    same_room = apart[..., 0] == 0
    close = (apart[..., 1:] <= reach).all(-1)
    return close & same_room


def place_of(positions: Ints, places: Sequence[Position]) -> Ints:
    """The index of the place at which positions (n, 3) are, -1 for none; int64 (n,)."""
    at = within(positions, places, REACH)
    anywhere = at.any(1)
    return np.where(anywhere, at.argmax(1), -1)


def plane(positions: Ints) -> Ints:
    """Positions (n, 3) as coordinates (n, 2) in one plane, x to the right, y upwards."""
    room, x, y = positions.T
    row = row_of(room)
    column = room - np.take(FIRST_ROOM_OF_ROW, row) - row
    return np.stack([x + ROOM_WIDTH * column, y - ROOM_HEIGHT * row], axis=1)


def region_of(rooms: Ints) -> Ints:
    """The numbers of rooms' regions."""
    return np.searchsorted(FIRST_ROOM_OF_REGION, rooms, side="right")


def _straight(positions: Ints, others: Ints) -> Ints:
    """The Manhattan distance of each of some places in the plane (n, 2) from each of others (m, 2); int (n, m)."""
    return np.abs(positions[:, None] - others).sum(2)


@cache
def _landmarks(places: tuple[Position, ...]) -> tuple[Ints, Ints, Ints]:
    """All places and both ends of each shaft between rooms: regions (m,), plane (m, 2), distance to a place (m,)."""
    shafts = [ladder for ladder in LADDERS if ladder.joins_rooms]
    exits = [ladder.top._replace(y=SHAFT_EXIT) for ladder in shafts]
    entries = [ladder.base._replace(y=SHAFT_ENTRY) for ladder in shafts]
    landmarks = np.array([*places, *exits, *entries])
    region = region_of(landmarks[:, 0])
    at = plane(landmarks)

    joined = region[:, None] == region
    upper = len(places) + np.arange(len(shafts))
    lower = upper + len(shafts)
    joined[upper, lower] = True
    joined[lower, upper] = True
    leg = np.where(joined, _straight(at, at), FAR)
    distance = np.full(len(landmarks), FAR)
    distance[: len(places)] = 0
    for _ in landmarks:  # Bellman-Ford: a shortest path has at most as many legs as there are landmarks
        distance = (leg + distance).min(1)
    return region, at, distance


def distance_to(positions: Ints, places: tuple[Position, ...]) -> Ints:
    """Spec F3: the Manhattan distance from positions (n, 3) to the nearest place, through the rooms; int (n,).

    Paths go sideways from room to room within a region, freely up and down, and
    from row to row only through the nine ladders that join rooms. Platforms and walls inside a room are ignored, so it
    is a lower bound. 0 at a place itself.
    """
    region, at, onwards = _landmarks(places)
    away = _straight(plane(positions), at) + onwards
    reachable = region_of(positions[:, :1]) == region
    return np.where(reachable, away, FAR).min(1)
