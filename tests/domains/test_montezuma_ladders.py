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
    UP,
    Emulator,
    Position,
    row_of,
)
from hypogoal.domains.montezuma.ladders import (
    GROUPS,
    LADDERS,
    ROOM_HEIGHT,
    ROOM_WIDTH,
    SHAFT_ENTRY,
    SHAFT_EXIT,
    WALLS,
    at_base,
    distance_to_base,
    ladders_of,
    plane,
)

PHASES = range(2, 200, 17)  # twelve
NAMES = [ladder.name for ladder in LADDERS]
SHAFTS = [ladder for ladder in LADDERS if ladder.top.room != ladder.base.room]


def base(*position: int) -> bool:
    return bool(at_base(np.array([position]))[0])


def distance(*position: int) -> int:
    return int(distance_to_base(np.array([position]))[0])


def in_rooms(count: int, seed: int) -> NDArray[np.int64]:
    """Random positions between the sides, the floor's hole and the ceiling's of random rooms, (n, 3)."""
    rng = np.random.default_rng(seed)
    low, high = (0, 2, SHAFT_EXIT + 1), (ROOMS, ROOM_WIDTH, SHAFT_ENTRY)
    return rng.integers(low, high, size=(count, 3))


@pytest.fixture(scope="module")
def emulator() -> Emulator:
    playing = Emulator()
    playing.screens = False
    return playing


@pytest.mark.atari
@pytest.mark.parametrize("name", NAMES)
def test_every_ladder_is_climbed_down(emulator: Emulator, name: str) -> None:
    """Spec B5: from the top to the base in ``steps_down`` of DOWN, on the ladder throughout, in 4 or more phases."""
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
            assert base(*emulator.position())
    assert lived >= 4


@pytest.mark.atari
def test_to_the_next_room_it_is_one_unit(emulator: Emulator) -> None:
    """Spec F3: walking or climbing into the neighbour room, each frame is one unit in the plane of the rooms."""
    for room, x, y, action in ((5, 146, 235, RIGHT), (7, 77, 140, DOWN), (13, 77, 250, UP)):
        assert any(emulator.place(room, x, y, phase=phase, settle=2) for phase in PHASES)
        seen = [emulator.position()]
        while len(seen) < 20:
            emulator.frames(action, 1)
            position = emulator.position()
            # One frame has the new room's number and the old one's coordinates.
            if position.room == seen[-1].room or position[1:] != seen[-1][1:]:
                seen.append(position)
        assert len({position.room for position in seen}) == 2
        steps = np.abs(np.diff(plane(np.array(seen)), axis=0)).sum(1)
        assert steps.sum() > 10
        assert steps.max() == 1


def crosses(emulator: Emulator, room: int, x: int, action: int) -> bool:
    """Whether the agent gets out of the room by walking from x at the upper floor, in one of a few phases."""
    for phase in PHASES[::4]:
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
        if row_of(left) == row_of(left + 1):
            assert crosses(emulator, left + 1, 8, LEFT) == ((left, left + 1) not in WALLS), left
    for left, _ in WALLS:
        assert not crosses(emulator, left, 146, RIGHT)


def test_the_table_of_ladders() -> None:
    """Spec B5: twelve ladders; the groups' rooms; bases with a label only in rooms 1, 6, 9, 10, 19, 21 and 22."""
    assert len(LADDERS) == len(set(NAMES)) == 12
    assert GROUPS[0] == (1,)
    assert len({room for group in GROUPS for room in group}) == sum(map(len, GROUPS))
    grouped = {room for group in GROUPS for room in group}
    assert {room for ladder in LADDERS for room in (ladder.top.room, ladder.base.room)} == grouped
    assert {ladder.base.room for ladder in LADDERS if not ladder.runs_on} == {1, 6, 9, 10, 19, 21, 22}
    tops = [ladder.top for ladder in LADDERS]
    assert [ladder.name for ladder in LADDERS if ladder.base in tops] == ["0-4", "5-11", "7-13"]
    assert all(ladder.runs_on == (ladder.base in tops) for ladder in LADDERS)


def test_at_a_base() -> None:
    """Spec B4: within 2 in x and in y, in the base's own room; which base it is."""
    assert base(1, 21, 148)
    assert base(1, 23, 146)
    assert not base(1, 24, 148)
    assert not base(1, 21, 151)
    assert not base(2, 21, 148)
    assert not base(1, 77, 235)  # the top of 1M, where other rooms have their bases
    assert base(6, 77, 235)
    positions = np.array([(4, 77, 235), (6, 76, 237)])
    assert at_base(positions).tolist() == [True, True]
    assert [LADDERS[index].name for index in ladders_of(positions)] == ["0-4", "2-6"]
    assert ladders_of(np.array([(2, 21, 148)])).tolist() == [-1]
    assert at_base(positions.astype(np.uint8)).tolist() == [True, True]
    assert at_base(np.zeros((0, 3), np.int64)).shape == (0,)


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


def test_a_step_changes_the_distance_by_one_at_most() -> None:
    """Spec F3: one unit to any side within a room."""
    here = in_rooms(2000, seed=0)
    for side in ((0, 1, 0), (0, 0, 1)):
        there = here + np.array(side)
        assert np.abs(distance_to_base(there) - distance_to_base(here)).max() <= 1
    assert (distance_to_base(here) > 0).mean() > 0.99


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


def test_the_plane_of_the_rooms() -> None:
    """Spec F3: neighbours lie side by side, and the room under a shaft lies under it."""
    for ladder in SHAFTS:
        above, below = plane(np.array([(*ladder.top[:1], 77, SHAFT_EXIT), (*ladder.base[:1], 77, SHAFT_ENTRY)]))
        assert (above - below).tolist() == [0, 1]
    for room in range(1, ROOMS):
        if row_of(room) == row_of(room - 1):
            left, right = plane(np.array([Position(room - 1, 149, 200), Position(room, 1, 200)]))
            assert (right - left).tolist() == [1, 0]
