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
from hypogoal.domains.montezuma.emulator import FIRST_ROOM_OF_ROW, ROOMS, Position, row_of

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
LADDERS: list[Ladder] = []
for _name, _facts in MEASURED["ladders"].items():
    _top = Position(*_facts["top"])
    _base = Position(*_facts["base"])
    LADDERS.append(Ladder(_name, _top, _base, _facts["steps_down"]))
GROUPS = tuple(map(tuple, MEASURED["groups"]))
BASES = tuple(ladder.base for ladder in LADDERS)
TOPS = tuple(ladder.top for ladder in LADDERS)

# The rooms side by side and row upon row, in one plane. Each row begins half a step of the pyramid further left: below
# room c of a row lies room c + 1 of the next.
ROOM_WIDTH, ROOM_HEIGHT = 149, 121  # so that crossing, x 149 to 1, y 134 to 254, is one unit
SHAFT_EXIT, SHAFT_ENTRY = 134, 254  # y on leaving a room through its floor, and y right after
# Neighbours with a wall between them, tried at y 235. Doors that take a key count as open.
WALLS = frozenset({(9, 10), (20, 21)})
FAR = 10**9  # longer than any path


def within(positions: Ints, places: Sequence[Position], reach: int) -> Bools:
    """Whether positions (n, 3) of room, x, y are within ``reach``, in x and in y, of places (m); bool (n, m)."""
    differences = positions[:, None] - np.array(places)
    apart = np.abs(differences)
    same_room = apart[..., 0] == 0
    close: Bools = (apart[..., 1:] <= reach).all(-1)
    return close & same_room


def place_of(positions: Ints, places: Sequence[Position]) -> Ints:
    """The index of the place at which positions (n, 3) are, -1 for none; int64 (n,)."""
    at = within(positions, places, REACH)
    anywhere = at.any(1)
    return np.where(anywhere, at.argmax(1), -1)


def plane(positions: Ints) -> Ints:
    """Positions (n, 3) as coordinates (n, 2) in one plane, x to the right, y upwards."""
    room, x, y = positions.T
    firsts = np.array(FIRST_ROOM_OF_ROW)
    row = np.searchsorted(firsts, room, side="right") - 1
    first = firsts[row]
    column = room - first - row
    right = x + ROOM_WIDTH * column
    up = y - ROOM_HEIGHT * row
    return np.stack([right, up], axis=1)


@cache
def _regions() -> Ints:
    """The region of each room, by number: the agent can walk between the rooms of a region."""
    regions = [0]
    for room in range(1, ROOMS):
        same_row = row_of(room) == row_of(room - 1)
        open_between = same_row and (room - 1, room) not in WALLS
        last = regions[-1]
        regions.append(last if open_between else last + 1)
    return np.array(regions)


@cache
def _landmarks(places: tuple[Position, ...]) -> tuple[Ints, Ints, Ints]:
    """All places and both ends of each shaft between rooms: regions (m,), plane (m, 2), distance to a place (m,)."""
    shafts = [ladder for ladder in LADDERS if ladder.joins_rooms]
    exits = [ladder.top._replace(y=SHAFT_EXIT) for ladder in shafts]
    entries = [ladder.base._replace(y=SHAFT_ENTRY) for ladder in shafts]
    landmarks = np.array([*places, *exits, *entries])
    region = _regions()[landmarks[:, 0]]
    at = plane(landmarks)

    joined = region[:, None] == region
    numbers = np.arange(len(shafts))
    upper = len(places) + numbers
    lower = upper + len(shafts)
    joined[upper, lower] = True
    joined[lower, upper] = True
    differences = at[:, None] - at
    straight = np.abs(differences).sum(2)
    leg = np.where(joined, straight, FAR)

    distance = np.full(len(landmarks), FAR)
    distance[: len(places)] = 0
    for _ in landmarks:  # Bellman-Ford: a shortest path has at most as many legs as there are landmarks
        distance = (leg + distance).min(1)
    return region, at, distance


def distance_to(positions: Ints, places: tuple[Position, ...]) -> Ints:
    """Spec F3: the Manhattan distance from positions (n, 3) to the nearest place, through the rooms; int (n,).

    Paths go sideways from room to room within a row of the pyramid, except through ``WALLS``, freely up and down, and
    from row to row only through the nine ladders that join rooms. Platforms and walls inside a room are ignored, so it
    is a lower bound. 0 at a place itself.
    """
    region, at, onwards = _landmarks(places)
    agent = plane(positions)
    differences = agent[:, None] - at
    to_landmark = np.abs(differences).sum(2)
    room = positions[:, 0]
    own_region = _regions()[room]
    reachable = own_region[:, None] == region
    away = to_landmark + onwards
    away[~reachable] = np.iinfo(np.int64).max
    return away.min(1)
