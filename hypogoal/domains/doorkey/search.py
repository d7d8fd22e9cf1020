"""The search for the states of DoorKey layouts that can be reached."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from hypogoal.core.arrays import Ints
from hypogoal.domains.doorkey.rules import SEARCHED

if TYPE_CHECKING:
    from hypogoal.domains.doorkey.engine import DoorKeyEngine


def search(engine: DoorKeyEngine, starts: Ints) -> tuple[Ints, Ints, Ints]:
    """Search breadth-first for all states reachable from ``starts``, ids (n,).

    Returns the states' ids, nearest first, int64 (N,); the steps to each state, int64 (N,); and the states after
    each action of ``SEARCHED``, int64 (N, A).

    The search stops at states in which the episode ends, and every action is taken to lead back to such a state.
    The search never drops a key, which leaves a few thousand states per layout instead of some ten million.
    """
    frontier = starts
    rings: list[Ints] = []
    ways: list[Ints] = []
    seen = np.zeros(engine.n_states, bool)
    seen[starts] = True
    while len(frontier):
        going_on = ~engine.is_final(frontier)
        following = np.repeat(frontier[:, None], len(SEARCHED), axis=1)
        origin = following[going_on]
        actions = np.broadcast_to(SEARCHED, origin.shape)
        reached = engine.follow(origin.ravel(), actions.ravel())
        following[going_on] = reached.reshape(origin.shape)
        rings.append(frontier)
        ways.append(following)
        seen.resize(engine.n_states, refcheck=False)  # new states get False
        nearest = np.unique(reached)
        frontier = nearest[~seen[nearest]]
        seen[frontier] = True
    steps = np.repeat(np.arange(len(rings)), [*map(len, rings)])
    return np.concatenate(rings), steps, np.concatenate(ways)
