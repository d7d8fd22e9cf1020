"""Rooms, one of which has the feature that is rewarded (Spec H1).

An agent stands before some rooms and enters one. In the labelled states several features agree, so only the reward can
tell which of them counts: ``truth`` of the world that an agent is trained in.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hypogoal.core.config import Config, setting
from hypogoal.core.errors import UserError
from hypogoal.core.seeding import rng_for
from hypogoal.data import Collected, States
from hypogoal.domains.base import Domain, Engine, Plan, Scene, Step
from hypogoal.domains.rooms import states
from hypogoal.domains.rooms.states import FACTORS, SIDE, crossed_states, drawn

DECKS = 64  # sets of rooms of a layout; episodes cycle through them
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


class RoomsConfig(Config):
    """Settings of ``hypogoal collect rooms``."""

    factors: tuple[str, ...] = setting(
        ("shape", "place"), "planted features: equal in labelled states", choices=FACTORS
    )
    truth: str = setting("shape", "the feature that rooms are rewarded for", choices=FACTORS)
    rooms: int = setting(5, "rooms to choose among; one is right", low=2, high=32)
    mix: float = setting(1.0, "share of unlabelled states with crossed features", low=0.0, high=1.0)
    labelled: int = setting(256, "labelled states", low=4, high=100_000)
    unlabelled: int = setting(2048, "unlabelled states", low=1, high=100_000)


class RoomsEngine(Engine):
    """Environments of one layout: ``DECKS`` sets of rooms in turn. An action is the room to enter.

    Only the right room has the true feature; every other feature is drawn evenly. Entering a room ends the episode,
    with a reward of 1 if it is the right one. Before the rooms the agent sees a scene in which no feature holds. States
    are 0 .. DECKS - 1 before the rooms, then the rooms, deck by deck. ``layout_seed`` draws the rooms. An episode has
    one step, so it is never truncated.
    """

    resumes = True
    n_states = 0

    def __init__(self, layout_seed: int, count: int, max_steps: int, factors: tuple[str, ...], truth: str, rooms: int):
        column = _column(factors, truth)
        self.count, self.max_steps, self.n_actions = count, max_steps, rooms
        self.n_states = DECKS * (1 + rooms)
        rng = rng_for(layout_seed, "which-feature", "rooms")
        right = np.arange(rooms) == rng.integers(rooms, size=(DECKS, 1))
        holds = rng.random((DECKS, rooms, len(factors))) < 0.5
        holds[..., column] = right
        every = np.concatenate([np.zeros((DECKS, len(factors)), np.bool_), holds.reshape(-1, len(factors))])
        self._pictures = drawn(every, factors, rng).observations
        self._right = np.concatenate([np.zeros(DECKS, np.bool_), right.ravel()])
        self.observation_shape = self._pictures.shape[1:]
        self.reset()

    def reset(self) -> NDArray[np.int64]:
        self.ids = np.arange(self.count) % DECKS
        self.elapsed = np.zeros(self.count, np.int64)
        return self.ids.copy()

    def step(self, actions: NDArray[np.int64]) -> Step:
        following = DECKS + self.ids * self.n_actions + actions
        self.ids = (self.ids + self.count) % DECKS
        over = np.ones(self.count, np.bool_)
        return Step(following, self._right[following].astype(np.float32), over, ~over)

    def images(self, ids: NDArray[np.int64], out: NDArray[np.uint8] | None = None) -> NDArray[np.uint8]:
        return np.take(self._pictures, ids, axis=0, out=self.room_for(len(ids), out))

    def labels(self, ids: NDArray[np.int64]) -> NDArray[np.bool_]:
        return self._right[ids][:, None]

    def reachable(self) -> NDArray[np.int64]:
        return np.arange(self.n_states)

    def plan(self, starts: NDArray[np.int64] | None = None) -> Plan:
        ids, final = self.reachable(), self.reachable() >= DECKS
        following = np.repeat(ids[:, None], self.n_actions, axis=1)
        following[:DECKS] = ids[DECKS:].reshape(DECKS, self.n_actions)
        return Plan(ids, np.arange(self.n_actions), following, final, self._right)

    def shortest_path(self) -> int:
        return 1

    def random_success(self, episodes: int, rng: np.random.Generator) -> float:
        return 1 / self.n_actions

    def snapshot(self) -> dict[str, NDArray[Any]]:
        return {"ids": self.ids.copy()}

    def restore(self, snapshot: Mapping[str, NDArray[Any]]) -> None:
        self.ids = snapshot["ids"].copy()


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
        names, column = config.factors, _column(config.factors, config.truth)
        progress.total = 1
        scenes = [
            states.labelled_states(config.labelled, seed, names),
            states.unlabelled_states(config.unlabelled, config.mix, seed, names),
            crossed_states(HELDOUT * 4, seed, names),
        ]
        progress.advance()
        labelled, unlabelled, heldout = (
            States(
                part.observations, part.factors[:, [column]], {"layout_seed": np.arange(len(part.factors)) % HELDOUT}
            )
            for part in scenes
        )
        return Collected(self.observation_shape, SUB_GOALS, labelled, unlabelled, heldout)

    def task(self, world: Mapping[str, Any]) -> str:
        settings = RoomsConfig(**world)
        others = [f"{name} ({states.MEANINGS[name]})" for name in settings.factors if name != settings.truth]
        return (
            f"Enter one of {settings.rooms} rooms; only that where {states.MEANINGS[settings.truth]} "
            f"({settings.truth}) gives a reward of 1. The labels fit {' and '.join(others)} as well; in the rooms "
            "they part."
        )

    def scenes(self, world: Mapping[str, Any]) -> list[Scene]:
        settings = RoomsConfig(**world)
        column, count = _column(settings.factors, settings.truth), len(settings.factors)
        true = np.arange(count) == column
        holds = np.stack([np.ones(count, np.bool_), np.zeros(count, np.bool_), true, ~true])
        titles = ("labelled: positive", "labelled: negative", "a room: right, reward 1", "a room: wrong")
        pictures = drawn(holds, settings.factors, rng_for(0, "which-feature", "scenes")).observations
        features = [dict(zip(settings.factors, row, strict=True)) for row in holds.tolist()]
        return [Scene(*scene) for scene in zip(pictures, titles, features, strict=True)]

    def make_engine(self, layout_seed: int, count: int, max_steps: int = 1, **arguments: Any) -> RoomsEngine:
        settings = {name: arguments.get(name, getattr(RoomsConfig(), name)) for name in self.engine_settings}
        return RoomsEngine(layout_seed, count, max_steps, **settings)


def _column(factors: tuple[str, ...], truth: str) -> int:
    if truth not in factors or len(set(factors)) < len(factors):
        rule = "each feature is planted once, the true one among them"
        raise UserError(rule, f"factors={','.join(factors)}, truth={truth}", f"Choose from {', '.join(FACTORS)}.")
    return factors.index(truth)


DOMAIN = RoomsDomain()
