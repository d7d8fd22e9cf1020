"""The sub-goals on Montezuma's Revenge: where each holds, by the console's memory, and the rooms that label it.

The paper has the first; the others are in its authors' repository (``monte_terminations.py``). One more is one more
entry of ``SUB_GOALS``. Positions are measured, see docs/montezuma.md; tests repeat them.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from hypogoal.domains.montezuma.emulator import RAM, Position
from hypogoal.domains.montezuma.ladders import BASES, GROUPS, REACH, TOPS, place_of

FACTS = ("room", "x", "y", "skull", "object")  # the bytes of ``RAM`` that predicates read
FACT_BYTES = [RAM[name] for name in FACTS]
ROOM, X, Y = range(3)


@dataclass(frozen=True)
class SubGoal:
    """A sub-goal: it holds at ``places``, or beyond something that moves.

    Attributes:
        places: where it holds; the last of them, for enemies: distances are to the nearest.
        at: from facts (n, ``FACTS``) the index in ``places`` of the one at which it holds for a living agent, -1: none.
        groups: rooms that are labelled together.
        unlabelled, others: rooms to draw unlabelled states from, with and without such a place, the first choice first.
        spots: where the expert begins and heads for; empty: ``places``.
        sides: where it begins, too.
        unclear: indices of places whose states are labelled nowhere.
    """

    name: str
    places: tuple[Position, ...]
    at: Callable[[NDArray[np.int64]], NDArray[np.int64]]
    groups: tuple[tuple[int, ...], ...]
    unlabelled: tuple[int, ...]
    others: tuple[int, ...]
    spots: tuple[Position, ...] = ()
    sides: tuple[Position, ...] = ()
    unclear: frozenset[int] = frozenset()

    def holds(self, facts: NDArray[np.int64], alive: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Whether it holds, bool (n,), for facts (n, ``FACTS``) and whether the agent is alive (n,)."""
        return (self.at(facts) >= 0) & alive


@dataclass(frozen=True)
class Enemy:
    """An enemy, the floor that it is on, and when an agent there counts as past it."""

    room: int
    y: int  # of an agent on that floor
    ends: tuple[int, int]  # x of an agent at the floor's left and right end
    left: int  # past it on the left: x below this, relative to the enemy's
    right: int  # past it on the right: x above this
    fact: str = ""  # the byte of the enemy's x; empty: it stays, and ``left`` and ``right`` are x themselves

    def beyond(self, side: str, facts: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Whether agents, facts (n, ``FACTS``), stand on its floor and are past it on a side, bool (n,)."""
        away = facts[:, X] - (facts[:, FACTS.index(self.fact)] if self.fact else 0)
        near = (facts[:, ROOM] == self.room) & (np.abs(facts[:, Y] - self.y) <= REACH)
        return near & (away < self.left if side == "left" else away > self.right)


ENEMIES = (
    Enemy(1, 148, (21, 133), 27, 39, "skull"),  # rolls
    Enemy(2, 235, (8, 140), -6, 21, "object"),  # two skulls that dance, 15 apart
    Enemy(3, 235, (8, 140), -6, 21, "object"),
    Enemy(4, 235, (8, 140), 0, 0, "object"),  # a spider
    Enemy(13, 235, (8, 140), 0, 0, "object"),
    Enemy(21, 235, (8, 140), 0, 0, "object"),
    Enemy(9, 235, (5, 140), 11, 60),  # two snakes
    Enemy(11, 235, (8, 140), 35, 118),
    Enemy(22, 235, (8, 140), 25, 42),  # a snake
    Enemy(5, 198, (45, 109), 27, 39, "skull"),  # rolls
    Enemy(18, 235, (8, 140), -5, 7, "skull"),
)
BETWEEN_SPOTS = 8  # RAM units
# Where an agent stands between lasers, or before the first: left of each gate of one or two, and right of it.
GATES = {0: ((6, 25), (25, 55), (101, 129), (129, 146)), 12: ((27, 51), (51, 77), (77, 103), (103, 129))}
GATES[7] = GATES[0]
LASER_Y = 235


def _at(places: tuple[Position, ...], facts: NDArray[np.int64]) -> NDArray[np.int64]:
    return place_of(facts[:, [ROOM, X, Y]], places)


def _past(side: str, facts: NDArray[np.int64]) -> NDArray[np.int64]:
    past = np.stack([enemy.beyond(side, facts) for enemy in ENEMIES], axis=1)
    return np.where(past.any(1), past.argmax(1), -1)


def _climb(name: str, ends: Sequence[Position], others: Sequence[Position], unlabelled: tuple[int, ...]) -> SubGoal:
    """Be at one end of a ladder; ends that are another ladder's other end are labelled nowhere (Spec B5)."""
    places = tuple(ends)
    unclear = frozenset(index for index, end in enumerate(ends) if end in others)
    return SubGoal(
        name, places, partial(_at, places), GROUPS, unlabelled, (18, 12), sides=tuple(others), unclear=unclear
    )


def _pass(side: str) -> SubGoal:
    """Be past an enemy on a side of it, on its floor; groups by kind of enemy."""
    return SubGoal(
        f"pass-enemy-{side}",
        tuple(Position(enemy.room, enemy.ends[side == "right"], enemy.y) for enemy in ENEMIES),
        partial(_past, side),
        ((1,), (2, 3), (4, 13, 21), (9, 11, 22), (5, 18)),
        (11, 4, 2),
        (0, 12),
        spots=tuple(
            Position(enemy.room, x, enemy.y)
            for enemy in ENEMIES
            for x in range(enemy.ends[0], enemy.ends[1] + 1, BETWEEN_SPOTS)
        ),
    )


def _pass_lasers() -> SubGoal:
    """Stand left of a laser gate, as the authors' data do."""
    left, right = (
        tuple(Position(room, sides[index], LASER_Y) for room, gates in GATES.items() for sides in gates)
        for index in (0, 1)
    )
    return SubGoal("pass-lasers", left, partial(_at, left), ((0,), (7,), (12,)), (7, 12), (2, 18), sides=right)


CLIMB_DOWN = _climb("climb-down-ladder", BASES, TOPS, (9, 21, 19, 22, 10))
SUB_GOALS = {
    sub_goal.name: sub_goal
    for sub_goal in (
        CLIMB_DOWN,
        _climb("climb-up-ladder", TOPS, BASES, (3, 14, 5, 7, 2)),
        _pass("left"),
        _pass("right"),
        _pass_lasers(),
    )
}
CROSSINGS = {  # starts from which to pass an enemy or a laser gate
    "skull-right": Position(1, 133, 148),
    "skull-left": Position(1, 21, 148),
    "lasers": Position(0, 129, LASER_Y),
}
