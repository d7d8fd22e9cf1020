"""How the intra-option policies explore: when a random action is played in place of their own."""

import numpy as np

from hypogoal.core.arrays import Doubles, Ints
from hypogoal.core.checkpoints import Resumable
from hypogoal.options.config import LearnerConfig

EXPONENT, LONGEST = 2.0, 10_000  # of how long a random action lasts, P(n) ~ n^-2, at most so many steps


class Exploration(Resumable):
    """Random actions, of A, in place of a policy's own, for each of E environments.

    ``independent``: at each step with probability epsilon, one action for one step. ``persistent``: epsilon-z-greedy
    exploration; with probability epsilon a random action begins and lasts n steps, but not beyond its execution's end.

    Source: Dabney, Ostrovski and Barreto 2020, Temporally-Extended epsilon-Greedy Exploration.
    """

    CHANGING = ("kept", "left")  # the generator is its owner's

    def __init__(
        self,
        config: LearnerConfig,
        environments: int,
        actions: int,
        rng: np.random.Generator,
    ):
        self.actions, self.rng = actions, rng
        self.persistent = config.exploration == "persistent"
        self.kept, self.left = np.zeros((2, environments), int)  # random actions, and for how many steps these last

    def mix(
        self,
        policy: Ints,
        epsilon: Doubles,
        age: Ints,
    ) -> Ints:
        """Actions int64 (E,): the policy's (E,), or random ones, by ``epsilon`` (E,), ``age`` (E,) steps after
        executions began.
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
