"""The sub-goals on Montezuma's Revenge: where they hold, by the console's memory, and in which rooms they are labelled.

The paper has the first sub-goal, ``CLIMB_DOWN``, in which the agent lives and is within ``REACH`` of a ladder's base,
in x and in y. The other sub-goals are in the authors' repository (``monte_terminations.py``), and docs/deviations.md
says where the authors' code differs. To add a sub-goal, add an entry to ``ALL``, and its rooms to ``measured.toml``,
which also has enemies and lasers.
"""

from collections.abc import Collection, Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hypogoal.core.arrays import Bools, Ints
from hypogoal.core.errors import UserError
from hypogoal.domains.montezuma.emulator import DYING, OBJECT, ROOM, SKULL, Position, X, Y
from hypogoal.domains.montezuma.ladders import BASES, FAR, MEASURED, TOPS

REACH = 2  # RAM units in x and in y; an agent that is at most this far from a place is at the place
BETWEEN_SPOTS = 8  # RAM units between two spots
LASER_Y = 235
LABELLED_ROOMS = MEASURED["rooms"]  # by sub-goal
ENEMIES = [*MEASURED["enemies"].values()]
# For each room's laser gates, x of an agent left of the gate, and right of the gate.
GATES = {int(room): gates for room, gates in MEASURED["gates"].items()}
Places = tuple[Position, ...]


class Region(NamedTuple):
    """A rectangle of x and y in a room.

    With ``from_skull`` or ``from_spider``, x is counted from the x of the room's skull or spider.
    """

    room: int
    left: int
    right: int
    low: int
    high: int
    from_skull: bool = False
    from_spider: bool = False


def around(places: Iterable[Position], reach: int = REACH) -> Ints:
    """Return the regions within ``reach`` of m places, in x and in y, int64 (m, ``Region``)."""
    regions = [Region(room, x - reach, x + reach, y - reach, y + reach) for room, x, y in places]
    return np.array(regions)


def inside(regions: Ints, facts: NDArray[np.integer]) -> Bools:
    """Return whether agents, facts (n, ``FACTS``), are in regions (m, ``Region``), bool (n, m)."""
    room, left, right, low, high, *moving = regions.T
    enemy = facts[:, [SKULL, OBJECT]] @ np.stack(moving)
    x = facts[:, [X]] - enemy
    y = facts[:, [Y]]
    in_room = facts[:, [ROOM]] == room
    in_width = (left <= x) & (x <= right)
    in_height = (low <= y) & (y <= high)
    return in_room & in_width & in_height


@dataclass(frozen=True)
class SubGoal:
    """A sub-goal, which holds for a living agent in one of its regions.

    Attributes:
        places: one place in each region. Distances are to the nearest place.
        regions: int64 (m, ``Region``).
        spots: places where the expert is placed, and to which it heads. A spot must be on ground or on a ladder, since
            an agent that is placed in the air falls. If the sub-goal holds only in the air, give the ground from which
            agents get there.
        sides: further places where the expert is placed.
        unclear: indices of places whose states are labelled nowhere.
    """

    name: str
    places: Places
    regions: Ints
    spots: Places
    sides: Places = ()
    unclear: Collection[int] = ()

    def at(self, facts: NDArray[np.integer]) -> Ints:
        """Return the index of the place at which each agent is, dead or alive, or -1 for none, int64 (n,).

        ``facts`` are (n, ``FACTS``).
        """
        is_inside = inside(self.regions, facts)
        return np.where(is_inside.any(1), is_inside.argmax(1), -1)


def judge_sub_goals(facts: NDArray[np.integer], sub_goals: Iterable[SubGoal]) -> Bools:
    """Return whether each sub-goal holds, bool (n, G), by facts (n, ``FACTS``)."""
    reached = [sub_goal.at(facts) >= 0 for sub_goal in sub_goals]
    lives = facts[:, [DYING]] == 0
    return np.stack(reached, axis=1) & lives


def _climb(name: str, ends: Places, others: Places) -> SubGoal:
    """Return the sub-goal to be at an end of a ladder, one of ``ends``.

    An end that is among ``others``, the other ends of all ladders, is labelled nowhere.
    """
    unclear = {index for index, end in enumerate(ends) if end in others}
    return SubGoal(
        name,
        places=ends,
        regions=around(ends),
        spots=ends,
        sides=others,
        unclear=unclear,
    )


def _pass(side: str) -> SubGoal:
    """Return the sub-goal to be past an enemy, on a side of the enemy, on the enemy's floor."""
    places, spots, regions = [], [], []
    for enemy in ENEMIES:
        room, y = enemy["room"], enemy["y"]
        first, last = enemy["ends"]
        if side == "left":
            end = first
            left, right = -FAR, enemy["left"] - 1
        else:
            end = last
            left, right = enemy["right"] + 1, FAR
        byte = enemy.get("byte")
        region = Region(room, left, right, y - REACH, y + REACH, byte == "skull", byte == "object")
        regions.append(region)
        places.append(Position(room, end, y))
        spots += [Position(room, x, y) for x in range(first, last + 1, BETWEEN_SPOTS)]
    return SubGoal(
        f"pass-enemy-{side}",
        places=tuple(places),
        regions=np.array(regions),
        spots=tuple(spots),
    )


def _pass_lasers() -> SubGoal:
    """Return the sub-goal to stand left of a laser gate, as in the authors' data."""
    before, behind = [], []
    for room, gates in GATES.items():
        before += [Position(room, left, LASER_Y) for left, _ in gates]
        behind += [Position(room, right, LASER_Y) for _, right in gates]
    places = tuple(before)
    return SubGoal(
        "pass-lasers",
        places=places,
        regions=around(places),
        spots=places,
        sides=tuple(behind),
    )


CLIMB_DOWN = _climb("climb-down-ladder", BASES, TOPS)
CLIMB_UP = _climb("climb-up-ladder", TOPS, BASES)
ALL = (CLIMB_DOWN, CLIMB_UP, _pass("left"), _pass("right"), _pass_lasers())
SUB_GOALS = {sub_goal.name: sub_goal for sub_goal in ALL}
for _without in SUB_GOALS.keys() - LABELLED_ROOMS.keys():
    raise UserError("a sub-goal lacks its rooms", _without, f"Add [rooms.{_without}] to measured.toml.")
