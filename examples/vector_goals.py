"""A room seen as numbers: options fetch a key and go to the exit, an agent chooses among them. 2 minutes, one core."""

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Dict, Discrete

from hypogoal import GymnasiumDomain


class KeyRoom(gymnasium.Env):
    """The seed says where the key lies; a reward of 1 for being at the exit with it."""

    observation_space = Dict(position=Box(0, 1, (2,)), key=Box(0, 1, (2,)), held=Discrete(2))
    action_space = Discrete(4)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.position, self.key, self.held = np.full(2, 0.5), self.np_random.uniform((0.05, 0.6), (0.4, 0.95)), 0
        return self.observe(), {}

    def step(self, action):
        self.position += 0.08 * np.array([(0, 1), (0, -1), (1, 0), (-1, 0)][action]) + self.np_random.normal(0, 0.01, 2)
        self.position = self.position.clip(0, 1)
        self.held |= int(np.abs(self.position - self.key).max() < 0.06)
        solved = self.held == 1 and at_exit(self)
        return self.observe(), float(solved), solved, False, {}

    def observe(self):
        return {"position": self.position, "key": self.key, "held": self.held}


def at_exit(env):
    return bool(env.unwrapped.position[0] > 0.8 and env.unwrapped.position[1] < 0.2)


PLAY = {"option_timeout": 20, "max_episode_steps": 200}
SUB_GOALS = {"key-held": lambda env: env.unwrapped.held == 1, "at-exit": at_exit}
DOMAIN = GymnasiumDomain(KeyRoom, SUB_GOALS, defaults={"train-options": PLAY, "train-meta": PLAY})
