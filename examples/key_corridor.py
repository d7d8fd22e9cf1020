"""MiniGrid's KeyCorridor at 8 pixels a tile, where random play never gets to the ball: recorded play shows a way to it.

Shows `collect --play`, members that are right on new layouts, and an agent that learns to fetch the ball every time
(layout 101, one seed). Three minutes of a core. First `export HYPOGOAL_TRUST=key_corridor:DOMAIN`:

    hypogoal collect key_corridor:DOMAIN --play key_corridor.json --out runs/corridor/data.h5
    hypogoal train-ensemble runs/corridor/data.h5 --out runs/corridor/ensemble
    hypogoal train-meta runs/corridor/ensemble --out runs/corridor/meta
    hypogoal evaluate runs/corridor
    hypogoal report runs/corridor
"""

import gymnasium
from minigrid.core.world_object import Ball, Key
from minigrid.wrappers import ImgObsWrapper, RGBImgObsWrapper

from hypogoal import GymnasiumDomain


def make() -> gymnasium.Env:
    """All of the grid, uint8 (40, 56, 3)."""
    env = gymnasium.make("MiniGrid-KeyCorridorS3R2-v0", highlight=False)
    return ImgObsWrapper(RGBImgObsWrapper(env, tile_size=8))


def labels(env: gymnasium.Env) -> dict[str, bool]:
    """The ball lies behind the locked door, and who holds the key cannot take it."""
    held = env.unwrapped.carrying
    opened = any(room.locked and room.doors[2].is_open for row in env.unwrapped.room_grid for room in row)
    told = {"hold-key": isinstance(held, Key), "open-door": opened, "put-key-down": opened and held is None}
    return {**told, "hold-ball": isinstance(held, Ball)}


SEEDS = {"labelled_seeds": "0-39", "unlabelled_seeds": "40-54", "heldout_seeds": "1000-1009", "steps": 600}
MEMBERS = {"network": "tiles", "diversity": "none", "steps": 1500}
PLAY = {"option_timeout": 20, "max_episode_steps": 270, "epsilon_steps": 600, "layout_seed": 101}
AGENT = {**PLAY, "steps": 100_000, "decisions": 256}
DEFAULTS = {"collect": SEEDS, "train-ensemble": MEMBERS, "train-options": PLAY, "train-meta": AGENT}
NAMES = ("hold-key", "open-door", "put-key-down", "hold-ball")
DOMAIN = GymnasiumDomain(make, NAMES, labels=labels, defaults=DEFAULTS)
