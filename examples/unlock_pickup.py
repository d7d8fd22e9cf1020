"""MiniGrid-UnlockPickup with two sub-goals, brought to hypogoal: see docs/own-domain.md."""

import gymnasium
from minigrid.wrappers import ImgObsWrapper, RGBImgObsWrapper

from hypogoal import GymnasiumDomain


def make() -> gymnasium.Env:
    """The whole grid as an image, uint8 (48, 88, 3)."""
    env = gymnasium.make("MiniGrid-UnlockPickup-v0", highlight=False)
    return ImgObsWrapper(RGBImgObsWrapper(env, tile_size=8))


def key_held(env: gymnasium.Env) -> bool:
    held = env.unwrapped.carrying
    return held is not None and held.type == "key"


def door_open(env: gymnasium.Env) -> bool:
    return any(cell is not None and cell.type == "door" and cell.is_open for cell in env.unwrapped.grid.grid)


def wander(env, observation, rng) -> int:
    """Random play that mostly walks and never drops anything: left, right, forward, pick up, toggle."""
    return rng.choice([0, 1, 2, 2, 2, 3, 5])


DOMAIN = GymnasiumDomain(make, {"hold-key": key_held, "open-door": door_open}, policy=wander)
