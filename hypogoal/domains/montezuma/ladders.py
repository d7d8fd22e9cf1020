"""The positions of the ladders of Montezuma's Revenge, and distances through the rooms.

Positions are in RAM units (see ``emulator``). ``measured.toml`` has what was measured.
"""

import tomllib
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

from hypogoal.core.arrays import Ints
from hypogoal.domains.montezuma.emulator import FIRST_ROOM_OF_ROW, Position, find_row

_FILE = Path(__file__).with_name("measured.toml")
MEASURED = tomllib.loads(_FILE.read_text(encoding="utf-8"))


class Ladder(NamedTuple):
    """A ladder, from the place where the agent mounts it to the place where the agent gets off."""

    name: str
    top: Position
    base: Position
    steps_down: int  # agent steps of DOWN from the top to the base
    steps_up: int  # agent steps of UP from the base to the top, or 0 if nobody climbs up

    @property
    def joins_rooms(self) -> bool:
        """Whether the ladder leads through the floor."""
        return self.top.room != self.base.room


LADDERS = []
for _name, _facts in MEASURED["ladders"].items():
    _ladder = Ladder(
        _name,
        Position(*_facts["top"]),
        Position(*_facts["base"]),
        _facts["steps_down"],
        _facts.get("steps_up", 0),
    )
    LADDERS.append(_ladder)
BASES = tuple(ladder.base for ladder in LADDERS)
TOPS = tuple(ladder.top for ladder in LADDERS)

# The rooms lie in one plane, side by side and row upon row. Each row of the pyramid begins one room further left, so
# below room c of a row lies room c + 1 of the next row.
ROOM_WIDTH, ROOM_HEIGHT = 149, 121  # crossing into the next room, from x 149 to 1, or from y 134 to 254, is one unit
SHAFT_EXIT, SHAFT_ENTRY = 134, 254  # y when the agent leaves a room through the floor, and y right after
# The first room of each region. The agent can walk between the rooms of a region, as was tried at y 235. A region ends
# with a row of the pyramid, or at a wall. Doors that take a key count as open.
FIRST_ROOM_OF_REGION = (0, 3, 8, 10, 15, 21)
FAR = 10**9  # longer than any path


def plane(positions: Ints) -> Ints:
    """Return positions (n, 3) as coordinates (n, 2) in one plane, x to the right and y upwards."""
    room, x, y = positions.T
    row = find_row(room)
    column = room - np.take(FIRST_ROOM_OF_ROW, row) - row
    across = x + ROOM_WIDTH * column
    upwards = y - ROOM_HEIGHT * row
    return np.stack([across, upwards], axis=1)


def find_region(rooms: Ints) -> Ints:
    """Return the number of each room's region."""
    return np.searchsorted(FIRST_ROOM_OF_REGION, rooms, side="right")


def straight(positions: Ints, others: Ints) -> Ints:
    """Return the Manhattan distance of positions (n, 3) from others (m, 3), int64 (n, m).

    The distance between regions is ``FAR``.
    """
    apart = plane(positions)[:, None] - plane(others)
    away = np.abs(apart).sum(2)
    region = find_region(positions[:, 0])
    other_region = find_region(others[:, 0])
    is_joined = region[:, None] == other_region
    return np.where(is_joined, away, FAR)


@cache
def _landmarks(places: Sequence[Position]) -> tuple[Ints, Ints]:
    """Return landmarks (m, 3), and their distances to the nearest place (m,).

    The landmarks are all places, and both ends of each shaft between rooms.
    """
    shafts = [ladder for ladder in LADDERS if ladder.joins_rooms]
    exits = [ladder.top._replace(y=SHAFT_EXIT) for ladder in shafts]
    entries = [ladder.base._replace(y=SHAFT_ENTRY) for ladder in shafts]
    landmarks = np.array([*places, *exits, *entries])
    leg = straight(landmarks, landmarks)
    upper = len(places) + np.arange(len(shafts))
    lower = upper + len(shafts)
    leg[upper, lower] = 1
    leg[lower, upper] = 1
    distance = np.full(len(landmarks), FAR)
    distance[: len(places)] = 0
    for _ in landmarks:  # Bellman-Ford, since a shortest path has at most as many legs as there are landmarks
        distance = (leg + distance).min(1)
    return landmarks, distance


def distance_to(positions: Ints, places: Sequence[Position]) -> Ints:
    """Return the Manhattan distance from positions (n, 3) to the nearest place, through the rooms, int64 (n,).

    Paths go sideways from room to room within a region, freely up and down, and from row to row only through the
    ladders that join rooms. Platforms and walls inside a room are ignored, so the distance is a lower bound.
    """
    landmarks, onwards = _landmarks(places)
    ways = straight(positions, landmarks) + onwards
    return ways.min(1)
