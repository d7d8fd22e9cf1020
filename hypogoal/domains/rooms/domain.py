"""Rooms, one of which has the feature that is rewarded (Spec H1).

An agent stands before some rooms and enters one. In the labelled states several features agree, so only the reward can
tell which of them counts: ``truth`` of the world that an agent is trained in.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np

from hypogoal.core.seeding import rng_for
from hypogoal.data import Collected, States
from hypogoal.domains.base import Domain, Scene
from hypogoal.domains.rooms.engine import RoomsConfig, RoomsEngine
from hypogoal.domains.rooms.states import MEANINGS, SIDE, crossed_states, drawn, labelled_states, unlabelled_states

SUB_GOALS = ("right-room",)
HELDOUT = 20  # layouts of held-out states

DEFAULTS: Mapping[str, Mapping[str, Any]] = {
    "train-ensemble": {
        "network": "tiles",
        "schedule": "sequential",
        "diversity_weight": 0.03,
        "steps": 600,
        "batch_size": 32,
        "threshold": "unlabelled-split",
    },
    "train-meta": {"network": "planned", "steps": 10_000},
}


class RoomsDomain(Domain):
    """Spec H1: a domain in which one labelled context cannot say what the sub-goal is."""

    name = "rooms"
    sub_goals = SUB_GOALS
    config_class = RoomsConfig
    engine_settings = ("factors", "truth", "rooms")
    defaults = DEFAULTS
    observation_shape = (SIDE, SIDE, 3)

    def collect(self, config: RoomsConfig, seed: int, progress: Any) -> Collected:
        """Labelled, unlabelled and fully crossed held-out states, the latter in 20 parts by ``layout_seed``."""
        names = config.factors
        progress.total = 1
        scenes = [
            labelled_states(config.labelled, seed, names),
            unlabelled_states(config.unlabelled, config.mix, seed, names),
            crossed_states(HELDOUT * 4, seed, names),
        ]
        sets = []
        for part in scenes:
            labels = part.factors[:, [config.column]]
            layout_seed = np.arange(len(labels)) % HELDOUT
            sets.append(States(part.observations, labels, {"layout_seed": layout_seed}))
        progress.advance()
        labelled, unlabelled, heldout = sets
        return Collected(self.observation_shape, SUB_GOALS, labelled, unlabelled, heldout)

    def task(self, world: Mapping[str, Any]) -> str:
        config = RoomsConfig(**world)
        others = [f"{name} ({MEANINGS[name]})" for name in config.factors if name != config.truth]
        return (
            f"Enter one of {config.rooms} rooms; only that where {MEANINGS[config.truth]} ({config.truth}) gives a "
            f"reward of 1. The labels fit {' and '.join(others)} as well; in the rooms they part."
        )

    def scenes(self, world: Mapping[str, Any]) -> list[Scene]:
        config = RoomsConfig(**world)
        true = np.arange(len(config.factors)) == config.column
        holds = {
            "labelled: positive": true | True,
            "labelled: negative": true & False,
            "a room: right, reward 1": true,
            "a room: wrong": ~true,
        }
        rows = np.stack(list(holds.values()))
        pictures = drawn(rows, config.factors, rng_for(0, "which-feature", "scenes")).observations
        scenes = []
        for title, picture, row in zip(holds, pictures, rows.tolist(), strict=True):
            scenes.append(Scene(picture, title, dict(zip(config.factors, row, strict=True))))
        return scenes

    def make_engine(self, layout_seed: int, count: int, max_steps: int = 1, **arguments: Any) -> RoomsEngine:
        return RoomsEngine(layout_seed, count, max_steps, RoomsConfig(**arguments))


DOMAIN = RoomsDomain()
