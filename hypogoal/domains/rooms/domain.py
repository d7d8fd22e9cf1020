"""The domain of rooms, one of which has the feature that is rewarded.

An agent stands before some rooms and enters one of them. In the labelled states several features agree, so only the
reward can tell which feature counts. That feature is ``truth``, a setting of the world in which an agent is trained.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np

from hypogoal.data import Collected, States
from hypogoal.domains.base import Domain
from hypogoal.domains.rooms.engine import RoomsConfig, RoomsEngine
from hypogoal.domains.rooms.states import MEANINGS, SIDE, Scenes, crossed_states, labelled_states, unlabelled_states

SUB_GOALS = ("right-room",)
HELDOUT = 20  # the number of layouts of held-out states

DEFAULTS = {
    "train-ensemble": {
        "network": "tiles",
        "steps": 600,
        "batch_size": 32,
    },
    "train-meta": {"network": "planned", "steps": 10_000},
}


class RoomsDomain(Domain[RoomsConfig]):
    """A domain in which one labelled context cannot say what the sub-goal is."""

    name = "rooms"
    sub_goals = SUB_GOALS
    config_class = RoomsConfig
    engine_settings = ("factors", "truth", "rooms")
    defaults = DEFAULTS
    observation_shape = (SIDE, SIDE, 3)

    def collect(self, config: RoomsConfig, seed: int, progress: Any) -> Collected:
        """Collect labelled, unlabelled and held-out states.

        The held-out states have every combination of features equally often. Their ``layout_seed`` parts them in 20.
        """
        names = config.factors
        true = names.index(config.truth)

        def states_of(scenes: Scenes) -> States:
            labels = scenes.factors[:, [true]]
            return States(scenes.observations, labels, {"layout_seed": np.arange(len(labels)) % HELDOUT})

        return Collected(
            self.observation_shape,
            SUB_GOALS,
            states_of(labelled_states(config.labelled, seed, names)),
            states_of(unlabelled_states(config.unlabelled, config.mix, seed, names)),
            states_of(crossed_states(HELDOUT * 4, seed, names)),
        )

    def task(self, world: Mapping[str, Any]) -> str:
        config = RoomsConfig(**world)
        others = [f"{name} ({MEANINGS[name]})" for name in config.factors if name != config.truth]
        also = f" The labels also fit {' and '.join(others)}, for which there is no reward." if others else ""
        return (
            f"Enter one of {config.rooms} rooms. Only the room where {MEANINGS[config.truth]} ({config.truth}) gives a "
            f"reward of 1.{also}"
        )

    def make_engine(self, layout_seed: int, count: int, max_steps: int = 1, **arguments: Any) -> RoomsEngine:
        return RoomsEngine(layout_seed, count, max_steps, RoomsConfig(**arguments))


DOMAIN = RoomsDomain()
