"""Members on rooms that training did and did not see, for each number of labelled ladder groups (Spec F1, Figure 3).

The paper scores the best member on files that hold training rooms too, and picks it on the same files. Here every
score stands on unseen rooms and on all rooms, and beside the best member are the mean, the worst and the one that the
rooms of the labelled groups, the only ones whose labels were to be had, would have picked.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hypogoal.core.seeding import rng_for
from hypogoal.evaluation.accuracy import best_mean_worst, member_scores, ranking
from hypogoal.evaluation.ensembles import ensemble_names
from hypogoal.evaluation.statistics import aggregate_with_deviation

# Values of the origin ``seen`` of a held-out state: its room was in no training set, among the unlabelled states, or
# among the labelled ones.
SCOPES = {"unseen": (0,), "all": (0, 1, 2), "labelled": (2,)}
VALIDATION = "labelled"
TABLED = ("unseen", "all")  # scopes of the table and of Figure 3
FIGURE = ("balanced_accuracy", "accuracy")  # scores of the table
SCORED = (*FIGURE, "ranking")  # of which best, mean, ... are told
WHICH = ("best", "validated", "mean", "worst")


def room_metrics(
    verdicts: NDArray[np.bool_],
    labels: NDArray[np.bool_],
    origins: Mapping[str, NDArray[np.int64]],
    kinds: Sequence[str] = (),
    probabilities: NDArray[np.float32] | None = None,
) -> dict[str, Any]:
    """Spec F1: one ensemble's members by whether training saw the room.

    Args:
        verdicts: bool (N, K) on held-out states.
        labels: bool (N,), theirs.
        origins: int (N,) each: ``seen`` (see ``SCOPES``) and, where there are, ``room`` and ``kind``.
        kinds: names of the values of ``kind``.
        probabilities: float (N, K), what the verdicts were made of; without them there is no ``ranking``.

    Returns:
        ``scopes``: per scope its states, positives, rooms, every member's scores, and best, validated, mean and worst
        of accuracy, balanced accuracy and ``ranking`` (see ``accuracy.ranking``); ``validated``: which member the rooms
        of labelled groups pick; ``by_room``; ``false_positives``. NaN where not defined.
    """
    seen, rooms = origins["seen"], origins.get("room")
    validated = choose(verdicts, labels, seen)
    scopes = {}
    for name, values in SCOPES.items():
        inside = np.isin(seen, values)
        scores = member_scores(verdicts[inside], labels[inside])
        if probabilities is not None:
            scores["ranking"] = ranking(probabilities[inside], labels[inside])
        scopes[name] = {
            "states": int(inside.sum()),
            "positives": int(labels[inside].sum()),
            "rooms": [] if rooms is None else np.unique(rooms[inside]).tolist(),
            "members": [
                {"member": member, **{score: float(scores[score][member]) for score in scores}}
                for member in range(verdicts.shape[1])
            ],
            "scores": {
                score: with_validated(scores[score], validated["member"]) for score in SCORED if score in scores
            },
        }
    return {
        "scopes": scopes,
        "validated": validated,
        "by_room": [] if rooms is None else _by_room(verdicts, labels, rooms, seen),
        "false_positives": _false_positives(verdicts, labels, origins, kinds),
    }


def choose(
    verdicts: NDArray[np.bool_], labels: NDArray[np.bool_], seen: NDArray[np.int64]
) -> dict[str, int | float | None]:
    """Spec F1: the member with the highest balanced accuracy on held-out states in rooms of labelled groups.

    Members' order is chance, so of several equally good ones the first is taken; ``tied`` says how many there are.

    Returns:
        member (None where the rooms of labelled groups lack a class), validation (its balanced accuracy there), tied.
    """
    inside = np.isin(seen, SCOPES[VALIDATION])
    scores = member_scores(verdicts[inside], labels[inside])["balanced_accuracy"]
    if np.isnan(scores).all():
        return {"member": None, "validation": float("nan"), "tied": 0}
    best = float(np.nanmax(scores))
    return {"member": int(np.nanargmax(scores)), "validation": best, "tied": int((scores == best).sum())}


def with_validated(scores: NDArray[np.float64], validated: Any) -> dict[str, float]:
    """Best, mean and worst of the members' scores (K,), and that of the member ``validated``; NaN where none is."""
    return {**best_mean_worst(scores), "validated": float("nan") if validated is None else float(scores[validated])}


def _by_room(
    verdicts: NDArray[np.bool_], labels: NDArray[np.bool_], rooms: NDArray[np.int64], seen: NDArray[np.int64]
) -> list[dict[str, Any]]:
    rows = []
    for room in np.unique(rooms):
        here = rooms == room
        scores = member_scores(verdicts[here], labels[here])
        rows.append(
            {
                "room": int(room),
                "seen": int(seen[here].max()),
                "states": int(here.sum()),
                "positives": int(labels[here].sum()),
                **{score: scores[score].tolist() for score in ("balanced_accuracy", "accuracy", "recall")},
            }
        )
    return rows


def _false_positives(
    verdicts: NDArray[np.bool_],
    labels: NDArray[np.bool_],
    origins: Mapping[str, NDArray[np.int64]],
    names: Sequence[str],
) -> list[dict[str, Any]]:
    if "kind" not in origins:
        return []
    rows = []
    for scope in TABLED:
        inside = np.isin(origins["seen"], SCOPES[scope]) & ~labels
        for kind in np.unique(origins["kind"][inside]):
            these = inside & (origins["kind"] == kind)
            name = names[kind] if 0 <= kind < len(names) else str(kind)
            share = verdicts[these].mean(0).tolist()
            rows.append({"scope": scope, "kind": name, "negatives": int(these.sum()), "share": share})
    return rows


def groups_of(config: Mapping[str, Any]) -> int | None:
    """N, the number of labelled ladder groups that an ensemble's data have; None where its domain has no such thing."""
    found = (config.get("domain_config") or {}).get("groups")
    return found if isinstance(found, int) else None


def method_names(configs: Sequence[Mapping[str, Any]]) -> list[str]:
    """Names of ensembles as methods: as ``ensembles.ensemble_names``, with all N under one name."""
    alike = []
    for config in configs:
        inner = {key: value for key, value in (config.get("domain_config") or {}).items() if key != "groups"}
        alike.append({**config, "domain_config": inner})
    return ensemble_names(alike)


def rooms_table(ensembles: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Spec F1, F2: Figure 3: per method, N and sub-goal its members' scores and disagreement, over seeds.

    Args:
        ensembles: what was computed of each, with ``method``, ``groups`` and ``sub_goals``, those with ``rooms``.

    Returns:
        Rows with ``scores``: scope -> score -> best, validated, mean, worst (see
        ``statistics.aggregate_with_deviation``); ``positives`` and ``always_no`` (the accuracy
        of never saying yes) per scope; ``tied``: mean number of members
        among which the validation rooms could not tell; disagreement on unlabelled and held-out states.
    """
    cells: dict[tuple[str, int | None, str], list[Mapping[str, Any]]] = {}
    for ensemble in ensembles:
        for row in ensemble["sub_goals"]:
            if "rooms" in row:
                cells.setdefault((ensemble["method"], ensemble["groups"], row["sub_goal"]), []).append(row)
    table = []
    for (method, groups, sub_goal), rows in sorted(cells.items(), key=lambda item: _order(*item[0])):
        over = partial(_over_seeds, f"{method} {groups} {sub_goal}")
        scopes = [row["rooms"]["scopes"] for row in rows]
        table.append(
            {
                "method": method,
                "groups": groups,
                "sub_goal": sub_goal,
                "ensembles": len(rows),
                "positives": {scope: scopes[0][scope]["positives"] for scope in TABLED},
                "always_no": {scope: _always_no(scopes[0][scope]) for scope in TABLED},
                "scores": {
                    scope: {
                        score: {
                            which: over([own[scope]["scores"][score][which] for own in scopes], score, scope, which)
                            for which in WHICH
                        }
                        for score in SCORED
                        if all(score in own[scope]["scores"] for own in scopes)
                    }
                    for scope in TABLED
                },
                "tied": float(np.mean([row["rooms"]["validated"]["tied"] for row in rows])),
                **{
                    f"disagreement_{states}": over(
                        [row["disagreement"][states] for row in rows], "share of states", states
                    )
                    for states in ("unlabelled", "heldout")
                },
            }
        )
    return table


def _always_no(scope: Mapping[str, Any]) -> float:
    """The accuracy of never saying yes; NaN without states."""
    return 1 - scope["positives"] / scope["states"] if scope["states"] else float("nan")


def _over_seeds(cell: str, values: list[float], unit: str, *names: str) -> dict[str, Any]:
    return aggregate_with_deviation(values, [0] * len(values), unit, rng_for(0, "bootstrap", cell, unit, *names))


def method_rank(method: str) -> int:
    """The order of methods in tables and figures: the paper's method, its control, the single CNN, anything else."""
    starts = ("dbat", "divdis", "no diversity", "single CNN")
    return next((rank for rank, start in enumerate(starts) if method.startswith(start)), len(starts))


def _order(method: str, groups: int | None, sub_goal: str) -> tuple[str, int, str, int]:
    return sub_goal, method_rank(method), method, -1 if groups is None else groups
