"""The emulator: what is seen is Gymnasium's, states are exact, RAM means what its names say (Spec B4, B5)."""

from __future__ import annotations

import sys

import ale_py
import gymnasium
import numpy as np
import pytest
from gymnasium.wrappers import AtariPreprocessing, FrameStackObservation
from numpy.typing import NDArray

from hypogoal.core.errors import UserError
from hypogoal.domains.montezuma.emulator import (
    DOWN,
    FIRE,
    LEFT,
    N_ACTIONS,
    NOOP,
    OBSERVATION_SHAPE,
    ON_LADDER,
    RIGHT,
    ROOMS,
    STACK,
    TORCH,
    Emulator,
    Position,
    Snapshot,
    find_row,
)

pytestmark = pytest.mark.atari

TOP_1L, TOP_1M = Position(1, 21, 192), Position(1, 77, 235)


@pytest.fixture(scope="module")
def emulator() -> Emulator:
    return Emulator()


@pytest.fixture(scope="module")
def another() -> Emulator:
    return Emulator()


def clumsy(seed: int, count: int, repeat: int = 3) -> NDArray[np.int64]:
    """Random actions, each a few times, with a bias to walk off to the right: all lives are lost in 300 steps."""
    rng = np.random.default_rng(seed)
    drawn = np.where(rng.random(count) < 0.3, RIGHT, rng.integers(N_ACTIONS, size=count))
    return np.repeat(drawn, repeat)[:count]


def placed(emulator: Emulator, where: Position, phase: int = 10) -> Snapshot:
    """The agent at a place where it lives."""
    snapshot = emulator.place(*where, phase=phase)
    assert snapshot is not None
    assert emulator.position() == where
    return snapshot


def gymnasiums() -> FrameStackObservation:
    """Gymnasium's own wrappers, as the paper's state is usually made."""
    gymnasium.register_envs(ale_py)
    env = gymnasium.make("ALE/MontezumaRevenge-v5", frameskip=1, repeat_action_probability=0.0)
    return FrameStackObservation(AtariPreprocessing(env, noop_max=0, frame_skip=4, screen_size=84), 4)


def test_what_is_seen_is_gymnasiums(emulator: Emulator) -> None:
    """Spec B4: pixels and rewards of two whole games, all lives lost, up to the step that ends the game."""
    env = gymnasiums()
    assert env.unwrapped.ale.getLegalActionSet() == emulator.actions  # type: ignore[attr-defined]
    assert env.action_space == gymnasium.spaces.Discrete(N_ACTIONS)
    for seed in (0, 1):
        env.reset(seed=seed)
        emulator.ale.reset_game()
        steps = deaths = dying = 0
        for action in clumsy(seed, 600).tolist():
            image, reward, terminated, _, _ = env.step(action)
            earned = emulator.step(action)
            steps += 1
            if terminated:
                break
            assert earned == reward
            if steps >= STACK:
                assert emulator.stack.shape == OBSERVATION_SHAPE
                assert np.array_equal(emulator.stack, np.moveaxis(image, 0, -1))
            deaths += not dying and not emulator.alive()
            dying = emulator.read("dying")
        assert terminated
        assert deaths == 6
        assert steps > 150


def traced(emulator: Emulator, action: int, steps: int, *names: str) -> list[list[int]]:
    """The named bytes of RAM after each of some steps of one action."""
    rows = []
    for _ in range(steps):
        emulator.step(action)
        rows.append([emulator.read(name) for name in names])
    return rows


def test_ram_says_where_the_agent_is_and_how(emulator: Emulator) -> None:
    """Spec B4: walking right moves x, climbing moves y and has a pose, a jump counts down, standing is idle."""
    saved = placed(emulator, TOP_1L)
    assert (emulator.read("pose"), emulator.read("jump"), emulator.read("fall")) == (8, 255, 0)
    climbed = traced(emulator, DOWN, 9, "pose", "room", "x", "y")
    assert all(row[:3] == [ON_LADDER, 1, 21] for row in climbed)
    heights = [row[3] for row in climbed]
    assert heights == sorted(heights, reverse=True)
    assert heights[-1] == 148
    emulator.restore(saved)
    jumped = traced(emulator, FIRE, 8, "jump", "y", "pose", "fall")
    counters = [row[0] for row in jumped[:4]]
    assert counters == sorted(counters, reverse=True)
    assert counters[0] < 20
    assert max(row[1] for row in jumped) > 192
    assert all(row[2] == 6 and row[3] == 0 for row in jumped[:4])
    assert jumped[-1] == [255, 192, 8, 0]
    placed(emulator, TOP_1M)
    assert traced(emulator, RIGHT, 2, "pose", "x", "y") == [[18, 81, 235], [18, 85, 235]]


def test_ram_says_when_the_agent_dies(emulator: Emulator) -> None:
    """Spec B4: off the ledge it falls, the fall is counted, the death counts down and has taken a life."""
    placed(emulator, TOP_1M)
    lives = emulator.read("lives")
    assert emulator.ale.lives() == lives + 1 == 6
    rows = traced(emulator, LEFT, 21, "fall", "dying", "lives")
    assert emulator.alive()
    falling = [row[0] for row in rows if row[0]]
    assert falling == sorted(falling)
    assert len(falling) == 5
    dying = [row[1] for row in rows if row[1]]
    assert dying == list(range(12, 0, -1))
    assert rows[-1] == [0, 0, lives - 1]
    assert all(row[2] == lives - 1 for row in rows if row[1])


@pytest.mark.parametrize("room", range(ROOMS))
def test_the_agent_can_be_put_into_every_room(emulator: Emulator, another: Emulator, room: int) -> None:
    """Spec B5: with the torch, alive, in the row of the pyramid that the room is in, drawn; always the same."""
    places = [(x, phase) for phase in (2, 60, 120) for x in (77, 20, 130)]
    for x, phase in places:
        snapshot = emulator.place(room, x, 235, phase=phase)
        if snapshot is not None:
            break
    assert snapshot is not None
    assert emulator.position().room == room
    assert emulator.alive()
    assert emulator.read("inventory") & TORCH
    assert emulator.read("row") == find_row(room)
    lit = (emulator.ale.getScreenRGB().max(axis=2) > 0).mean()
    assert lit > 0.15
    if room >= 16:  # dark without the torch
        emulator.write("inventory", emulator.read("inventory") & ~TORCH)
        emulator.step(NOOP)
        assert (emulator.ale.getScreenRGB().max(axis=2) > 0).mean() < lit - 0.05
    again = another.place(room, x, 235, phase=phase)
    assert again is not None
    assert np.array_equal(again.seen, snapshot.seen)


def test_what_is_missing_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    """Spec G2: no emulator or no OpenCV gives one line with what to do."""
    for module in ("cv2", "ale_py"):
        with monkeypatch.context() as patched:
            patched.setitem(sys.modules, module, None)
            with pytest.raises(UserError, match=r"cannot be played .*pip install 'hypogoal\[montezuma\]'") as error:
                Emulator()
            assert "\n" not in str(error.value)
