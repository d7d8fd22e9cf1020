"""Three-key DoorKey: the Gymnasium environment, its sub-goals, and the collected states (Spec B1-B3)."""

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from minigrid.core.world_object import Key
from minigrid.envs import DoorKeyEnv as DoorKeyOfMiniGrid
from minigrid.wrappers import RGBImgObsWrapper

from hypogoal.core.progress import Progress
from hypogoal.data import Collected
from hypogoal.domains.doorkey.domain import DOMAIN, DoorKeyConfig, _make_grid
from hypogoal.domains.doorkey.env import SUB_GOALS, DoorKeyEnv, DoorKeyGrid, make_layout
from hypogoal.domains.doorkey.rules import DROP, FORWARD, LEFT, PICKUP, TOGGLE

SAME_GRID = (90, 103)  # layout seeds whose grids are the same


def collected(seed: int = 0, **settings: object) -> Collected:
    """Collect without a word."""
    config = DoorKeyConfig(**settings)  # type: ignore[arg-type]
    return DOMAIN.collect(config, seed, Progress("collect", 23, quiet=True))


@pytest.fixture
def corner() -> DoorKeyEnv:
    """The agent in a corner, facing right, no keys in the room, the locked red door three cells ahead."""
    env = DoorKeyEnv(layout_seed=0)
    env.reset()
    for cell in make_layout(0).keys:
        env.grid.set(cell % 8, cell // 8, None)
    door = make_layout(0).door
    env.grid.set(door % 8, door // 8, env.grid.get(0, 0))
    env.grid.set(4, 1, env.door)
    env.agent_pos, env.agent_dir = (1, 1), 0
    return env


def act(env: DoorKeyEnv, *actions: int) -> dict[str, bool]:
    """Play the actions; the labels after the last."""
    for action in actions:
        *_, info = env.step(action)
    return info["labels"]


@pytest.mark.parametrize("arguments", [{}, {"layout_seed": 3}, {"wrong_key": "ends", "max_steps": 20}])
def test_gymnasium_accepts_it(arguments: dict[str, object]) -> None:
    """Spec B1: registered, and Gymnasium's own checker has nothing to say (warnings are errors here)."""
    env = gymnasium.make(DOMAIN.env_id, **arguments)  # type: ignore[arg-type]
    assert env.observation_space == gymnasium.spaces.Box(0, 255, (64, 64, 3), np.uint8)
    assert env.action_space == gymnasium.spaces.Discrete(7)
    check_env(env.unwrapped, skip_render_check=True)


def test_layouts_follow_minigrids_order() -> None:
    """Spec B1: agent, door, goal and red key lie where MiniGrid's own DoorKey has them for the same seed."""
    stock = DoorKeyOfMiniGrid(size=8)
    for seed in range(40):
        stock.reset(seed=seed)
        cells = {thing.type: index for index, thing in enumerate(stock.grid.grid) if thing is not None}
        layout = make_layout(seed)
        assert (cells["door"], cells["goal"], cells["key"]) == (layout.door, layout.goal, layout.keys[2])
        assert (stock.agent_pos[0], stock.agent_pos[1]) == (layout.start % 8, layout.start // 8)
        assert stock.agent_dir == layout.direction
        assert all(cell % 8 < layout.door % 8 for cell in layout.keys)
        assert len({*layout.keys, layout.start}) == 4


def test_layout_seed_fixes_the_layout() -> None:
    """Spec B1: layout_seed=s is the layout of reset(seed=s), at every reset; without it layouts differ."""
    fixed, free = DoorKeyEnv(layout_seed=5), DoorKeyEnv()
    expected, _ = free.reset(seed=5)
    for seed in (None, 1, 2):
        assert np.array_equal(fixed.reset(seed=seed)[0], expected)
    assert not np.array_equal(free.reset()[0], expected)


def test_observation_is_minigrids_full_image() -> None:
    """Spec B1: the image of RGBImgObsWrapper at tile size 8, view cone not tinted, door and keys included."""
    plain, wrapped = DoorKeyEnv(layout_seed=2), RGBImgObsWrapper(DoorKeyGrid(layout_seed=2), tile_size=8)
    image, reference = plain.reset()[0], wrapped.reset()[0]["image"]
    for action in np.random.default_rng(0).integers(7, size=40).tolist():
        assert image.dtype == np.uint8
        assert np.array_equal(image, reference)
        image, reference = plain.step(action)[0], wrapped.step(action)[0]["image"]


def test_rewards_and_ends(corner: DoorKeyEnv) -> None:
    """Spec B1: 1 at the goal whatever the time, 0 elsewhere; truncated at max_steps."""
    assert corner.step(LEFT)[1:4] == (0.0, False, False)
    corner.step_count = 400
    corner.agent_pos, corner.agent_dir = (5, 6), 0
    assert corner.step(FORWARD)[1:4] == (1.0, True, False)
    short = DoorKeyEnv(layout_seed=0, max_steps=2)
    short.reset()
    assert short.step(LEFT)[3] is False
    assert short.step(LEFT)[3] is True


def test_key_ring(corner: DoorKeyEnv) -> None:
    """Spec B1: keys go onto a ring, drop gives back the last one, and only onto an empty cell."""
    for colour in ("green", "red", "blue"):
        corner.grid.set(2, 1, Key(colour))
        act(corner, PICKUP)
    assert list(corner.held) == ["green", "red", "blue"]
    labels = act(corner, DROP)
    assert getattr(corner.grid.get(2, 1), "color", None) == "blue"
    assert list(labels.values()) == [False, True, True, False, False]
    act(corner, DROP)  # the blue key lies there
    assert list(corner.held) == ["green", "red"]
    act(corner, PICKUP, LEFT, DROP)  # a wall is ahead
    assert list(corner.held) == ["green", "red", "blue"]


def test_any_held_key_opens_and_nothing_locks_again(corner: DoorKeyEnv) -> None:
    """Spec B1, B2: the red key under another one opens; an open door closes and opens without any key."""
    corner.ring = [Key("red"), Key("green")]
    corner.agent_pos = (3, 1)
    assert act(corner, TOGGLE)["open-red-door"]
    assert not act(corner, TOGGLE)["open-red-door"]
    corner.ring = []
    assert act(corner, TOGGLE)["open-red-door"]
    locked = DoorKeyEnv(layout_seed=0)
    locked.reset()
    locked.ring = [Key("blue"), Key("green")]
    locked.agent_pos, locked.agent_dir = ((make_layout(0).door % 8) - 1, make_layout(0).door // 8), 0
    assert not act(locked, TOGGLE)["open-red-door"]


def test_two_definitions_of_the_open_door(corner: DoorKeyEnv) -> None:
    """Spec B2: 'open' holds anywhere; 'in-front' only next to the door and facing it, from either side."""
    corner.ring = [Key("red")]
    corner.agent_pos = (3, 1)
    act(corner, TOGGLE)
    for position, direction, in_front in (((3, 1), 0, True), ((5, 1), 2, True), ((3, 1), 1, False), ((2, 1), 0, False)):
        corner.agent_pos, corner.agent_dir = position, direction
        for label, expected in (("open", True), ("in-front", in_front)):
            corner.door_label = label
            assert corner.unwrapped.labels()[3] == expected


@pytest.fixture(scope="module")
def fixed() -> Collected:
    """By the defaults."""
    return collected()


def test_fixed_collection(fixed: Collected) -> None:
    """Spec B3: each image of seed 0 once, unlabelled of seeds 1 and 2, 20 held-out layouts."""
    data = fixed
    assert data.sub_goals == SUB_GOALS
    assert len(data.labelled.observations) == len({image.tobytes() for image in data.labelled.observations}) == 1640
    assert set(data.unlabelled.origins["layout_seed"]) == {1, 2}
    assert len(set(data.heldout.origins["layout_seed"])) == 20
    for states in (data.labelled, data.unlabelled, data.heldout):
        count = len(states.observations)
        assert states.observations.shape == (count, 64, 64, 3)
        assert states.labels.shape == (count, 5)
        assert states.labels.sum(axis=0).min() > 0
        origins = states.origins
        assert all(len(values) == count for values in origins.values())
        held = origins["keys_held"][:, None] >> np.arange(3) & 1
        assert np.array_equal(states.labels[:, :3], held.astype(bool))
        assert np.array_equal(states.labels[:, 3], origins["door_state"] == 0)
        assert np.array_equal(states.labels[:, 4], (origins["agent_x"] == 6) & (origins["agent_y"] == 6))


def test_origins_say_where_the_agent_is(fixed: Collected) -> None:
    """Spec B3: putting MiniGrid's agent and door where the origin says draws the collected image."""
    data = fixed.labelled
    env = DoorKeyEnv(layout_seed=0)
    for index in np.random.default_rng(0).integers(len(data.labels), size=30):
        env.reset()
        origin = {name: int(values[index]) for name, values in data.origins.items()}
        env.agent_pos, env.agent_dir = (origin["agent_x"], origin["agent_y"]), origin["direction"]
        env.door.is_open, env.door.is_locked = origin["door_state"] == 0, origin["door_state"] == 2
        for bit, cell in enumerate(make_layout(0).keys):
            if origin["keys_held"] >> bit & 1:
                env.grid.set(cell % 8, cell // 8, None)
        assert np.array_equal(env.gen_obs(), data.observations[index])


def test_held_out_layouts_are_new() -> None:
    """Spec B3: a seed that trains, or whose grid is a training layout's, or came before, is passed over."""
    near = collected(heldout_first=0, heldout_layouts=3)
    assert sorted(set(near.heldout.origins["layout_seed"])) == [3, 4, 5]
    first, twin = SAME_GRID
    assert _make_grid(first) == _make_grid(twin)
    for settings in ({"labelled_seed": first}, {"unlabelled_seeds": (first,)}):
        data = collected(heldout_first=twin, heldout_layouts=1, **settings)
        assert set(data.heldout.origins["layout_seed"]) == {twin + 1}
    spread = collected(heldout_first=first, heldout_layouts=twin - first + 1)
    seeds = set(spread.heldout.origins["layout_seed"])
    assert first in seeds
    assert twin not in seeds
    assert len(seeds) == twin - first + 1
