"""An ensemble's members on held-out layouts, and groups of ensembles over seeds (Spec F1, F2)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hypogoal.core.seeding import rng_for
from hypogoal.evaluation.accuracy import METRICS, best_mean_worst, member_scores, scores_by_layout
from hypogoal.evaluation.disagreement import mean_disagreement, pairwise_disagreement
from hypogoal.evaluation.naming import name_apart
from hypogoal.evaluation.statistics import aggregate


def sub_goal_metrics(
    sub_goal: str,
    heldout: NDArray[np.bool_],
    labels: NDArray[np.bool_],
    layout_seeds: NDArray[np.int64] | None,
    unlabelled: NDArray[np.bool_],
) -> dict[str, Any]:
    """Spec F1, F2: one sub-goal's members.

    Args:
        sub_goal: its name.
        heldout: verdicts bool (N, K) on held-out states.
        labels: bool (N,), theirs.
        layout_seeds: int (N,), where known.
        unlabelled: verdicts bool (M, K) on unlabelled states.

    Returns:
        Scores of every member, pooled over layouts and per layout; best, mean and worst balanced accuracy; the mean
        disagreement of two members on either set of states, and that of every pair.
    """
    scores = member_scores(heldout, labels)
    members = heldout.shape[1]
    rows = [
        {
            "member": member,
            **{name: float(scores[name][member]) for name in METRICS},
            "says_yes_unlabelled": float(unlabelled[:, member].mean()) if len(unlabelled) else float("nan"),
        }
        for member in range(members)
    ]
    by_layout = []
    if layout_seeds is not None:
        for seed, own in scores_by_layout(heldout, labels, layout_seeds).items():
            here = layout_seeds == seed
            by_layout.append(
                {
                    "layout_seed": seed,
                    "states": int(here.sum()),
                    "positives": int(labels[here].sum()),
                    "balanced_accuracy": own["balanced_accuracy"].tolist(),
                }
            )
    return {
        "sub_goal": sub_goal,
        "states": len(labels),
        "positives": int(labels.sum()),
        "members": rows,
        "balanced_accuracy": best_mean_worst(scores["balanced_accuracy"]),
        "by_layout": by_layout,
        "disagreement": {
            "unlabelled": mean_disagreement(unlabelled),
            "heldout": mean_disagreement(heldout),
            "pairs": _pairs(unlabelled, heldout),
        },
    }


def _pairs(unlabelled: NDArray[np.bool_], heldout: NDArray[np.bool_]) -> list[dict[str, Any]]:
    rates = pairwise_disagreement(unlabelled), pairwise_disagreement(heldout)
    members = heldout.shape[1]
    return [
        {
            "members": [first, second],
            "unlabelled": float(rates[0][first, second]),
            "heldout": float(rates[1][first, second]),
        }
        for first in range(members)
        for second in range(first + 1, members)
    ]


def ensemble_name(config: Mapping[str, Any]) -> str:
    """How an ensemble is called in tables: its objective and its number of members.

    One that is told where the agent is, which no observation says, is called what it is: an oracle.
    """
    objective = "no diversity" if config["diversity"] == "none" else config["diversity"]
    name = "single CNN" if config["members"] == 1 else f"{objective}, K={config['members']}"
    told = config.get("view") == "agent-crop" and config.get("localiser") == "ram"
    return f"{name}, position oracle" if told else name


def ensemble_names(configs: Sequence[Mapping[str, Any]]) -> list[str]:
    """Names of ensembles; those whose settings differ are kept apart, settings without effect left out."""
    idle = {
        "single CNN": {"diversity", "diversity_weight", "schedule", "members"},
        "no diversity": {"diversity_weight"},
    }
    bases = [ensemble_name(config) for config in configs]
    told = [
        {key: value for key, value in config.items() if key not in idle.get(base.partition(",")[0], set())}
        for base, config in zip(bases, configs, strict=True)
    ]
    return name_apart(bases, told)


def hypotheses_table(ensembles: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Spec F1: per kind of ensemble and sub-goal: best, mean and worst member's balanced accuracy, over seeds.

    Args:
        ensembles: what was computed of each, with ``name`` and ``sub_goals`` (see :func:`sub_goal_metrics`). Those
            judged room by room are left out: their table is ``rooms.rooms_table``.
    """
    cells: dict[tuple[str, str], list[Mapping[str, Any]]] = {}
    for ensemble in ensembles:
        for row in ensemble["sub_goals"]:
            if "rooms" in row:
                continue
            cells.setdefault((ensemble["name"], row["sub_goal"]), []).append(row)
    table = []
    for (name, sub_goal), rows in cells.items():
        entry: dict[str, Any] = {"name": name, "sub_goal": sub_goal, "ensembles": len(rows)}
        for which in ("best", "mean", "worst"):
            values = [row["balanced_accuracy"][which] for row in rows]
            rng = rng_for(0, "bootstrap", name, sub_goal, which)
            entry[which] = aggregate(values, [0] * len(values), "balanced accuracy", rng)
        for states in ("unlabelled", "heldout"):
            values = [row["disagreement"][states] for row in rows]
            rng = rng_for(0, "bootstrap", name, sub_goal, states)
            entry[f"disagreement_{states}"] = aggregate(values, [0] * len(values), "share of states", rng)
        table.append(entry)
    return table
