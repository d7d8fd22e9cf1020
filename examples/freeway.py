"""Atari's Freeway, a chicken that crosses a road: a domain with sub-goals read from the game's memory.

Shows how any Atari game is brought; the wrappers need opencv: pip install 'hypogoal[montezuma]'. With the stages'
defaults about an hour of a core, reckoned from 3,000 steps of options.
"""

import ale_py
import gymnasium
import numpy as np
from gymnasium.wrappers import AtariPreprocessing, FrameStackObservation, TransformObservation

from hypogoal import GymnasiumDomain

Y = 14  # where in memory the chicken's height is, 6 at the start, 175 on the other side (Anand et al. 2019)
gymnasium.register_envs(ale_py)


def make() -> gymnasium.Env:
    """Four grey frames, uint8 (84, 84, 4), the oldest first."""
    env = AtariPreprocessing(gymnasium.make("ALE/Freeway-v5", frameskip=1), noop_max=0)
    space = gymnasium.spaces.Box(0, 255, (84, 84, 4), np.uint8)
    return TransformObservation(FrameStackObservation(env, 4), lambda frames: np.moveaxis(frames, 0, -1), space)


def height(env: gymnasium.Env) -> int:
    return int(env.unwrapped.ale.getRAM()[Y])


def mostly_up(env, observation, rng) -> int:
    return 1


SUB_GOALS = {"half-way": lambda env: 80 <= height(env) <= 100, "far-side": lambda env: height(env) > 140}
DOMAIN = GymnasiumDomain(make, SUB_GOALS, policy=mostly_up, defaults={"train-ensemble": {"network": "montezuma"}})
