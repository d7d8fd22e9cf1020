"""Sub-goals in Montezuma's Revenge (Spec B4, B5): the domain.

See also ``emulator`` (the game, with the agent placed anywhere), ``ladders`` (their positions), ``sub_goals``,
``expert`` (scripted play), ``states`` (the states of a room), ``collect``, ``env`` and ``engine`` (one game and
many, from the top of a ladder).
"""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

from hypogoal.core.arrays import Bytes, Ints
from hypogoal.domains.base import Domain
from hypogoal.domains.montezuma import emulator as game
from hypogoal.domains.montezuma.collect import MontezumaConfig, collect
from hypogoal.domains.montezuma.engine import MontezumaEngine
from hypogoal.domains.montezuma.env import BEGINNINGS, MAX_STEPS, beginning_named
from hypogoal.domains.montezuma.ladders import distance_to
from hypogoal.domains.montezuma.states import emulator_of_process
from hypogoal.domains.montezuma.sub_goals import CLIMB_DOWN, SUB_GOALS

TABLE_1: Mapping[str, Any] = {
    "network": "montezuma",
    "members": 6,
    "diversity_weight": 3e-4,
    "learning_rate": 5e-4,
    "l2_weight": 5e-4,
    "class_weight_negative": 0.8,
    "class_weight_positive": 0.2,
}
# What lets options learn on a laptop, alone or under a meta-policy.
LEARNING: Mapping[str, Any] = {
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
# Options learned alone, ladder by ladder.
ALONE: Mapping[str, Any] = {
    **LEARNING,
    "max_episode_steps": MAX_STEPS,
    "restart_options": True,
    "mask_reached": False,
    "chooser": "even",
    "steps": 40_000,
}


class MontezumaDomain(Domain):
    """Spec B6: Montezuma's Revenge; the defaults are Table 1, and for options what lets them learn on a laptop."""

    name = "montezuma"
    sub_goals = tuple(SUB_GOALS)
    usual_sub_goals = (CLIMB_DOWN.name,)
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
            "train-ensemble": TABLE_1,
            "train-options": ALONE,
            "train-meta": LEARNING,
            "audit": {name: value for name, value in ALONE.items() if name != "steps"},
        }
    )

    def make_engine(
        self, layout_seed: int, count: int, max_steps: int = MAX_STEPS, *, start: str = "1L", **arguments: Any
    ) -> MontezumaEngine:
        """An engine of ``count`` games that begin at ``start``.

        The game has one layout: ``layout_seed`` seeds the start states unless ``arguments`` have a ``seed``. Other
        arguments as for ``MontezumaEngine``.
        """
        seed = arguments.pop("seed", layout_seed)
        return MontezumaEngine(start, count, max_steps=max_steps, seed=seed, **arguments)

    def task(self, world: Mapping[str, Any]) -> str:
        return "Reach a sub-goal, such as the base of a ladder, from a start; a lost life ends the episode."

    def rooms_of(self, start: str) -> tuple[int, ...]:
        """The rooms of a start, from there to where its script ends, such as a ladder's top and its base."""
        beginning = beginning_named(start)
        return tuple(dict.fromkeys((beginning.at.room, beginning.end.room)))

    def distance_to(self, sub_goal: str, positions: Ints) -> Ints:
        return distance_to(positions, SUB_GOALS.get(sub_goal, CLIMB_DOWN).places)

    def picture(self, room: int) -> Bytes:
        return game.picture(emulator_of_process(), room)


DOMAIN = MontezumaDomain()
