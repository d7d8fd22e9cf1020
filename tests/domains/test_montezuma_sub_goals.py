"""Sub-goals of Montezuma's Revenge beyond the paper's: labels are compared with what the emulator forces."""

import runpy
from collections.abc import Iterator
from types import SimpleNamespace

import numpy as np
import pytest

from hypogoal.core.errors import UserError
from hypogoal.domains.montezuma import sub_goals
from hypogoal.domains.montezuma.domain import DOMAIN, MontezumaConfig, choose_rooms
from hypogoal.domains.montezuma.emulator import DOWN, FACTS, LEFT, NOOP, ROOMS, SPRITE_TOP, UP, Emulator
from hypogoal.domains.montezuma.env import BEGINNINGS, arrives, make_starts
from hypogoal.domains.montezuma.ladders import BASES, LADDERS, TOPS, Ladder
from hypogoal.domains.montezuma.states import gather
from hypogoal.domains.montezuma.sub_goals import (
    CLIMB_DOWN,
    ENEMIES,
    GATES,
    LABELLED_ROOMS,
    LASER_Y,
    SUB_GOALS,
    judge_sub_goals,
)
from hypogoal.meta.nearness import distances_of

pytestmark = pytest.mark.atari

PHASES = range(2, 254, 42)  # six
LEFT_FIRE = 12
ENEMY = [SimpleNamespace(**{"byte": "", **enemy}) for enemy in ENEMIES]
MOVING = [enemy for enemy in ENEMY if enemy.byte]
CLIMBED_UP = [ladder for ladder in LADDERS if ladder.steps_up]


@pytest.fixture(scope="module")
def emulator() -> Emulator:
    return Emulator()


def holding(emulator: Emulator) -> set[str]:
    """The sub-goals that hold now, by the console's memory."""
    [labels] = judge_sub_goals(emulator.facts()[None], SUB_GOALS.values())
    return {name for name, holds in zip(SUB_GOALS, labels, strict=True) if holds}


def test_at_a_place() -> None:
    """Spec B4: within 2 in x and in y, in the place's own room; which place it is."""
    positions = [(1, 21, 148), (1, 23, 146), (1, 24, 148), (1, 21, 151), (2, 21, 148), (1, 77, 235), (6, 76, 237)]
    facts = np.zeros((len(positions), len(FACTS)), np.uint8)
    facts[:, :3] = positions
    at = CLIMB_DOWN.at(facts)
    names = [LADDERS[index].name if index >= 0 else "" for index in at]
    assert names == ["1L", "1L", "", "", "", "", "2-6"]
    assert CLIMB_DOWN.at(facts[:0]).shape == (0,) and CLIMB_DOWN.places == BASES


@pytest.mark.parametrize("ladder", CLIMBED_UP, ids=lambda ladder: ladder.name)
def test_every_ladder_is_climbed_up(emulator: Emulator, ladder: Ladder) -> None:
    """Climbing up holds at the end of the climb alone, in its last step first, and no longer two steps down again."""
    lived = 0
    for phase in PHASES:
        if emulator.place(*ladder.base, phase=phase) is None or emulator.position() != ladder.base:
            continue
        assert "climb-down-ladder" in holding(emulator)
        assert ("climb-up-ladder" in holding(emulator)) == (ladder.base in TOPS)
        held = []
        while emulator.alive() and len(held) < ladder.steps_up:
            emulator.step(UP)
            held.append("climb-up-ladder" in holding(emulator))
        if emulator.alive():
            lived += 1
            assert held[-1] and not any(held[2:-1])
            emulator.step(DOWN)
            emulator.step(DOWN)
            assert "climb-up-ladder" not in holding(emulator)
    assert lived >= 2


def moved(emulator: Emulator, enemy: SimpleNamespace) -> Iterator[tuple[int, int, int]]:
    """The byte of an enemy's x, and the first and last column of what moves on its floor, while the agent is aside."""
    aside = (21, 192) if enemy.room == 1 else (146, 235)
    assert emulator.place(enemy.room, *aside) is not None
    shots, at = [], []
    while len(shots) < 60 and emulator.alive():
        emulator.frames(NOOP, 4)
        shots.append(emulator.ale.getScreenRGB())
        at.append(emulator.read(enemy.byte))
    floor = SPRITE_TOP - enemy.y
    moving = (np.array(shots) != np.median(shots, axis=0)).any(3)[:, floor : floor + 17, 8:130].any(1)
    for byte, columns in zip(at, moving, strict=True):
        yield byte, *((np.flatnonzero(columns) + 8)[[0, -1]].tolist() if columns.any() else (0, 0))


@pytest.mark.parametrize("enemy", MOVING, ids=lambda enemy: str(enemy.room))
def test_an_enemy_is_drawn_where_its_byte_says(emulator: Emulator, enemy: SimpleNamespace) -> None:
    """The middle of what moves lies in the middle of the x at which an agent, drawn from x - 1 to x + 6, is past."""
    seen = [(byte, (first + last) / 2) for byte, first, last in moved(emulator, enemy) if last - first < 25 and last]
    assert len(seen) >= 20
    for byte, middle in seen:
        assert abs(middle - (byte + (enemy.left + enemy.right) / 2 + 2.5)) <= 5, (byte, middle)


@pytest.mark.parametrize("enemy", [enemy for enemy in ENEMY if not enemy.byte], ids=lambda enemy: str(enemy.room))
def test_snakes_kill_between_both_sides(emulator: Emulator, enemy: SimpleNamespace) -> None:
    """An agent lives where it is past a snake, and dies at some x in between."""
    lives = {x: emulator.place(enemy.room, x, enemy.y) is not None for x in range(enemy.ends[0], enemy.ends[1] + 1)}
    between = [x for x in lives if enemy.left <= x <= enemy.right]
    for side, past in (("left", range(enemy.ends[0], enemy.left)), ("right", range(enemy.right + 1, enemy.right + 12))):
        for x in past:
            assert emulator.place(enemy.room, x, enemy.y) is not None, x
            assert f"pass-enemy-{side}" in holding(emulator)
    assert not all(lives[x] for x in between)
    assert emulator.place(enemy.room, enemy.right + 3, enemy.y) is not None
    while emulator.alive() and emulator.position().x > enemy.left:
        emulator.step(LEFT)
    assert not emulator.alive()


@pytest.mark.parametrize("room", sorted(GATES))
def test_lasers_kill_beside_the_places(emulator: Emulator, room: int) -> None:
    """Left of each gate an agent outlives a whole cycle of the lasers, and dies on its way into them when they burn."""
    for left, right in GATES[room]:
        for x in (left, right):
            assert emulator.place(room, x, LASER_Y, settle=40) is not None
            assert ("pass-lasers" in holding(emulator)) == any(x == first for first, _ in GATES[room])
        deaths = 0
        for phase in range(2, 150, 12):
            if emulator.place(room, right, LASER_Y, phase=phase, settle=1) is None:
                continue
            while emulator.alive() and emulator.position().x > left + 2:
                emulator.step(LEFT)
            deaths += not emulator.alive()
            if emulator.alive():
                emulator.step(NOOP)
                assert "pass-lasers" in holding(emulator)
        assert 1 <= deaths <= 12


@pytest.mark.parametrize("name", ["climb-up-ladder", "pass-enemy-left", "pass-lasers"])
def test_each_sub_goal_is_collected_alone(name: str) -> None:
    """A tenth of the labelled states or more are positive; unlabelled rooms have the sub-goal, or not."""
    goal = SUB_GOALS[name]
    labelled, unlabelled = choose_rooms(MontezumaConfig(sub_goals=(name,)))
    for room in labelled:
        assert 4 <= gather("labelled", room, 40, 3, [goal]).labels.sum() <= 30
    clear = {place.room for index, place in enumerate(goal.places) if index not in goal.unclear}
    others = {*range(ROOMS)} - clear
    for rooms, positive in ((sorted(clear)[-3:], True), (sorted(others)[-2:], False)):
        labels = [gather("heldout", room, 6, 3, [goal]).labels for room in rooms]
        assert any(map(np.any, labels)) == positive
    assert not {*unlabelled} & {*labelled}
    assert [room in {place.room for place in goal.places} for room in unlabelled] == [True, False]


@pytest.mark.parametrize("name", list(BEGINNINGS))
def test_every_beginning_has_start_states(name: str) -> None:
    """Alive where the beginning is, with a script that arrives; a new game is the game's, without a torch."""
    emulator, beginning = Emulator(), BEGINNINGS[name]
    for start in make_starts(emulator, name, 2, seed=0):
        emulator.restore(start)
        assert emulator.position() == beginning.at
        assert arrives(emulator, beginning)
        emulator.restore(start)
        assert (emulator.read("inventory") == 0) == (name == "game")


def test_distances_are_those_of_the_sub_goal() -> None:
    """0 where the sub-goal's own places are; the paper's distance for climbing down; none for unknown names."""
    base, top = np.array([LADDERS[0].base]), np.array([LADDERS[0].top])
    assert DOMAIN.distance_to("climb-down-ladder", base) == 0
    with pytest.raises(KeyError):
        DOMAIN.distance_to("mine", base)
    assert DOMAIN.distance_to("climb-up-ladder", top) == 0
    assert DOMAIN.distance_to("climb-up-ladder", base) == DOMAIN.distance_to("climb-down-ladder", top) == 44
    for name, goal in SUB_GOALS.items():
        assert not DOMAIN.distance_to(name, np.array(goal.places)).any()
    away = distances_of(DOMAIN, ["climb-down-ladder", "climb-up-ladder"], 2)  # options 0, 1 down, 2, 3 up
    assert away(np.repeat(top, 4, axis=0), np.arange(4)).tolist() == [44, 44, 0, 0]


def test_a_sub_goal_without_rooms_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whoever adds a sub-goal is told what ``measured.toml`` lacks."""
    monkeypatch.delitem(LABELLED_ROOMS, "pass-lasers")
    with pytest.raises(UserError, match=r"lacks its rooms: pass-lasers\. Add \[rooms\.pass-lasers\]"):
        runpy.run_path(sub_goals.__file__)
