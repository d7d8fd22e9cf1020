"""Exploration of the intra-option policies: when a random action is played in place of the policy's action."""

import numpy as np

from hypogoal.core.arrays import Doubles, Ints
from hypogoal.core.checkpoints import Resumable
from hypogoal.options.config import LearnerConfig

EXPONENT, LONGEST = 2.0, 10_000  # a random action lasts n steps with P(n) ~ n^-EXPONENT, at most LONGEST steps


class Exploration(Resumable):
    """Random actions in place of a policy's actions, in each of E environments.

    With ``independent`` exploration, a random action is played at each step with probability epsilon, for one step.
    With ``persistent`` exploration (epsilon-z-greedy exploration), a random action begins with probability epsilon and
    lasts n steps, but not beyond the end of its execution.

    Source: Dabney, Ostrovski and Barreto 2020, Temporally-Extended epsilon-Greedy Exploration.
    """

    CHANGING = ("kept", "left")  # not the generator, which its owner saves

    def __init__(
        self,
        config: LearnerConfig,
        environments: int,
        actions: int,
        rng: np.random.Generator,
    ):
        self.actions, self.rng = actions, rng
        self.persistent = config.exploration == "persistent"
        self.kept, self.left = np.zeros((2, environments), int)  # random actions, and how many more steps they last

    def mix(
        self,
        policy: Ints,
        epsilon: Doubles,
        age: Ints,
    ) -> Ints:
        """Return the actions to play, int64 (E,): the actions of ``policy`` (E,), or random actions.

        ``epsilon`` (E,) are the probabilities of exploration. ``age`` (E,) is the number of steps since each execution
        began.
        """
        count = len(policy)
        begins = self.rng.random(count) < epsilon
        drawn = self.rng.integers(self.actions, size=count)
        if not self.persistent:
            return np.where(begins, drawn, policy)
        self.left[age == 0] = 0
        begins &= self.left == 0
        lengths = np.minimum(self.rng.zipf(EXPONENT, size=count), LONGEST)
        self.kept[begins] = drawn[begins]
        self.left[begins] = lengths[begins]
        random = self.left > 0
        self.left[random] -= 1
        return np.where(random, self.kept, policy)
