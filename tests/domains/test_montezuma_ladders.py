"""Ladders: each is climbed down on the emulator, and distances are those of the shortest way (Spec B4, B5, F3)."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from hypogoal.domains.montezuma.emulator import (
    DOWN,
    FIRST_ROOM_OF_ROW,
    LEFT,
    RIGHT,
    ROOMS,
    Emulator,
    find_row,
)
from hypogoal.domains.montezuma.ladders import (
    BASES,
    LADDERS,
    ROOM_HEIGHT,
    ROOM_WIDTH,
    SHAFT_ENTRY,
    SHAFT_EXIT,
    distance_to,
    plane,
)

PHASES = range(2, 200, 34)  # six
WALLS = {(9, 10), (20, 21)}  # between rooms of a row
NAMES = [ladder.name for ladder in LADDERS]
SHAFTS = [ladder for ladder in LADDERS if ladder.top.room != ladder.base.room]


def distance_to_base(positions: NDArray[np.int64]) -> NDArray[np.int64]:
    return distance_to(positions, BASES)


def distance(*position: int) -> int:
    return int(distance_to_base(np.array([position]))[0])


@pytest.fixture(scope="module")
def emulator() -> Emulator:
    return Emulator()


@pytest.mark.atari
@pytest.mark.parametrize("name", NAMES)
def test_every_ladder_is_climbed_down(emulator: Emulator, name: str) -> None:
    """Spec B5: from the top to the base in ``steps_down`` of DOWN, on the ladder throughout, in 2 or more phases."""
    ladder = LADDERS[NAMES.index(name)]
    lived = 0
    for phase in PHASES:
        if emulator.place(*ladder.top, phase=phase) is None:
            continue
        assert emulator.position() == ladder.top
        there = []
        while emulator.alive() and len(there) < ladder.steps_down:
            emulator.step(DOWN)
            away = np.abs(np.array(emulator.position()) - np.array(ladder.base))
            there.append(bool(away[0] == 0 and away[1:].max() <= 2))
        if emulator.alive():
            lived += 1
            assert there == [False] * (ladder.steps_down - 1) + [True]
    assert lived >= 2


def crosses(emulator: Emulator, room: int, x: int, action: int) -> bool:
    """Whether the agent gets out of the room by walking from x at the upper floor, in one of a few phases."""
    for phase in PHASES[::2]:
        if emulator.place(room, x, 235, phase=phase, settle=2) is not None:
            for _ in range(12):
                emulator.step(action)
                if emulator.position().room != room:
                    return True
    return False


@pytest.mark.atari
def test_walls_are_where_they_are(emulator: Emulator) -> None:
    """Spec F3: no way through at ``WALLS``; from every other room of the pyramid's lower three rows one to the left."""
    for left in range(3, ROOMS - 1):
        if find_row(left) == find_row(left + 1):
            assert crosses(emulator, left + 1, 8, LEFT) == ((left, left + 1) not in WALLS), left
    for left, _ in WALLS:
        assert not crosses(emulator, left, 146, RIGHT)


def test_distances_worked_by_hand() -> None:
    """Spec F3: 0 at bases; within a room; down a shaft; through a neighbour; round a wall."""
    assert [distance(*ladder.base) for ladder in LADDERS] == [0] * 12
    assert distance(1, 21, 192) == 44  # the top of 1L: straight down
    assert distance(1, 133, 192) == 44
    assert distance(1, 77, 235) == 44  # the top of 1M: 43 down, 1 to the side
    assert distance(1, 21, 235) == 87
    # The top of 0-4, a base of none: 101 to the floor's hole, 1 into the next room, 19 down.
    assert distance(0, 77, 235) == distance(2, 77, 235) == distance(3, 77, 235) == 101 + 1 + 19
    assert distance(5, 77, 157) == 23 + 1 + 19
    assert distance(14, 77, 160) == 26 + 1 + 19
    assert distance(4, 77, 235) == 0  # the top of 4-10 is the base of 0-4
    assert distance(8, 77, 235) == distance(12, 77, 235) == distance(23, 77, 235) == ROOM_WIDTH  # one room aside
    assert distance(17, 77, 200) == 2 * ROOM_WIDTH + 35
    # The base in 21 is 77 away, but behind a wall: back to that in 19.
    assert distance(20, 149, 235) == 72 + ROOM_WIDTH
    assert distance(21, 5, 235) == 72
    assert distance_to_base(np.zeros((0, 3), np.int64)).shape == (0,)


def test_distances_are_those_of_the_shortest_way() -> None:
    """Spec F3: a wave that spreads from all bases over a map of the rooms, unit by unit, takes as long."""
    # The map: x to the right, y upwards; each room shows where one can go one unit on, to the right and upwards.
    corner = plane(np.array([(15, 0, SHAFT_EXIT)]))[0]
    columns = ROOMS - FIRST_ROOM_OF_ROW[-1]
    height = len(FIRST_ROOM_OF_ROW) * ROOM_HEIGHT
    room_at = np.full((columns * ROOM_WIDTH, height), -1)
    for room in range(ROOMS):
        x, y = plane(np.array([(room, 0, SHAFT_EXIT)]))[0] - corner
        room_at[x : x + ROOM_WIDTH, y : y + ROOM_HEIGHT] = room
    right = (room_at[1:] == room_at[:-1]) | ((room_at[1:] >= 0) & (room_at[1:] - room_at[:-1] == 1))
    for left, beyond in WALLS:
        right &= ~((room_at[:-1] == left) & (room_at[1:] == beyond))
    right &= (room_at[1:] >= 0) & (room_at[:-1] >= 0)
    up = (room_at[:, 1:] == room_at[:, :-1]) & (room_at[:, 1:] >= 0)
    for ladder in SHAFTS:
        x, y = plane(np.array([(ladder.top.room, ladder.top.x, SHAFT_EXIT)]))[0] - corner
        assert room_at[x, y] == ladder.top.room
        assert room_at[x, y - 1] == ladder.base.room
        up[x, y - 1] = True

    steps = np.full(room_at.shape, -1)
    bases = plane(np.array([ladder.base for ladder in LADDERS])) - corner
    steps[bases[:, 0], bases[:, 1]] = 0
    front, step = steps == 0, 0
    while front.any():
        step += 1
        spread = np.zeros_like(front)
        spread[1:] |= front[:-1] & right
        spread[:-1] |= front[1:] & right
        spread[:, 1:] |= front[:, :-1] & up
        spread[:, :-1] |= front[:, 1:] & up
        front = spread & (steps < 0)
        steps[front] = step
    assert (steps >= 0).sum() == (room_at >= 0).sum() == ROOMS * ROOM_WIDTH * ROOM_HEIGHT

    for room in range(ROOMS):
        x, y = np.meshgrid(np.arange(ROOM_WIDTH), np.arange(SHAFT_EXIT, SHAFT_ENTRY + 1), indexing="ij")
        positions = np.stack([np.full(x.size, room), x.ravel(), y.ravel()], axis=1)[::7]
        at = plane(positions) - corner
        assert np.array_equal(distance_to_base(positions), steps[at[:, 0], at[:, 1]]), room
