"""Methods against each other, seed by seed (Spec F5): the first method of each table with each of the others.

A seed's layout, data and first weights are hard or easy for every method, so pairs that share them tell more than two
means; and the probability of improvement says how often, where a difference of means may be one run's.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from hypogoal.core.seeding import rng_for
from hypogoal.evaluation.distance import ORACLE
from hypogoal.evaluation.rooms import method_rank
from hypogoal.evaluation.statistics import compare_pairs

AGENTS = {"success": True, "length": False, "discounted_return": True}  # quantity -> the higher is better
MEMBERS = ("best", "mean")
ROOMS = ("best", "validated", "mean")
ALL = "all sub-goals"

# What was measured: method -> pair's key -> value. A key begins with what is alike (layout, sub-goal, ladder) and ends
# with the seed, and with how many of the same there were before: ensembles of other seeds may have options of one.
Values = dict[str, dict[tuple[Hashable, ...], float]]
Rows = list[dict[str, Any]]


def compare_agents(agents: Sequence[Mapping[str, Any]]) -> Rows:
    """Spec F5: the first agent with each other over runs alike in layout and seed; units are layouts.

    Args:
        agents: what ``agents.agent_metrics`` returns, in the report's order.
    """
    rows: Rows = []
    for quantity, higher in AGENTS.items():
        values: Values = {agent["name"]: {} for agent in agents}
        for agent in agents:
            for run in agent["runs"]:
                _add(values[agent["name"]], (run["layout_seed"], run["seed"]), run[quantity])
        rows += _against_first(values, quantity, "", higher, layouts=True)
    return rows


def compare_hypotheses(ensembles: Sequence[Mapping[str, Any]], *, ranked: bool = True) -> Rows:
    """Spec F1: kinds of ensembles by their members' balanced accuracy on held-out layouts, paired by seed.

    Args:
        ensembles: what was computed of each, see ``ensembles.hypotheses_table``; those judged by room are left out.
        ranked: the method that stands first is D-BAT where there is one; else the first that comes.

    Returns:
        Rows over all sub-goals that both have, and for each sub-goal by itself; units are seeds.
    """
    found: dict[str, Values] = {}
    for ensemble in sorted(ensembles, key=lambda one: method_rank(one["name"]) if ranked else 0):
        for goal in ensemble["sub_goals"]:
            if "rooms" not in goal:
                for which in MEMBERS:
                    own = found.setdefault(which, {}).setdefault(ensemble["name"], {})
                    _add(own, (goal["sub_goal"], ensemble["seed"]), goal["balanced_accuracy"][which])
    rows: Rows = []
    for which, values in found.items():
        quantity = f"balanced accuracy, {which} member"
        rows += _against_first(values, quantity, ALL, True)
        for sub_goal in dict.fromkeys(str(key[0]) for own in values.values() for key in own):
            part = {name: {key: own[key] for key in own if key[0] == sub_goal} for name, own in values.items()}
            rows += _against_first(part, quantity, sub_goal, True)
    return rows


def compare_rooms(ensembles: Sequence[Mapping[str, Any]], *, ranked: bool = True) -> Rows:
    """Spec F1: methods by their members' balanced accuracy on unseen rooms, at each N, paired by seed, which are units.

    Args:
        ensembles: what was computed of each; those not judged by room are left out.
        ranked: see :func:`compare_hypotheses`.
    """
    rows: Rows = []
    judged = [one for one in ensembles if any("rooms" in goal for goal in one["sub_goals"])]
    judged.sort(key=lambda one: method_rank(one["method"]) if ranked else 0)
    for groups in sorted({one["groups"] for one in judged}, key=lambda number: (number is None, number or 0)):
        for which in ROOMS:
            values: Values = {}
            for one in judged:
                for goal in one["sub_goals"]:
                    if one["groups"] == groups and "rooms" in goal:
                        score = goal["rooms"]["scopes"]["unseen"]["scores"]["balanced_accuracy"][which]
                        _add(values.setdefault(one["method"], {}), (goal["sub_goal"], one["seed"]), score)
            rows += _against_first(values, f"balanced accuracy on unseen rooms, {which} member", _group(groups), True)
    return rows


def compare_distances(options: Sequence[Mapping[str, Any]], *, ranked: bool = True) -> Rows:
    """Spec F3: methods by how near their members' options stop, at each N, paired by ladder and seed; units are seeds.

    The best member is the best on the executions that are compared, of more members the better: beside it stand the
    one that validation on the labelled rooms chooses, and the mean over members.

    Args:
        options: rows of ``distance.ladder_numbers`` with path, method, groups, ladder and seed. Oracle terminations
            have no N and no members to choose among; they are left out.
        ranked: see :func:`compare_hypotheses`.
    """
    rows: Rows = []
    learned = [one for one in options if not one["method"].startswith(ORACLE) and one["best"] is not None]
    learned.sort(key=lambda one: method_rank(one["method"]) if ranked else 0)
    for groups in sorted({one["groups"] for one in learned}, key=lambda number: (number is None, number or 0)):
        for which in ROOMS:
            values: Values = {}
            for one in learned:
                if one["groups"] == groups:
                    key = (one["ladder"], one["sub_goal"], one["seed"])
                    _add(values.setdefault(one["method"], {}), key, _distance(one, which))
            rows += _against_first(values, f"distance, {which} member", _group(groups), False)
    return rows


def _distance(one: Mapping[str, Any], which: str) -> float:
    """How far from a base the best, the validated or the mean member's option stops; NaN where there is none."""
    if which == "mean":
        known = [option["distance"] for option in one["options"] if not np.isnan(option["distance"])]
        return float(np.mean(known)) if known else float("nan")
    member = one[which]
    return float("nan") if member is None else float(one["options"][member]["distance"])


def _add(own: dict[tuple[Hashable, ...], float], key: tuple[Hashable, ...], value: float) -> None:
    """Another value: behind those of the same key, not in their place."""
    before = 0
    while (*key, before) in own:
        before += 1
    own[*key, before] = value


def _group(groups: int | None) -> str:
    return "" if groups is None else f"N={groups}"


def _against_first(
    values: Values, quantity: str, where: str, higher: bool, *, layouts: bool = False
) -> Iterable[dict[str, Any]]:
    """A row for each method after the first that shares a pair with it; units are layouts, or else seeds."""
    first, *others = values or ("",)
    for second in others:
        shared = [key for key in values[first] if key in values[second]]
        if not shared:
            continue
        own, other = (np.array([values[name][key] for key in shared], dtype=np.float64) for name in (first, second))
        rng = rng_for(0, "bootstrap", "pairs", first, second, quantity, where)
        units = [key[:1] if layouts else key[-2:] for key in shared]
        found = compare_pairs(own, other, units, rng, within=layouts, higher=higher)
        yield {"first": first, "second": second, "quantity": quantity, "where": where, "higher": higher, **found}
