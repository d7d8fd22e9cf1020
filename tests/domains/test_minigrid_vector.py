"""``make_vec`` shows to the pixel, and does to the number, what MiniGrid behind ``RGBImgObsWrapper`` does."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from minigrid.core.grid import Grid
from minigrid.core.world_object import Box, Goal, Key, Wall
from minigrid.wrappers import RGBImgObsWrapper

import hypogoal
from hypogoal.domains.minigrid_vector import make_vec, row_seen, rows_seen

KINDS = {  # and whether episodes end within the steps played here
    "Empty-5x5": True,
    "FourRooms": True,
    "DoorKey-6x6": True,
    "MultiRoom-N2-S4": True,
    "KeyCorridorS3R1": False,
    "LavaCrossingS9N2": True,
    "Dynamic-Obstacles-8x8": True,
    "ObstructedMaze-1Dlhb": False,
    "BlockedUnlockPickup": False,
    "MemoryS7": True,
    "PutNear-6x6-N2": True,
    "GoToDoor-5x5": True,
    "RedBlueDoors-6x6": True,
    "Playground": True,
}


def stock(
    env_id: str, count: int, tile_size: int = 8, mode: Any = AutoresetMode.NEXT_STEP, **given: Any
) -> SyncVectorEnv:
    """MiniGrid as it is, many."""

    def make() -> gymnasium.Env:
        return RGBImgObsWrapper(gymnasium.make(env_id, disable_env_checker=True, **given), tile_size)

    return SyncVectorEnv([make] * count, autoreset_mode=mode)


def assert_same(mine: Any, theirs: Any) -> None:
    """The same values of the same types in the same places."""
    assert type(mine) is type(theirs)
    if isinstance(mine, dict):
        assert mine.keys() == theirs.keys()
        for key in mine:
            assert_same(mine[key], theirs[key])
    elif isinstance(mine, tuple):
        assert len(mine) == len(theirs)
        for one, other in zip(mine, theirs, strict=True):
            assert_same(one, other)
    elif isinstance(mine, np.ndarray):
        assert mine.dtype == theirs.dtype
        if mine.dtype == object:  # the last observations of episodes
            assert_same(tuple(mine), tuple(theirs))
        else:
            np.testing.assert_array_equal(mine, theirs)
    else:
        assert mine == theirs


def busy(envs: SyncVectorEnv, rng: np.random.Generator) -> np.ndarray:
    """Random actions that like to use what is in front, so that doors open and things are carried."""
    actions = rng.integers(envs.single_action_space.n, size=envs.num_envs)  # type: ignore[attr-defined]
    for number, env in enumerate(envs.envs):
        inner: Any = env.unwrapped
        ahead = inner.grid.get(*inner.front_pos)
        if ahead is not None and ahead.type in ("key", "ball", "box", "door") and rng.random() < 0.5:
            actions[number] = rng.choice([2, 3, 5]) % envs.single_action_space.n  # type: ignore[attr-defined]
    return actions


def assert_plays_alike(
    mine: SyncVectorEnv, theirs: SyncVectorEnv, steps: int, *, rng: np.random.Generator, resets: bool = False
) -> int:
    """Play the same on both; how many episodes ended."""
    assert mine.observation_space == theirs.observation_space
    assert mine.action_space == theirs.action_space
    assert mine.metadata == theirs.metadata
    assert_same(mine.reset(seed=7), theirs.reset(seed=7))
    ended = 0
    for _ in range(steps):
        actions = busy(theirs, rng)
        step = mine.step(actions)
        assert_same(step, theirs.step(actions))
        over = step[2] | step[3]
        ended += int(over.sum())
        if resets and over.any():
            options = {"reset_mask": over}
            assert_same(mine.reset(options=options), theirs.reset(options=dict(options)))
            assert "reset_mask" in options
    return ended


@pytest.mark.parametrize("kind", KINDS)
def test_kinds(kind: str) -> None:
    """Images, directions, missions, rewards, ends and infos over a few hundred steps, the next episodes too."""
    env_id, rng = f"MiniGrid-{kind}-v0", np.random.default_rng(3)
    mine, theirs = make_vec(env_id, 3), stock(env_id, 3)
    assert (assert_plays_alike(mine, theirs, 120, rng=rng) > 0) == KINDS[kind]


@pytest.mark.parametrize("mode", AutoresetMode)
def test_autoreset_modes(mode: AutoresetMode) -> None:
    env_id, rng = "MiniGrid-GoToDoor-5x5-v0", np.random.default_rng(0)
    mine, theirs = make_vec(env_id, 4, autoreset_mode=mode), stock(env_id, 4, mode=mode)
    assert assert_plays_alike(mine, theirs, 60, rng=rng, resets=mode == AutoresetMode.DISABLED) > 20


@pytest.mark.parametrize(
    "given",
    [
        {"highlight": False},
        {"agent_view_size": 3},
        {"agent_view_size": 11},  # wider than the table of rows
        {"tile_size": 5},
        {"max_steps": 9},
        {"max_episode_steps": 9},  # a wrapper of Gymnasium's
    ],
    ids=str,
)
def test_arguments(given: dict[str, Any]) -> None:
    env_id, rng = "MiniGrid-MultiRoom-N2-S4-v0", np.random.default_rng(1)
    assert_plays_alike(make_vec(env_id, 2, **given), stock(env_id, 2, **given), 60, rng=rng)


def test_seeds() -> None:
    """One number begins a row of them; a list says each; none goes on with what is drawn."""
    mine = make_vec("MiniGrid-FourRooms-v0", 3)
    first, _ = mine.reset(seed=4)
    images = first["image"]
    assert len(np.unique(images, axis=0)) == 3
    np.testing.assert_array_equal(mine.reset(seed=[6, 4, 5])[0]["image"], images[[2, 0, 1]])
    np.testing.assert_array_equal(first["image"], images)  # a copy, which nobody draws over
    theirs = stock("MiniGrid-FourRooms-v0", 3)
    theirs.reset(seed=[6, 4, 5])
    assert_same(mine.reset(), theirs.reset())
    with pytest.raises(ValueError, match="3 environments"):
        mine.reset(seed=[1, 2])


def test_without_copies() -> None:
    """One array for all steps, drawn over."""
    mine = make_vec("MiniGrid-Empty-5x5-v0", 2, copy=False)
    first, _ = mine.reset(seed=0)
    before = first["image"].copy()
    after = mine.step(np.array([0, 1]))[0]
    assert after["image"] is first["image"]
    assert (after["image"] != before).any()


def test_things_changed_from_outside() -> None:
    """What a program puts into a grid, moves or opens is drawn, whoever did it."""
    mine, theirs = make_vec("MiniGrid-MultiRoom-N2-S4-v0", 1), stock("MiniGrid-MultiRoom-N2-S4-v0", 1)
    assert_same(mine.reset(seed=2), theirs.reset(seed=2))
    for envs in (mine, theirs):
        inner: Any = envs.envs[0].unwrapped
        doors = [thing for thing in inner.grid.grid if thing is not None and thing.type == "door"]
        doors[0].is_open = True
        inner.grid.set(0, 0, Key("red"))
        inner.grid.set(1, 0, Box("blue"))
    assert_same(mine.step([6]), theirs.step([6]))
    for envs in (mine, theirs):
        envs.envs[0].unwrapped.grid.get(0, 0).color = "green"  # type: ignore[attr-defined]
        envs.envs[0].unwrapped.grid.set(1, 0, Goal())  # type: ignore[attr-defined]
    assert_same(mine.step([6]), theirs.step([6]))


@pytest.mark.parametrize("size", [3, 7, 11])
def test_rows_seen(size: int) -> None:
    """What is seen among walls at random, row by row, against ``Grid.process_vis``."""
    rng, bits = np.random.default_rng(size), 1 << np.arange(size)
    for _ in range(30):
        clear = rng.random((size, size)) < 0.7  # by row, column
        grid = Grid(size, size)
        for row, column in np.argwhere(~clear).tolist():
            grid.set(column, row, Wall())
        lit, rows = np.array([1 << size // 2]), []
        for row in reversed(range(size)):
            both = row_seen(lit, (clear[row] @ bits)[None], size)
            if size < 10:
                assert both == rows_seen(size)[lit << size | clear[row] @ bits]
            rows.append((both & bits) != 0)
            lit = both >> size
        np.testing.assert_array_equal(rows[::-1], grid.process_vis((size // 2, size - 1)).T)


@pytest.mark.parametrize(
    ("env_id", "why"),
    [("CartPole-v1", "MiniGrid's environments only"), ("hypogoal/DoorKey-8x8-v0", "has its own gen_obs")],
)
def test_refused(env_id: str, why: str) -> None:
    with pytest.raises(hypogoal.UserError, match=why) as refused:
        hypogoal.make_vec(env_id, 2)
    assert env_id in str(refused.value)
    assert "\n" not in str(refused.value)


def test_an_ended_episode_waits_for_its_reset() -> None:
    mine = make_vec("MiniGrid-GoToDoor-5x5-v0", 2, autoreset_mode="Disabled")
    mine.reset(seed=0)
    mine.step([6, 0])
    with pytest.raises(ValueError, match="reset_mask"):
        mine.step([0, 0])
