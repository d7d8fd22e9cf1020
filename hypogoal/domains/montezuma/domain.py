"""Sub-goals in Montezuma's Revenge (Spec B4, B5): the domain, and how its states are collected.

See also ``emulator`` (the game, with the agent placed anywhere), ``ladders`` (the ladders'
positions), ``sub_goals`` (climbing, passing enemies), ``states`` (the states of a room),
``env`` and ``engine`` (one game and many, from the top of a ladder).
"""

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from types import MappingProxyType
from typing import Annotated, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from hypogoal.core.checkpoints import Checkpoints
from hypogoal.core.config import Config, setting
from hypogoal.core.processes import allowed, in_processes
from hypogoal.data import Collected, States, joined
from hypogoal.domains.base import Domain
from hypogoal.domains.montezuma.emulator import OBSERVATION_SHAPE, ROOMS, picture, pixel
from hypogoal.domains.montezuma.engine import MontezumaEngine
from hypogoal.domains.montezuma.env import BEGINNINGS, MAX_STEPS, beginning_named
from hypogoal.domains.montezuma.ladders import GROUPS, distance_to, distance_to_base
from hypogoal.domains.montezuma.states import (
    KINDS,
    RoomStates,
    emulator_of_process,
    gather,
    labels_of,
    origins_of,
)
from hypogoal.domains.montezuma.sub_goals import CLIMB_DOWN, SUB_GOALS, SubGoal

SEEN_NOWHERE, SEEN_UNLABELLED, SEEN_LABELLED = range(3)


# What lets options learn on a laptop, alone or under a meta-policy.
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
# Options learned alone, ladder by ladder.
ALONE: Mapping[str, Any] = {
    **LEARNING,
    "max_episode_steps": MAX_STEPS,
    "restart_options": True,
    "mask_reached": False,
    "chooser": "even",
    "steps": 40_000,
}


class MontezumaConfig(Config):
    """Settings of ``hypogoal collect montezuma``."""

    groups: int = setting(1, "ladder groups with labels (N), out of seven", source="Figure 3", low=1, high=len(GROUPS))
    sub_goals: Annotated[tuple[str, ...], Field(min_length=1)] = setting(
        (CLIMB_DOWN.name,),
        "what is labelled; others than ladders have five or three groups",
        choices=SUB_GOALS,
        source="paper; the others: the authors' code",
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
    heldout_seed: int = setting(0, "another number draws other held-out states and changes nothing else", low=0)
    workers: int = setting(0, "rooms played at once, each in a process; 0 for one per core", low=0, high=1024)


class _Task(NamedTuple):
    """Gathers the states of a room for the set ``name``, and keeps them until all rooms are complete."""

    name: str
    gather: Callable[[], RoomStates]
    kept: Checkpoints

    def load(self) -> RoomStates | None:
        """The states gathered before, if any."""
        saved = self.kept.load()
        return RoomStates(**saved) if saved else None


def chosen(config: MontezumaConfig) -> list[SubGoal]:
    """The sub-goals to label."""
    return [SUB_GOALS[name] for name in dict.fromkeys(config.sub_goals)]


def labelled_rooms(config: MontezumaConfig) -> tuple[int, ...]:
    """The rooms of the first N groups of each sub-goal."""
    groups = [group for sub_goal in chosen(config) for group in sub_goal.groups[: config.groups]]
    return tuple(dict.fromkeys(room for group in groups for room in group))


def unlabelled_rooms(config: MontezumaConfig) -> tuple[int, ...]:
    """The two rooms of the unlabelled states.

    One without labels where the first sub-goal holds somewhere and one where it holds nowhere; or two of these, if all
    others have labels. Source: the paper, for N = 1.
    """
    first = chosen(config)[0]
    left = [room for room in first.unlabelled if room not in labelled_rooms(config)]
    return (left[0], first.others[0]) if left else first.others


class MontezumaDomain(Domain):
    """Spec B6: Montezuma's Revenge; the defaults are Table 1, and for options what lets them learn on a laptop."""

    name = "montezuma"
    sub_goals = tuple(SUB_GOALS)
    usual_sub_goals = (CLIMB_DOWN.name,)
    observation_shape = OBSERVATION_SHAPE
    config_class = MontezumaConfig
    env_id = "hypogoal.envs:hypogoal/MontezumaLadder-v0"
    starts = tuple(BEGINNINGS)
    many_starts = True
    kinds = KINDS
    resumes = measures = pictures = True
    near = 12
    distance = staticmethod(distance_to_base)
    pixel = staticmethod(pixel)
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
            "audit": {name: value for name, value in ALONE.items() if name != "steps"},
        }
    )

    def collect(
        self, config: MontezumaConfig, seed: int, progress: Any, kept: Callable[[str], Checkpoints] | None = None
    ) -> Collected:
        """Spec B5: labelled, unlabelled and held-out states, each with its origin.

        The rooms of the first N groups are labelled; all 24 rooms have held-out states, the same for every N. States at
        the base of a ladder that continues through the floor are in the unlabelled set only. No held-out
        stack is in another set, and no stack occurs twice in a room of a set. The result does not depend on the number
        of processes.

        ``seed`` seeds the rollouts; each room of each set has its own stream. ``kept`` returns by name the checkpoints
        that keep each room's states until all rooms are complete; a room kept there is not gathered again. All three
        sets have labels (the unlabelled states' are for tests only). Origins: see ``states.origins_of``;
        held-out states also have ``seen``: 0 the room is in no training set, 1 it is an unlabelled room, 2 a labelled
        one. No emulator, or a room with too few different states is a ``UserError``.
        """
        sub_goals, labelled, unlabelled = chosen(config), labelled_rooms(config), unlabelled_rooms(config)
        tasks: list[_Task] = []
        expected = 0
        for name, rooms, wanted, stream in (
            ("labelled", labelled, config.states_per_room, ()),
            ("unlabelled", unlabelled, config.unlabelled_per_room, ()),
            ("heldout", range(ROOMS), config.heldout_per_room, (config.heldout_seed,)),
        ):
            draw = partial(gather, held_out=name == "heldout", unclear=name == "unlabelled")
            for room in rooms:
                job = partial(draw, room, wanted, seed, ("montezuma", name, *stream), sub_goals=sub_goals)
                tasks.append(_Task(name, job, kept(f"{name}-{room}") if kept else Checkpoints(None)))
            expected += wanted * len(rooms)
        progress.total = expected
        gathered = {number: states for number, task in enumerate(tasks) if (states := task.load())}
        for loaded in gathered.values():
            progress.advance(len(loaded.ram))
        left = [number for number in range(len(tasks)) if number not in gathered]

        def done(place: int, states: RoomStates) -> None:
            tasks[left[place]].kept.save(vars(states))
            gathered[left[place]] = states
            progress.advance(len(states.ram))

        in_processes([tasks[number].gather for number in left], allowed(config.workers), done)

        def all_of(name: str) -> States:
            rooms = [gathered.pop(number) for number, task in enumerate(tasks) if task.name == name]
            return joined(
                [
                    States(room.observations, labels_of(room.ram, sub_goals), origins_of(room, sub_goals[0]))
                    for room in rooms
                ]
            )

        labelled_states, unlabelled_states, heldout = map(all_of, ("labelled", "unlabelled", "heldout"))
        seen = np.full(len(heldout.labels), SEEN_NOWHERE)
        seen[np.isin(heldout.origins["room"], unlabelled)] = SEEN_UNLABELLED
        seen[np.isin(heldout.origins["room"], labelled)] = SEEN_LABELLED
        heldout = replace(heldout, origins={**heldout.origins, "seen": seen})
        names = tuple(sub_goal.name for sub_goal in sub_goals)
        return Collected(OBSERVATION_SHAPE, names, labelled_states, unlabelled_states, heldout)

    def make_engine(
        self,
        layout_seed: int,
        count: int,
        max_steps: int = MAX_STEPS,
        *,
        start: str = next(iter(BEGINNINGS)),
        **arguments: Any,
    ) -> MontezumaEngine:
        """An engine of ``count`` games that begin at ``start``.

        The game has one layout: ``layout_seed`` seeds the start states unless ``arguments`` have a ``seed``. Other
        arguments as for ``MontezumaEngine``.
        """
        return MontezumaEngine(start, count, max_steps=max_steps, **{"seed": layout_seed, **arguments})

    def task(self, world: Mapping[str, Any]) -> str:
        return "Reach a sub-goal, such as the base of a ladder, from a start; a lost life ends the episode."

    def rooms_of(self, start: str) -> tuple[int, ...]:
        """The rooms of a start, from there to where its script ends, such as a ladder's top and its base."""
        return tuple(dict.fromkeys(place.room for place in (beginning_named(start).at, beginning_named(start).end)))

    def distance_to(self, sub_goal: str, positions: NDArray[np.int64]) -> NDArray[np.int64]:
        return distance_to(positions, SUB_GOALS.get(sub_goal, CLIMB_DOWN).places)

    def picture(self, room: int) -> NDArray[np.uint8]:
        return picture(emulator_of_process(), room)


DOMAIN = MontezumaDomain()
