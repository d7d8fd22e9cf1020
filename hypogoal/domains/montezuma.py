"""Montezuma's Revenge, climbing down ladders (Spec B4, B5): the domain as the stages see it, how states are collected.

The parts: ``montezuma_emulator`` (the game, the agent put anywhere), ``montezuma_ladders`` (where the ladders are),
``montezuma_states`` (what is collected), ``montezuma_env`` and ``montezuma_engine`` (one game and many, from the top
of a ladder on).
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hypogoal.core.checkpoints import Checkpoints, require_alike
from hypogoal.core.config import setting
from hypogoal.core.workers import allowed, in_processes
from hypogoal.dataset import Collected, States, joined
from hypogoal.domains.base import Domain
from hypogoal.domains.montezuma_emulator import OBSERVATION_SHAPE, ROOMS, observed_pixel, picture, pixel
from hypogoal.domains.montezuma_engine import MontezumaEngine
from hypogoal.domains.montezuma_env import MAX_STEPS, SUB_GOALS
from hypogoal.domains.montezuma_ladders import GROUPS, LADDERS, distance_to_base, ladder_named
from hypogoal.domains.montezuma_states import (
    KINDS,
    PLAYS,
    RoomStates,
    emulator_of_process,
    gather,
    labels_of,
    origins_of,
)

# The unlabelled rooms where none are given: the first of these ladder rooms that has no labels, and a room without a
# ladder; where all have labels, two without.
UNLABELLED_LADDER_ROOMS = (9, 21, 19, 22, 10)
UNLABELLED_OTHER_ROOMS = (18, 12)
SEEN_NOWHERE, SEEN_UNLABELLED, SEEN_LABELLED = range(3)


# What lets options learn on a laptop, whether by themselves or below a meta-policy.
LEARNING: Mapping[str, Any] = {
    "option_timeout": MAX_STEPS,
    "experience": "own",
    "option_gamma": 0.99,
    "option_batch": 32,
    "n_step": 10,
    "exploration": "persistent",
    "epsilon_steps": 10_000,
    "epsilon_final": 0.01,
    "random_episodes": 0,
}
# And where they are learned by themselves, ladder by ladder.
ALONE: Mapping[str, Any] = {
    **LEARNING,
    "max_episode_steps": MAX_STEPS,
    "restart_options": True,
    "mask_reached": False,
    "chooser": "even",
    "steps": 40_000,
    "steps_for": "each",
}


@dataclass(frozen=True)
class MontezumaConfig:
    """Settings of ``hypogoal collect montezuma``."""

    groups: int = setting(1, "ladder groups with labels (N), out of seven", source="Figure 3", low=1, high=len(GROUPS))
    unlabelled_rooms: tuple[int, ...] = setting(
        (),
        "rooms of the unlabelled states; empty: one with a ladder that has no labels, and room 18, without a ladder",
        source="paper: for N = 1 one room of each kind",
        low=0,
        high=ROOMS - 1,
    )
    states_per_room: int = setting(
        600, "labelled states of each room of the groups", unit="states", source="own choice", low=1, high=100_000
    )
    unlabelled_per_room: int = setting(
        600, "unlabelled states of each of their rooms", unit="states", source="own choice", low=1, high=100_000
    )
    heldout_per_room: int = setting(
        300, "held-out states of each of the 24 rooms", unit="states", source="own choice", low=1, high=100_000
    )
    heldout_seed: int = setting(0, "another number draws other held-out states, and nothing else changes", low=0)
    unlabelled_from: str = setting(
        "expert",
        "who plays in the unlabelled rooms: the labelled states' expert, or uniformly random actions from their sides",
        source="the paper's suggestion",
        choices=PLAYS,
    )
    workers: int = setting(0, "rooms played at once, each in a process; 0 for one per core", low=0, high=1024)


class _Task(NamedTuple):
    """States of a room for the set ``name``: gathered, kept till all are there."""

    name: str
    gather: Callable[[], RoomStates]
    kept: Checkpoints
    wanted: int

    def load(self) -> RoomStates | None:
        """What was gathered before."""
        saved = self.kept.load()
        if saved is None:
            return None
        with self.kept.restoring():
            require_alike(
                saved,
                {
                    "observations": np.empty((self.wanted, *OBSERVATION_SHAPE), np.uint8),
                    "ram": np.empty((self.wanted, 128), np.uint8),
                    "actions": np.empty((self.wanted, 2), np.int64),
                },
            )
        return RoomStates(**saved)


def labelled_rooms(groups: int) -> tuple[int, ...]:
    """The rooms of the first N ladder groups."""
    return tuple(room for group in GROUPS[:groups] for room in group)


def unlabelled_rooms(config: MontezumaConfig) -> tuple[int, ...]:
    """The rooms of the unlabelled states: those given, or one with a ladder that has no labels and one without."""
    if config.unlabelled_rooms:
        return tuple(dict.fromkeys(config.unlabelled_rooms))
    labelled = labelled_rooms(config.groups)
    left = [room for room in UNLABELLED_LADDER_ROOMS if room not in labelled]
    return (left[0], UNLABELLED_OTHER_ROOMS[0]) if left else UNLABELLED_OTHER_ROOMS


class MontezumaDomain(Domain):
    """Spec B6: Montezuma's ladders; by default Table 1, and for options what lets them learn on a laptop."""

    name = "montezuma"
    sub_goals = SUB_GOALS
    observation_shape = OBSERVATION_SHAPE
    config_class = MontezumaConfig
    env_id = "hypogoal/MontezumaLadder-v0"
    starts = tuple(ladder.name for ladder in LADDERS)
    many_starts = True
    packed = 20  # 24 were measured
    kinds = KINDS
    resumes = measures = pictures = sees_agent = True
    near = 12
    distance = staticmethod(distance_to_base)
    pixel = staticmethod(pixel)
    agent_pixels = staticmethod(observed_pixel)
    sources = MappingProxyType({"train-ensemble": "paper, appendix (Table 1)"})
    defaults = MappingProxyType(
        {
            "train-ensemble": {
                "network": "montezuma",
                "members": 6,
                "diversity_weight": 3e-4,
                "learning_rate": 5e-4,
                "l2_weight": 5e-4,
                "class_weight_negative": 0.8,
                "class_weight_positive": 0.2,
            },
            "train-options": ALONE,
            "train-meta": LEARNING,
            "audit": ALONE,
        }
    )

    def collected_bytes(self, config: MontezumaConfig) -> int:
        """Observations of a collection, at the most: every room labelled, unlabelled and held out."""
        each = config.states_per_room + config.unlabelled_per_room + config.heldout_per_room
        return ROOMS * each * math.prod(self.observation_shape)

    def played_bytes(self, steps: int, frames: int) -> int:
        """A frame of each step, as far back as replays reach."""
        return frames * math.prod(self.observation_shape[:2])

    def collect(
        self, config: MontezumaConfig, seed: int, progress: Any, kept: Callable[[str], Checkpoints] | None = None
    ) -> Collected:
        """Spec B5: labelled, unlabelled and held-out states, each with its origin.

        Labelled are the rooms of the first N ladder groups; held out are states of all 24 rooms, the same ones for
        every N. States at the base of a ladder that runs on through the floor are in the unlabelled set only. No
        stack of the held-out set is in another one, and none is twice in one room of a set. Nothing depends on how
        many processes play.

        ``seed`` is of the rollouts; each room of each set has a stream of its own. ``kept`` says by name where each
        room's states are kept until all are there; what is there is not gathered again. Labels are of all three sets
        (those of the unlabelled are for tests only). Origins: see ``montezuma_states.origins_of``; of held-out states
        also ``seen``: 0 the room is in no training set, 1 it is among the unlabelled rooms, 2 among the labelled ones.
        No such room, no emulator, or a room that does not show so many different states is a ``UserError``.
        """
        labelled, unlabelled = labelled_rooms(config.groups), unlabelled_rooms(config)
        tasks: list[_Task] = []
        expected = 0
        for name, rooms, wanted, stream, play in (
            ("labelled", labelled, config.states_per_room, (), "expert"),
            ("unlabelled", unlabelled, config.unlabelled_per_room, (), config.unlabelled_from),
            ("heldout", range(ROOMS), config.heldout_per_room, (config.heldout_seed,), "expert"),
        ):
            draw = partial(gather, play=play, held_out=name == "heldout", runs_on=name == "unlabelled")
            for room in rooms:
                job = partial(draw, room, wanted, seed, ("montezuma", name, *stream))
                tasks.append(_Task(name, job, kept(f"{name}-{room}") if kept else Checkpoints(None), wanted))
            expected += wanted * len(rooms)
        progress.expect(expected)
        there = {number: states for number, task in enumerate(tasks) if (states := task.load())}
        for loaded in there.values():
            progress.advance(len(loaded.ram))
        left = [number for number in range(len(tasks)) if number not in there]

        def done(place: int, states: RoomStates) -> None:
            tasks[left[place]].kept.save(vars(states))
            there[left[place]] = states
            progress.advance(len(states.ram))

        in_processes([tasks[number].gather for number in left], allowed(config.workers), done)

        def all_of(name: str) -> States:
            rooms = [there.pop(number) for number, task in enumerate(tasks) if task.name == name]
            return joined([States(room.observations, labels_of(room.ram)[:, None], origins_of(room)) for room in rooms])

        learnt, others, heldout = map(all_of, ("labelled", "unlabelled", "heldout"))
        seen = np.full(len(heldout.labels), SEEN_NOWHERE)
        seen[np.isin(heldout.origins["room"], unlabelled)] = SEEN_UNLABELLED
        seen[np.isin(heldout.origins["room"], labelled)] = SEEN_LABELLED
        heldout = replace(heldout, origins={**heldout.origins, "seen": seen})
        return Collected(OBSERVATION_SHAPE, SUB_GOALS, learnt, others, heldout)

    def make_engine(
        self,
        layout_seed: int,
        count: int,
        max_steps: int = MAX_STEPS,
        *,
        start: str = LADDERS[0].name,
        **arguments: Any,
    ) -> MontezumaEngine:
        """An engine of ``count`` games that begin at the ladder ``start``.

        The game has one layout: ``layout_seed`` is that of the start states where ``arguments`` have no ``seed``. The
        other arguments are ``MontezumaEngine``'s.
        """
        return MontezumaEngine(start, count, max_steps=max_steps, **{"seed": layout_seed, **arguments})

    def rooms_of(self, start: str) -> tuple[int, ...]:
        """The rooms of a ladder, from its top to its base."""
        ladder = ladder_named(start)
        return tuple(dict.fromkeys((ladder.top.room, ladder.base.room)))

    def picture(self, room: int) -> NDArray[np.uint8]:
        return picture(emulator_of_process(), room)


DOMAIN = MontezumaDomain()
