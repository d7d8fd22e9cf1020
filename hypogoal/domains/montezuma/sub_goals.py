"""The sub-goals on Montezuma's Revenge: where each holds, by the console's memory, and rooms that label it.

The paper has the first, ``CLIMB_DOWN``: the agent lives and is within ``REACH`` of a ladder's base, in x and in y. The
others are in its authors' repository (``monte_terminations.py``). One more is one more entry of ``ALL``, and its
rooms in ``measured.toml``, where enemies and lasers are, too. Where the authors' code differs is in docs/deviations.md.
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

REACH = 2  # at a place: at most this far from it, in x and in y
BETWEEN_SPOTS = 8  # RAM units
LASER_Y = 235
LABELLED_ROOMS = MEASURED["rooms"]  # by sub-goal
ENEMIES = [*MEASURED["enemies"].values()]
# By room, where an agent stands left of each laser gate, and right of it.
GATES = {int(room): gates for room, gates in MEASURED["gates"].items()}
Places = tuple[Position, ...]


class Region(NamedTuple):
    """Where agents are: in a room, within these x and y; x is counted from that of the room's skull or spider if so."""

    room: int
    left: int
    right: int
    low: int
    high: int
    from_skull: bool = False
    from_spider: bool = False


def around(places: Iterable[Position], reach: int = REACH) -> Ints:
    """The regions within ``reach`` of places, in x and in y, int64 (m, ``Region``)."""
    regions = [Region(room, x - reach, x + reach, y - reach, y + reach) for room, x, y in places]
    return np.array(regions)


def inside(regions: Ints, facts: NDArray[np.integer]) -> Bools:
    """Whether agents, facts (n, ``FACTS``), are in regions (m, ``Region``), bool (n, m)."""
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
    """A sub-goal: it holds for a living agent in one of its regions.

    Attributes:
        places: one in each region; distances are to the nearest.
        regions: int64 (m, ``Region``).
        spots: where the expert is placed and heads for. Something must be under its feet, or a ladder, since an agent
            that is placed in the air falls: where the sub-goal holds in the air only, give the ground from which agents
            get there.
        sides: where it is placed, too.
        unclear: indices of places whose states are labelled nowhere.
    """

    name: str
    places: Places
    regions: Ints
    spots: Places
    sides: Places = ()
    unclear: Collection[int] = ()

    def at(self, facts: NDArray[np.integer]) -> Ints:
        """The index of the place at which agents are, facts (n, ``FACTS``), dead or alive; -1 for none; int64 (n,)."""
        is_inside = inside(self.regions, facts)
        return np.where(is_inside.any(1), is_inside.argmax(1), -1)


def judge_sub_goals(facts: NDArray[np.integer], sub_goals: Iterable[SubGoal]) -> Bools:
    """Whether each sub-goal holds, bool (n, G), by facts (n, ``FACTS``)."""
    reached = [sub_goal.at(facts) >= 0 for sub_goal in sub_goals]
    lives = facts[:, [DYING]] == 0
    return np.stack(reached, axis=1) & lives


def _climb(name: str, ends: Places, others: Places) -> SubGoal:
    """Be at one end of a ladder; ends that are another ladder's other end are labelled nowhere."""
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
    """Be past an enemy on a side of it, on its floor."""
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
    """Stand left of a laser gate, as the authors' data do."""
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
