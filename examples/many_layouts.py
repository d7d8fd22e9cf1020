"""MiniGrid's DoorKey, options and agent trained over 1,000 layouts and tried on 100 others; labels are of ten.

Shows `layouts` and `evaluate --layouts`; about 40 minutes on a core. First `export HYPOGOAL_TRUST=many_layouts:DOMAIN`:

    hypogoal collect many_layouts:DOMAIN --out runs/many/data.h5
    hypogoal train-ensemble runs/many/data.h5 --out runs/many/ensemble
    hypogoal train-options runs/many/ensemble --out runs/many/options
    hypogoal train-meta runs/many/ensemble --options runs/many/options --out runs/many/meta
    hypogoal evaluate runs/many --layouts 5000-5099
    hypogoal report runs/many
"""

import gymnasium
from minigrid.core.world_object import Door, Goal, Key
from minigrid.wrappers import ImgObsWrapper, RGBImgObsWrapper

from hypogoal import GymnasiumDomain


def make() -> gymnasium.Env:
    """All of the grid, uint8 (48, 48, 3): one picture tells the layout, and that a key is held by its absence."""
    env = gymnasium.make("MiniGrid-DoorKey-6x6-v0", highlight=False)
    return ImgObsWrapper(RGBImgObsWrapper(env, tile_size=8))


def labels(env: gymnasium.Env) -> dict[str, bool]:
    world = env.unwrapped
    door_open = any(isinstance(thing, Door) and thing.is_open for thing in world.grid.grid)
    at_goal = isinstance(world.grid.get(*world.agent_pos), Goal)
    return {"hold-key": isinstance(world.carrying, Key), "open-door": door_open, "at-goal": at_goal}


def wander(env, observation, rng) -> int:
    return rng.choice([0, 1, 2, 2, 2, 3, 5])  # walks, picks up and opens, never drops


PLAY = {"layouts": "1000-1999", "max_episode_steps": 100, "replay": 50_000}
SEEDS = {"labelled_seeds": "0-9", "unlabelled_seeds": "10-29"}
DEFAULTS = {"collect": SEEDS, "train-options": PLAY, "train-meta": PLAY}
DOMAIN = GymnasiumDomain(make, ("hold-key", "open-door", "at-goal"), labels=labels, policy=wander, defaults=DEFAULTS)
