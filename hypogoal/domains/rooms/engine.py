"""The engine of rooms among which an agent chooses, and the settings that say which feature is rewarded."""

from typing import Self

import numpy as np
from numpy.random import Generator
from pydantic import model_validator

from hypogoal.core.arrays import Bools, Bytes, Ints
from hypogoal.core.config import Config, setting
from hypogoal.core.errors import UserError
from hypogoal.core.seeding import rng_for
from hypogoal.domains.base import Engine, Plan, Step
from hypogoal.domains.rooms.states import FACTORS, draw_scenes

DECKS = 64  # the number of sets of rooms of a layout, through which episodes cycle


class RoomsConfig(Config):
    """Settings of ``hypogoal collect rooms``."""

    factors: tuple[str, ...] = setting(
        ("shape", "place"),
        "planted features: equal in labelled states",
        choices=FACTORS,
    )
    truth: str = setting("shape", "the feature that rooms are rewarded for", choices=FACTORS)
    rooms: int = setting(5, "rooms to choose among; one is right", low=2, high=32)
    mix: float = setting(1.0, "share of unlabelled states with crossed features", low=0.0, high=1.0)
    labelled: int = setting(256, "labelled states", low=4, high=100_000)
    unlabelled: int = setting(2048, "unlabelled states", low=1, high=100_000)

    @model_validator(mode="after")
    def _true_is_planted(self) -> Self:
        """Raise ``UserError`` unless each feature is planted once, and the true feature is among them."""
        twice = len({*self.factors}) < len(self.factors)
        if twice or self.truth not in self.factors:
            raise UserError(
                "each feature is planted once, the true one among them",
                f"factors={','.join(self.factors)}, truth={self.truth}",
                f"Choose from {', '.join(FACTORS)}.",
            )
        return self


class RoomsEngine(Engine):
    """Environments of one layout, which show ``DECKS`` sets of rooms in turn. An action is the room to enter.

    Only the right room has the true feature, and every other feature is drawn evenly. Entering a room ends the episode,
    with a reward of 1 if the room is right. Before the rooms the agent sees a scene in which no feature holds. The
    states before the rooms are 0 .. DECKS - 1, and the rooms follow, deck by deck. ``layout_seed`` draws the rooms. An
    episode has one step, so it is never truncated.
    """

    resumes = True
    n_states = 0

    def __init__(
        self,
        layout_seed: int,
        count: int,
        max_steps: int,
        config: RoomsConfig,
    ):
        self.count, self.max_steps, self.n_actions = count, max_steps, config.rooms
        self.n_states = DECKS * (1 + config.rooms)
        rng = rng_for(layout_seed, "which-feature", "rooms")
        right = np.arange(config.rooms) == rng.integers(config.rooms, size=(DECKS, 1))
        factors = len(config.factors)
        holds = rng.random((DECKS, config.rooms, factors)) < 0.5
        holds[..., config.factors.index(config.truth)] = right
        before = np.zeros((DECKS, factors), bool)
        every = np.concatenate([before, holds.reshape(-1, factors)])
        self._pictures = draw_scenes(every, config.factors, rng).observations
        self._right = np.zeros(self.n_states, bool)
        self._right[DECKS:] = right.ravel()
        self.observation_shape = self._pictures.shape[1:]
        self.reset()

    def reset(self) -> Ints:
        self.ids = np.arange(self.count) % DECKS
        self.elapsed = np.zeros(self.count, int)
        return self.ids.copy()

    def step(self, actions: Ints) -> Step:
        following = DECKS + self.ids * self.n_actions + actions
        self.ids = (self.ids + self.count) % DECKS
        over = np.ones(self.count, bool)
        rewards = self._right[following].astype(np.float32)
        return Step(following, rewards, over, ~over)

    def images(self, ids: Ints) -> Bytes:
        return self._pictures[ids]

    def labels(self, ids: Ints) -> Bools:
        return self._right[ids][:, None]

    def reachable(self) -> Ints:
        return np.arange(self.n_states)

    def plan(self, starts: Ints | None = None) -> Plan:
        ids = self.reachable()
        final = ids >= DECKS
        following = np.repeat(ids[:, None], self.n_actions, axis=1)
        following[:DECKS] = ids[final].reshape(DECKS, -1)
        return Plan(
            ids,
            np.arange(self.n_actions),
            following,
            final,
            self._right,
        )

    def shortest_path(self) -> int:
        return 1

    def random_success(self, episodes: int, rng: Generator) -> float:
        return 1 / self.n_actions
