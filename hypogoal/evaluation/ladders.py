"""A run's ladders: what its options are called, which rooms are drawn, and what is not there (Spec F1, F3, F4)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hypogoal.evaluation.distance import ORACLE
from hypogoal.evaluation.naming import name_apart

NOT_A_METHOD = frozenset({"start", "domain_config", "termination", "members"})  # settings said elsewhere
METHODS = {"dbat": "D-BAT", "no diversity": "an ensemble without diversity", "single CNN": "a single CNN"}
ROOMS_SHOWN = 3


def ladder_names(
    methods: Sequence[str], groups: Sequence[int | None], configs: Sequence[Mapping[str, Any]]
) -> list[str]:
    """Names of options by their ensemble's method; where their own settings differ at one N, those are added.

    Args:
        methods: n names.
        groups: n numbers N.
        configs: n resolved settings of ``train-options``.
    """
    names = list(methods)
    for own in set(groups):
        here = [index for index, value in enumerate(groups) if value == own]
        told = [{key: configs[index][key] for key in configs[index] if key not in NOT_A_METHOD} for index in here]
        for index, name in zip(here, name_apart([methods[index] for index in here], told), strict=True):
            names[index] = name
    return names


def rooms_shown(where: Sequence[NDArray[np.int64]], own: Sequence[int] = ()) -> list[int]:
    """Figure 5: the rooms that are drawn: the ladder's own, then those in which the most executions stopped.

    Args:
        where: per option the rooms of its stops, (n,).
        own: the ladder's rooms, from the top down.
    """
    rooms, counts = np.unique(np.concatenate([np.zeros(0, np.int64), *where]), return_counts=True)
    often = rooms[np.argsort(-counts, kind="stable")]
    return [*own, *(int(room) for room in often if room not in own)][: max(ROOMS_SHOWN, len(own))]


def missing_ladders(rooms: Sequence[Mapping[str, Any]], options: Sequence[Mapping[str, Any]]) -> list[str]:
    """Spec F1, F3, F4: the comparisons that are not there.

    Args:
        rooms: rows of ``rooms.rooms_table``.
        options: rows of ``distance.ladder_numbers``, with ``method`` and ``groups``.
    """
    lines = []
    for start, name in METHODS.items():
        if not any(row["method"].startswith(start) for row in rooms):
            lines.append(f"no ensemble artefact of {name} (Figure 3)")
    if not options:
        return [*lines, "no options artefact of a ladder (Figures 4 and 5)"]
    for start, name in METHODS.items():
        if not any(row["method"].startswith(start) for row in options):
            lines.append(f"no options artefact of {name} (Figures 4 and 5)")
    if not any(row["method"].startswith(ORACLE) for row in options):
        lines.append("no options artefact with oracle terminations beside them")
    return lines
