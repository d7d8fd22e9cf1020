"""The world that an agent plays in, with options or with primitive actions."""

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from hypogoal.core.config import Config, Values, assigned, setting
from hypogoal.core.errors import UserError
from hypogoal.core.seeding import rng_for
from hypogoal.domains.base import Domain, Engine

RANDOM_EPISODES = 200  # episodes of random play, which measure how hard a layout is


class WorldConfig(Config):
    """The world that an agent plays in."""

    layout_seed: int = setting(100, "seed of the layout on which the agent lives", source="paper, Figure 6", low=0)
    start: str = setting(
        "",
        "where episodes begin, in a domain that names several places",
        source="paper, policy learning",
    )
    max_episode_steps: int = setting(
        500, "an episode is cut after this many steps", unit="steps", source="paper, MiniGrid experiment", low=1
    )
    cap: float = setting(
        0.0,
        "an episode is cut after this many times the layout's shortest path; 0 for max_episode_steps",
        source="ours: a task in which choosing decides",
        low=0.0,
    )
    world: tuple[str, ...] = setting(
        (),
        "changes to the world that the states were collected in: settings of the domain as name=value",
        source="ours: a task in which choosing decides",
    )


def played_world(domain: Domain, collected: Values, config: WorldConfig) -> dict[str, Any]:
    """Return the settings with which states were collected, after the changes that the setting ``world`` names.

    Raises ``UserError`` if a change is not of a setting of the domain's world.
    """
    changes = assigned(config.world)
    for name in changes:
        if name not in domain.engine_settings:
            names = ", ".join(domain.engine_settings) or "none"
            raise UserError(f"the world of {domain.name} has no such setting", f"world={name}", f"It has {names}.")
    return {**collected, **domain.world(changes)}


def make_engine(
    domain: Domain,
    world: Values,
    config: WorldConfig,
    environments: int,
    **begins: Any,
) -> Engine:
    """Return an engine of ``environments`` environments of a :func:`played_world`.

    ``begins`` are arguments that say where episodes begin. Raises ``UserError`` if the domain does not name the start,
    if there is a cap but the shortest path is not known, or if observations are mixed.
    """
    if config.start:
        check_start(domain, config.start)
        begins["start"] = config.start
    arguments = domain.world(world) | begins
    engine = domain.make_engine(
        config.layout_seed,
        environments,
        config.max_episode_steps,
        **arguments,
    )
    if keys := engine.observation_dtype.names:
        raise UserError(
            "agents see pictures or numbers, not both",
            ", ".join(keys),
            "Reward another library's agent by the members: hypogoal.SubgoalReward (docs/library.md).",
        )
    if config.cap:
        shortest = engine.shortest_path()
        if shortest is None:
            raise UserError("this layout's shortest path is not known", f"cap={config.cap:g}", "Give cap=0.")
        engine.max_steps = math.ceil(round(config.cap * shortest, 9))  # 1.1 * 50 is 55
    return engine


def check_start(domain: Domain, start: str) -> None:
    """Raise ``UserError`` if the domain does not name ``start``."""
    if start not in domain.starts:
        fault = "unknown start" if start else "where are episodes to begin?"
        raise UserError(fault, start or "start", f"Give --set start=X, X one of {', '.join(domain.starts)}.")


def columns_of(domain: Domain, sub_goals: Sequence[str], do: str = "Leave termination=oracle out.") -> list[int]:
    """Return the columns of ``sub_goals`` among the domain's sub-goals.

    Raises ``UserError``, which advises ``do``, if the domain lacks a sub-goal.
    """
    for sub_goal in sub_goals:
        if sub_goal not in domain.sub_goals:
            fault, names = f"{domain.name} does not know where this sub-goal holds", ", ".join(domain.sub_goals)
            raise UserError(fault, sub_goal, f"It knows of {names}. {do}")
    return [domain.sub_goals.index(sub_goal) for sub_goal in sub_goals]


def write_layout(
    folder: Path,
    engine: Engine,
    config: WorldConfig,
    seed: int,
    layouts: str = "",
) -> None:
    """Write ``layout.json``, which says how hard the layout is.

    The file has the layout's shortest path, and how often random play solves the task. A number is null if the engine
    does not know it. ``layouts`` is the setting that names several layouts.
    """
    success = engine.random_success(RANDOM_EPISODES, rng_for(seed, "random-play"))
    places = {"start": config.start, "layouts": layouts}
    facts = {
        **{name: place for name, place in places.items() if place},
        "layout_seed": config.layout_seed,
        "shortest_path": engine.shortest_path(),
        "random_success": success,
        "random_episodes": 0 if success is None else RANDOM_EPISODES,
    }
    (folder / "layout.json").write_text(json.dumps(facts) + "\n", encoding="utf-8")
