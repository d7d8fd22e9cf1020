"""The domain of sub-goals in Montezuma's Revenge, and how its states are collected.

See also ``emulator`` (the game, with the agent placed anywhere), ``ladders`` (the ladders' positions), ``sub_goals``,
``expert`` (scripted play), ``states`` (the states of a room), ``env`` (one game from the top of a ladder or elsewhere)
and ``engine`` (many games).
"""

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from itertools import chain
from types import MappingProxyType
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from hypogoal.core.arrays import Bytes, Ints
from hypogoal.core.config import Config, setting
from hypogoal.core.processes import allowed, in_processes
from hypogoal.data import Collected, States, joined
from hypogoal.domains.base import EQUATION_1, Domain
from hypogoal.domains.montezuma import emulator as game
from hypogoal.domains.montezuma.engine import MontezumaEngine
from hypogoal.domains.montezuma.env import BEGINNINGS, MAX_STEPS
from hypogoal.domains.montezuma.ladders import distance_to
from hypogoal.domains.montezuma.states import gather
from hypogoal.domains.montezuma.sub_goals import CLIMB_DOWN, LABELLED_ROOMS, SUB_GOALS

TABLE_1 = {
    "network": "montezuma",
    "members": 6,
    "diversity_weight": 3e-4,
    "learning_rate": 5e-4,
    "l2_weight": 5e-4,
    "class_weight_negative": 0.8,
    "class_weight_positive": 0.2,
}
# Settings with which options learn on a laptop, alone or under a meta-policy.
LEARNING = {
    "option_timeout": MAX_STEPS,
    "experience": "own",
    "option_gamma": 0.99,
    "option_batch": 32,
    "n_step": 10,
    "exploration": "persistent",
    "update_interval": 16,
    "epsilon_steps": 10_000,
    "epsilon_final": 0.01,
}
# Settings with which options are learned alone, ladder by ladder.
ALONE = {
    **LEARNING,
    "max_episode_steps": MAX_STEPS,
    "restart_options": True,
    "mask_reached": False,
    "chooser": "even",
    "steps": 40_000,
}


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
    states_per_room: int = setting(600, "labelled states of each room of the groups", low=1, high=100_000)
    unlabelled_per_room: int = setting(600, "unlabelled states of each of their rooms", low=1, high=100_000)
    heldout_per_room: int = setting(300, "held-out states of each of the 24 rooms", low=1, high=100_000)
    workers: int = setting(0, "rooms played at once, each in a process; 0 for one per core", low=0, high=1024)


def choose_rooms(config: MontezumaConfig) -> tuple[list[int], list[int]]:
    """Return the rooms of the labelled states, and the rooms of the unlabelled states.

    Labelled states are from the first N groups of each sub-goal. Unlabelled states are from two rooms. In the first
    room, which has no labels, the first sub-goal holds somewhere. In the second room the sub-goal holds nowhere. If all
    rooms in which the sub-goal holds have labels, it holds in neither room. Source: the paper, for N = 1.
    """
    labelled: list[int] = []
    for name in config.sub_goals:
        groups = LABELLED_ROOMS[name]["groups"]
        labelled += chain.from_iterable(groups[: config.groups])
    of_first = LABELLED_ROOMS[config.sub_goals[0]]
    holding = [room for room in of_first["unlabelled"] if room not in labelled]
    unlabelled = holding[:1] + of_first["others"]
    return [*dict.fromkeys(labelled)], unlabelled[:2]


def collect(config: MontezumaConfig, seed: int, progress: Any) -> Collected:
    """Collect labelled, unlabelled and held-out states, each with its origin.

    All 24 rooms have held-out states, which are the same for every N. States at the base of a ladder that continues
    through the floor are in the unlabelled set only. No held-out stack is in another set, and no stack occurs twice in
    a room of a set. The result does not depend on the number of processes.

    ``seed`` is the seed of the rollouts, with a random stream of its own for each room of each set. All three sets have
    labels, but those of the unlabelled states are for tests only. Origins are those of ``states.describe_states``.
    Held-out states also have ``seen``, which is 0 if the room is in no training set, 1 if it is an unlabelled room, and
    2 if it is a labelled room. Raises ``UserError`` without the emulator, or if a room has too few different states.
    """
    labelled, unlabelled = choose_rooms(config)
    names = tuple(dict.fromkeys(config.sub_goals))
    sub_goals = [SUB_GOALS[name] for name in names]
    sets = {
        "labelled": (labelled, config.states_per_room),
        "unlabelled": (unlabelled, config.unlabelled_per_room),
        "heldout": (range(game.ROOMS), config.heldout_per_room),
    }
    jobs: list[Callable[[], States]] = []
    places = []  # the places of each set's jobs among all jobs
    for split, (rooms, wanted) in sets.items():
        first = len(jobs)
        jobs += [partial(gather, split, room, wanted, seed, sub_goals) for room in rooms]
        places.append(slice(first, len(jobs)))
    progress.total = sum(wanted * len(rooms) for rooms, wanted in sets.values())
    gathered: list[Any] = [*jobs]

    def done(number: int, states: States) -> None:
        gathered[number] = states
        progress.advance(len(states.labels))

    in_processes(jobs, allowed(config.workers), done)
    for_labels, without_labels, heldout = [joined(gathered[place]) for place in places]
    room_numbers = heldout.origins["room"]
    is_in = [np.isin(room_numbers, rooms) for rooms in (labelled, unlabelled)]
    seen = np.select(is_in, [SEEN_LABELLED, SEEN_UNLABELLED], SEEN_NOWHERE)
    heldout = replace(heldout, origins={**heldout.origins, "seen": seen})
    return Collected(game.OBSERVATION_SHAPE, names, for_labels, without_labels, heldout)


class MontezumaDomain(Domain[MontezumaConfig]):
    """Montezuma's Revenge. The defaults are Table 1, and for options, settings that let them learn on a laptop."""

    name = "montezuma"
    sub_goals = tuple(SUB_GOALS)
    observation_shape = game.OBSERVATION_SHAPE
    config_class = MontezumaConfig
    env_id = "hypogoal.envs:hypogoal/MontezumaLadder-v0"
    starts = tuple(BEGINNINGS)
    measures = pictures = True
    near = 12
    collect = staticmethod(collect)
    pixel = staticmethod(game.pixel)
    sources = MappingProxyType({"train-ensemble": "paper, appendix (Table 1)"})
    defaults = MappingProxyType(
        {
            "train-ensemble": TABLE_1 | EQUATION_1,
            "train-options": ALONE,
            "train-meta": LEARNING | {"chooser": "ppo"},
            "audit": {name: value for name, value in ALONE.items() if name != "steps"},
        }
    )

    def make_engine(
        self, layout_seed: int, count: int, max_steps: int = MAX_STEPS, *, start: str = "1L", **arguments: Any
    ) -> MontezumaEngine:
        """Return an engine of ``count`` games.

        The game has one layout, so ``layout_seed`` is the seed of the start states, unless ``arguments`` have a
        ``seed``.
        """
        seed = arguments.pop("seed", layout_seed)
        return MontezumaEngine(start, count, max_steps=max_steps, seed=seed, **arguments)

    def task(self, world: Mapping[str, Any]) -> str:
        return "Reach a sub-goal, such as the base of a ladder, from a start; a lost life ends the episode."

    def distance_to(self, sub_goal: str, positions: Ints) -> Ints:
        return distance_to(positions, SUB_GOALS[sub_goal].places)

    def picture(self, room: int) -> Bytes:
        return game.picture(game.Emulator(), room)


DOMAIN = MontezumaDomain()
