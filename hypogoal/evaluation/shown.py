"""What of an evaluation is looked at rather than counted: states, attributions, stops (Spec F2, F4, F7)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hypogoal.dataset import Split
from hypogoal.domains.base import Domain
from hypogoal.evaluation.arrays import write_attributions, write_states, write_stops
from hypogoal.evaluation.distance import ORACLE, Executions
from hypogoal.evaluation.examples import pick_examples, pick_to_explain
from hypogoal.evaluation.ladders import rooms_shown
from hypogoal.evaluation.rooms import method_rank
from hypogoal.evaluation.saliency import deep_lift, explanation, mean_state
from hypogoal.hypotheses.ensemble import Ensemble
from hypogoal.hypotheses.views import positions_of


@dataclass(frozen=True)
class Unlabelled:
    """Unlabelled states: observations uint8 (M, H, W, C), positions int64 (M, 3) where they are known."""

    observations: NDArray[np.uint8]
    positions: NDArray[np.int64] | None


def show_states(
    ensemble: Ensemble,
    sub_goal: str,
    split: Split,
    judged: tuple[NDArray[np.float32], NDArray[np.bool_]],
    unlabelled: Unlabelled,
    arrays: Any,
) -> dict[str, Any]:
    """Example states and attributions of one sub-goal; from unseen rooms where there are positives in them.

    Args:
        ensemble: whose members.
        sub_goal: its name.
        split: the held-out states.
        judged: every member's probabilities and verdicts on them, (N, K) each.
        unlabelled: the mean of what members see of them is the attributions' baseline.
        arrays: ``examples/<sub-goal>`` and ``saliency/<sub-goal>`` are written into it.

    Returns:
        What is said of the attributions (see ``saliency.explanation``).
    """
    strange = split.origins.get("seen", np.zeros(len(split.labels), dtype=np.int64)) == 0
    among = np.flatnonzero(strange) if split.labels[strange].any() else np.arange(len(strange))
    labels, probabilities, verdicts = split.labels[among], judged[0][among], judged[1][among]
    examples = pick_examples(probabilities, labels, verdicts=verdicts)
    explained = pick_to_explain(probabilities, verdicts, labels)
    for name, picked in (("examples", examples), ("saliency", explained)):
        picked = [(int(among[index]), kind) for index, kind in picked]
        write_states(arrays.create_group(f"{name}/{sub_goal}"), picked, split, *judged)
    if not explained:
        return {"sub_goal": sub_goal, "states": []}
    index = among[[index for index, _ in explained]]
    positions = positions_of(split.origins)
    seen = ensemble.see(split.observations[index], None if positions is None else positions[index])
    baseline = mean_state(ensemble.see(unlabelled.observations, unlabelled.positions))
    found = deep_lift(ensemble, seen, baseline)
    write_attributions(arrays[f"saliency/{sub_goal}"], found, seen, baseline)
    return {"sub_goal": sub_goal, "states": explanation(found, explained)}


def show_stops(
    rows: Sequence[Mapping[str, Any]],
    ladders: Sequence[str],
    executions: Mapping[str, Executions],
    domain: Domain | None,
    arrays: Any,
) -> list[dict[str, Any]]:
    """Figure 5's material: for each ladder and N the best members' stops of the first seed, and pictures of the rooms.

    Args:
        rows: of ``distance.ladder_numbers``, with path, method, groups, ladder and seed.
        ladders: in their order.
        executions: by path.
        domain: draws its rooms, where it can.
        arrays: ``stops/<path>/<option>`` and ``pictures/<room>`` are written into it.

    Returns:
        Per figure ladder, groups, seed, rooms and columns; none where the domain has no pictures.
    """
    if domain is None or not domain.pictures:
        return []
    first = min((row["seed"] for row in rows), default=0)
    numbers = sorted({row["groups"] for row in rows if row["groups"] is not None}) or [None]
    shown = []
    for ladder in ladders:
        here = [row for row in rows if row["ladder"] == ladder and row["seed"] == first and row["best"] is not None]
        here.sort(key=lambda row: method_rank(row["method"]))
        for groups in numbers:
            columns, where = [], []
            for row in here:
                if row["groups"] != groups and not row["method"].startswith(ORACLE):
                    continue
                best = row["options"][row["best"]]
                stops = executions[row["path"]].of(best["option"])
                write_stops(arrays, row["path"], best["option"], stops, domain.pixel)
                columns.append({key: row[key] for key in ("path", "method", "sub_goal")} | best)
                where.append(stops.room)
            if columns:
                about = {
                    "ladder": ladder,
                    "groups": groups,
                    "seed": first,
                    "rooms": rooms_shown(where, domain.rooms_of(ladder)),
                }
                shown.append({**about, "columns": columns})
    for room in sorted({room for one in shown for room in one["rooms"]}):
        arrays[f"pictures/{room}"] = domain.picture(room)
    return shown
