"""How near executions of options come to their true sub-goals, where the domain knows them."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from hypogoal.core.arrays import Bools, Ints
from hypogoal.core.errors import UserError
from hypogoal.domains.base import Domain, Engine
from hypogoal.domains.world import columns_of
from hypogoal.meta.setup import Setup
from hypogoal.options.termination import ORACLE

Near = Callable[[Ints, Ints], Bools]
Distances = Callable[[Ints, Ints], Ints]


def nearness(setup: Setup, engine: Engine) -> Near | None:
    """Return a function of states (n,) and options (n,). It returns whether true sub-goals hold, or nearly, bool (n,).

    Returns None if the domain lacks a sub-goal of the ensemble, or if options end at true sub-goals. Raises
    ``UserError`` if the engine's labels are not bool (n, G).
    """
    domain, sub_goals = setup.domain, setup.source["sub_goals"]
    labels, shape = engine.labels(engine.ids[:1]), (1, len(domain.sub_goals))
    if labels.shape != shape or labels.dtype != bool:
        fault = f"the engine's labels of one state are {labels.dtype} {labels.shape}, not bool {shape}"
        raise UserError(fault, type(engine).__name__, "Give a truth value for each state and sub-goal.")
    if setup.config.termination == ORACLE or not set(sub_goals) <= set(domain.sub_goals):
        return None
    columns = np.repeat(columns_of(domain, sub_goals), setup.members)
    away = distances_of(domain, sub_goals, setup.members)

    def near(ids: Ints, options: Ints) -> Bools:
        holds = engine.labels(ids)[np.arange(len(ids)), columns[options]]
        if not (domain.measures and engine.position_names):
            return holds
        return holds | (away(engine.positions(ids), options) <= domain.near)

    return near


def distances_of(domain: Domain[Any], sub_goals: Sequence[str], members: int) -> Distances:
    """Return a function of positions (n, P) and options (n,). It returns distances to true sub-goals, int64 (n,)."""

    def away(positions: Ints, options: Ints) -> Ints:
        distances = np.zeros(len(options), int)
        for number, sub_goal in enumerate(sub_goals):
            of_goal = options // members == number
            distances[of_goal] = domain.distance_to(sub_goal, positions[of_goal])
        return distances

    return away
