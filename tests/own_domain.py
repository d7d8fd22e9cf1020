"""A domain that is not hypogoal's, as a user would bring it (Spec B6): one file behind the small interface."""

from typing import Any

import numpy as np
from corridor import LENGTH, Corridor

from hypogoal.core.config import Config, setting
from hypogoal.data import Collected, States
from hypogoal.domains.base import Domain


class TallCorridor(Corridor):
    """The corridor in images that the member network takes."""

    observation_shape = (64, 64, 3)


class CorridorConfig(Config):
    """What ``collect`` can be told."""

    copies: int = setting(8, "copies of each cell", low=1)


class CorridorDomain(Domain):
    """The corridor with its two ends as sub-goals."""

    name = "own_domain:DOMAIN"
    sub_goals = Corridor.sub_goals
    observation_shape = TallCorridor.observation_shape
    config_class = CorridorConfig

    def collect(self, config: CorridorConfig, seed: int, progress: Any) -> Collected:
        engine = TallCorridor(1)
        ids = np.tile(np.arange(LENGTH), config.copies)
        states = States(engine.images(ids), engine.labels(ids), {"cell": ids})
        return Collected(self.observation_shape, self.sub_goals, states, states, states)

    def make_engine(self, layout_seed: int, count: int, max_steps: int, **arguments: Any) -> TallCorridor:
        return TallCorridor(count, max_steps)


class OddCorridor(Corridor):
    """The corridor in images that are not made of whole cells of 8 pixels."""

    observation_shape = (20, 52, 3)


class OddDomain(CorridorDomain):
    """The corridor with these."""

    observation_shape = OddCorridor.observation_shape

    def make_engine(self, layout_seed: int, count: int, max_steps: int, **arguments: Any) -> OddCorridor:
        return OddCorridor(count, max_steps)


DOMAIN, ODD = CorridorDomain(), OddDomain()
