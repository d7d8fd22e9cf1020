"""The sub-goals on Montezuma's Revenge (Spec I4): where each holds, by the console's memory, and rooms that label it.

The paper has the first, ``CLIMB_DOWN``: the agent lives and is within ``REACH`` of a ladder's base, in x and in y. The
others are in its authors' repository (``monte_terminations.py``). One more is one more entry of ``SUB_GOALS``. Where
enemies and lasers are is in ``measured.toml``; where the authors' code differs, in docs/deviations.md.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TypeAlias

import numpy as np

from hypogoal.core.arrays import Bools, Bytes, Ints
from hypogoal.domains.montezuma.emulator import RAM, Position
from hypogoal.domains.montezuma.ladders import BASES, MEASURED, REACH, TOPS, place_of

FACTS = ("room", "x", "y", "skull", "object")  # the bytes of ``RAM`` that predicates read
FACT_BYTES = [RAM[name] for name in FACTS]
ROOM, X, Y = range(3)
Places: TypeAlias = tuple[Position, ...]


@dataclass(frozen=True)
class SubGoal:
    """A sub-goal: it holds at ``places``, or beyond something that moves.

    Attributes:
        places: where it holds; the last of them, for enemies: distances are to the nearest.
        at: from facts (n, ``FACTS``) the index in ``places`` of the one at which it holds for a living agent, -1: none.
        groups, unlabelled, others: rooms, see ``measured.toml``.
        spots: where the expert begins and heads for.
        sides: where it begins, too.
        unclear: indices of places whose states are labelled nowhere.
    """

    name: str
    places: Places
    at: Callable[[Ints], Ints]
    groups: Sequence[Sequence[int]]
    unlabelled: Sequence[int]
    others: Sequence[int]
    spots: Places
    sides: Places = ()
    unclear: frozenset[int] = frozenset()


def facts_of(ram: Bytes) -> Ints:
    """The bytes that predicates read, int64 (n, ``FACTS``), from RAM (n, 128)."""
    return ram[:, FACT_BYTES].astype(np.int64)


def labels_of(facts: Ints, alive: Bools, sub_goals: Iterable[SubGoal]) -> Bools:
    """Spec B4: whether each sub-goal holds, bool (n, G), by facts (n, ``FACTS``) and whether the agent lives (n,)."""
    reached = [sub_goal.at(facts) >= 0 for sub_goal in sub_goals]
    return np.stack(reached, axis=1) & alive[:, None]


@dataclass(frozen=True)
class Enemy:
    """An enemy, the floor that it is on, and when an agent there counts as past it."""

    room: int
    y: int  # of an agent on that floor
    ends: tuple[int, int]  # x of an agent at the floor's left and right end
    left: int  # past it on the left: x below this, relative to the enemy's
    right: int  # past it on the right: x above this
    byte: str = ""  # the byte of the enemy's x; empty: it stays, and ``left`` and ``right`` are x themselves

    def beyond(self, side: str, facts: Ints) -> Bools:
        """Whether agents, facts (n, ``FACTS``), stand on its floor and are past it on a side, bool (n,)."""
        away = facts[:, X]
        if self.byte:
            away = away - facts[:, FACTS.index(self.byte)]
        past = away < self.left if side == "left" else away > self.right
        on_floor = np.abs(facts[:, Y] - self.y) <= REACH
        return (facts[:, ROOM] == self.room) & on_floor & past


ENEMIES = [Enemy(**enemy) for enemy in MEASURED["enemies"].values()]
BETWEEN_SPOTS = 8  # RAM units
# By room, where an agent stands left of each laser gate, and right of it.
GATES = {int(room): gates for room, gates in MEASURED["gates"].items()}
LASER_Y = 235


def _at(places: Places, facts: Ints) -> Ints:
    return place_of(facts[:, : len(Position._fields)], places)


def _past(side: str, facts: Ints) -> Ints:
    each = [enemy.beyond(side, facts) for enemy in ENEMIES]
    past = np.stack(each, axis=1)
    return np.where(past.any(1), past.argmax(1), -1)


def _climb(name: str, ends: Places, others: Places) -> SubGoal:
    """Be at one end of a ladder; ends that are another ladder's other end are labelled nowhere (Spec B5)."""
    unclear = frozenset(index for index, end in enumerate(ends) if end in others)
    return SubGoal(
        name,
        places=ends,
        at=partial(_at, ends),
        spots=ends,
        sides=others,
        unclear=unclear,
        **MEASURED["rooms"][name],
    )


def _pass(side: str) -> SubGoal:
    """Be past an enemy on a side of it, on its floor."""
    name = f"pass-enemy-{side}"
    places, spots = [], []
    for enemy in ENEMIES:
        first, last = enemy.ends
        places.append(Position(enemy.room, first if side == "left" else last, enemy.y))
        spots += [Position(enemy.room, x, enemy.y) for x in range(first, last + 1, BETWEEN_SPOTS)]
    return SubGoal(
        name,
        places=tuple(places),
        at=partial(_past, side),
        spots=tuple(spots),
        **MEASURED["rooms"][name],
    )


def _pass_lasers() -> SubGoal:
    """Stand left of a laser gate, as the authors' data do."""
    name = "pass-lasers"
    before, behind = [], []
    for room, gates in GATES.items():
        before += [Position(room, left, LASER_Y) for left, _ in gates]
        behind += [Position(room, right, LASER_Y) for _, right in gates]
    places = tuple(before)
    return SubGoal(
        name,
        places=places,
        at=partial(_at, places),
        spots=places,
        sides=tuple(behind),
        **MEASURED["rooms"][name],
    )


CLIMB_DOWN = _climb("climb-down-ladder", BASES, TOPS)
ALL = (
    CLIMB_DOWN,
    _climb("climb-up-ladder", TOPS, BASES),
    _pass("left"),
    _pass("right"),
    _pass_lasers(),
)
SUB_GOALS = {sub_goal.name: sub_goal for sub_goal in ALL}
CROSSINGS = {  # starts from which to pass an enemy or a laser gate
    "skull-right": Position(1, 133, 148),
    "skull-left": Position(1, 21, 148),
    "lasers": Position(0, 129, LASER_Y),
}
