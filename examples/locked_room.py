"""MiniGrid's LockedRoom, six doors by colour and a key: a policy for each sub-goal reaches what random play would not.

The paper's authors label these doors, too (``lockedroom_data_collector.py``).

    hypogoal collect locked_room:DOMAIN --out runs/locked/data.h5
    hypogoal train-ensemble runs/locked/data.h5 --out runs/locked/ensemble --trust
    hypogoal evaluate runs/locked --trust
"""

import gymnasium
from minigrid.core.constants import COLOR_NAMES, DIR_TO_VEC
from minigrid.wrappers import ImgObsWrapper, RGBImgObsWrapper

from hypogoal import GymnasiumDomain

LEFT, RIGHT, FORWARD, PICK_UP, TOGGLE = 0, 1, 2, 3, 5


def make() -> gymnasium.Env:
    """All of the grid, uint8 (76, 76, 3)."""
    env = gymnasium.make("MiniGrid-LockedRoom-v0", highlight=False)
    return ImgObsWrapper(RGBImgObsWrapper(env, tile_size=4))


def found(world, kind: str, colour: str | None = None):
    """Cell and place of the first such thing in the grid, or None."""
    cells = ((cell, (n % world.width, n // world.width)) for n, cell in enumerate(world.grid.grid) if cell)
    return next(((cell, at) for cell, at in cells if cell.type == kind and colour in (None, cell.color)), None)


def is_open(colour: str):
    """A label: whether the door of a colour is open."""
    return lambda env: found(env.unwrapped, "door", colour)[0].is_open


def holds_key(env) -> bool:
    return env.unwrapped.carrying is not None


def towards(world, target, at_target: int) -> int:
    """The next action on the shortest way to face a cell, through doors that are not locked; there ``at_target``."""
    begin = (*map(int, world.agent_pos), int(world.agent_dir))
    ways = {begin: at_target}  # by place and direction, the first action of the way there
    for x, y, turn in (queue := [begin]):
        ahead = (x + int(DIR_TO_VEC[turn][0]), y + int(DIR_TO_VEC[turn][1]))
        if ahead == target:
            return ways[x, y, turn]
        cell = world.grid.get(*ahead)
        closed = cell is not None and cell.type == "door" and not cell.is_open
        moves = {LEFT: (x, y, (turn - 1) % 4), RIGHT: (x, y, (turn + 1) % 4)}
        if cell is None or cell.can_overlap() or (closed and not cell.is_locked):
            moves[FORWARD] = (*ahead, turn)
        for action, place in moves.items():
            if place not in ways:
                first = TOGGLE if action == FORWARD and closed else action
                ways[place] = first if (x, y, turn) == begin else ways[x, y, turn]
                queue.append(place)
    return RIGHT


def reach(colour: str | None):
    """A policy that opens the door of a colour, with the key if it is locked; None: that takes the key."""

    def policy(env, observation, rng) -> int:
        world = env.unwrapped
        door, key = colour and found(world, "door", colour), found(world, "key")
        if key and not world.carrying and (not door or door[0].is_locked):
            return towards(world, key[1], PICK_UP)
        if door and not door[0].is_open:
            return towards(world, door[1], TOGGLE)
        return int(rng.choice([LEFT, RIGHT, FORWARD, FORWARD]))

    return policy


SUB_GOALS = {**{f"open-{colour}-door": is_open(colour) for colour in COLOR_NAMES}, "hold-key": holds_key}
POLICIES = {**{f"open-{colour}-door": reach(colour) for colour in COLOR_NAMES}, "hold-key": reach(None)}
DEFAULTS = {"train-options": {"option_timeout": 80}, "train-meta": {"option_timeout": 80}}
DOMAIN = GymnasiumDomain(make, SUB_GOALS, policy=POLICIES, defaults=DEFAULTS)
