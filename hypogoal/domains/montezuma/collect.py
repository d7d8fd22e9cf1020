"""How states of Montezuma's Revenge are collected: which rooms are labelled, each played in a process (Spec B5)."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from itertools import chain, islice
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from hypogoal.core.config import Config, setting
from hypogoal.core.processes import allowed, in_processes
from hypogoal.data import Collected, States, joined
from hypogoal.domains.montezuma import emulator as game
from hypogoal.domains.montezuma.states import gather
from hypogoal.domains.montezuma.sub_goals import CLIMB_DOWN, SUB_GOALS, SubGoal

SEEN_NOWHERE, SEEN_UNLABELLED, SEEN_LABELLED = range(3)


class MontezumaConfig(Config):
    """Settings of ``hypogoal collect montezuma``."""

    groups: int = setting(1, "ladder groups with labels (N), out of seven", source="Figure 3", low=1, high=7)
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
    workers: int = setting(0, "rooms played at once, each in a process; 0 for one per core", low=0, high=1024)


def chosen(config: MontezumaConfig) -> list[SubGoal]:
    """The sub-goals to label."""
    return [SUB_GOALS[name] for name in dict.fromkeys(config.sub_goals)]


def labelled_rooms(config: MontezumaConfig) -> tuple[int, ...]:
    """The rooms of the first N groups of each sub-goal."""
    groups = [sub_goal.groups[: config.groups] for sub_goal in chosen(config)]
    rooms = chain.from_iterable(chain.from_iterable(groups))
    return tuple(dict.fromkeys(rooms))


def unlabelled_rooms(config: MontezumaConfig) -> tuple[int, ...]:
    """The two rooms of the unlabelled states.

    One without labels where the first sub-goal holds somewhere and one where it holds nowhere; or two of these, if all
    others have labels. Source: the paper, for N = 1.
    """
    first = chosen(config)[0]
    left = [room for room in first.unlabelled if room not in labelled_rooms(config)]
    first_choice, second_choice = first.others
    return (left[0], first_choice) if left else (first_choice, second_choice)


def collect(config: MontezumaConfig, seed: int, progress: Any) -> Collected:
    """Spec B5: labelled, unlabelled and held-out states, each with its origin.

    The rooms of the first N groups are labelled; all 24 rooms have held-out states, the same for every N. States at
    the base of a ladder that continues through the floor are in the unlabelled set only. No held-out
    stack is in another set, and no stack occurs twice in a room of a set. The result does not depend on the number
    of processes.

    ``seed`` seeds the rollouts; each room of each set has its own stream. All three sets have labels (the
    unlabelled states' are for tests only). Origins: see ``states.states_of``; held-out states also have ``seen``: 0
    the room is in no training set, 1 it is an unlabelled room, 2 a labelled one. No emulator, or a room with too
    few different states is a ``UserError``.
    """
    labelled = labelled_rooms(config)
    unlabelled = unlabelled_rooms(config)
    sub_goals = chosen(config)
    sets = {
        "labelled": (labelled, config.states_per_room),
        "unlabelled": (unlabelled, config.unlabelled_per_room),
        "heldout": (range(game.ROOMS), config.heldout_per_room),
    }
    jobs: list[Callable[[], States]] = []
    for split, (rooms, wanted) in sets.items():
        jobs += [partial(gather, split, room, wanted, seed, sub_goals) for room in rooms]
    progress.total = sum(wanted * len(rooms) for rooms, wanted in sets.values())
    gathered: dict[int, States] = {}

    def done(number: int, states: States) -> None:
        gathered[number] = states
        progress.advance(len(states.labels))

    in_processes(jobs, allowed(config.workers), done)
    in_order = map(gathered.pop, range(len(jobs)))
    each = [[*islice(in_order, len(rooms))] for rooms, _ in sets.values()]
    for_labels, without_labels, heldout = map(joined, each)
    room_numbers = heldout.origins["room"]
    seen = np.full(len(room_numbers), SEEN_NOWHERE)
    seen[np.isin(room_numbers, unlabelled)] = SEEN_UNLABELLED
    seen[np.isin(room_numbers, labelled)] = SEEN_LABELLED
    heldout = replace(heldout, origins={**heldout.origins, "seen": seen})
    names = tuple(sub_goal.name for sub_goal in sub_goals)
    return Collected(game.OBSERVATION_SHAPE, names, for_labels, without_labels, heldout)
