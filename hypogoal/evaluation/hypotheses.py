"""How good hypotheses are on layouts that no data came from, and how much members differ (Spec F1, F2, H1).

Also whatever their thresholds, and without the luck of picking the best; and which planted features they have found.
"""

import math
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from numpy.typing import NDArray

from hypogoal.evaluation.house import at_least, over, pairs, per_run, tidy, tidy_members
from hypogoal.evaluation.judging import Judged, Judgement, Work
from hypogoal.evaluation.page import Drawn, Results, displayed, mean, pairs_displayed, spans, spread
from hypogoal.evaluation.plots import GREY, MARKERS, PALETTE, legend_below, plot, styled
from hypogoal.hypotheses.scores import best_threshold, cross_fitted, halves, mean_disagreement, member_scores, ranking

TITLE = "Hypotheses"
WHICH = ("best", "mean", "worst")
HELDOUT = "heldout"
PLANTED = "planted_"  # begins the names of origins that say whether a state has a planted feature
OWNED_FROM, IGNORED_TO = 0.95, 0.6  # areas under the ROC curve
BY = {"method": "ensemble", "sub_goal": "sub-goal"}
COLUMNS = {which: (which, spread(3)) for which in WHICH} | {"disagree": ("disagreement_heldout", spread(3))}
KNOWN = ("ranking", "cross_fitted_ranking", "cross_fitted_accuracy", "at_best_threshold", "calibration_gap")


def look(work: Work, judgement: Judgement) -> Iterator[pd.DataFrame]:
    """Spec F1, F2: each member on held-out states, pooled over layouts, and how much members disagree."""
    split, judged = judgement.split, judgement.judged
    place = work.place_of(judgement)
    unlabelled = judged.unlabelled
    if len(unlabelled):
        positive = unlabelled.mean(axis=0)
    else:
        positive = np.full(unlabelled.shape[1], math.nan)
    columns = {"positive_unlabelled": positive, "threshold": judged.thresholds.astype(np.float64)}
    columns |= member_scores(judged.predictions, split.labels)
    yield tidy_members(columns, **place, scope=HELDOUT)
    counts = {
        "states": len(split.labels),
        "positives": int(split.labels.sum()),
        "layouts": len(np.unique(split.origins.get("layout_seed", []))),
        "disagreement": mean_disagreement(judged.predictions),
    }
    yield tidy(counts, **place, scope=HELDOUT)
    yield tidy({"disagreement": mean_disagreement(unlabelled)}, **place, scope="unlabelled")
    yield from _knowledge_of(judgement, place)
    planted = {name.removeprefix(PLANTED): values for name, values in split.origins.items() if name.startswith(PLANTED)}
    if planted:
        yield tidy({"coverage": coverage(judged.probabilities, planted)}, **place, scope=HELDOUT)


def _knowledge_of(judgement: Judgement, place: Mapping[str, Any]) -> Iterator[pd.DataFrame]:
    """What members know of contexts that training did not see."""
    origins = judgement.split.origins
    by_room = "seen" in origins
    unseen = origins["seen"] == 0 if by_room else np.ones(len(judgement.split.labels), dtype=np.bool_)
    contexts = next((origins[name][unseen] for name in ("layout_seed", "room") if name in origins), None)
    columns, crossed = knowledge(judgement.judged, unseen, judgement.split.labels, contexts)
    if by_room:  # ``rooms`` has their ranking
        del columns["ranking"]
    scope = "unseen" if by_room else HELDOUT
    yield tidy_members(columns, **place, scope=scope)
    yield tidy(crossed, **place, scope=scope)


def knowledge(
    judged: Judged, inside: NDArray[np.bool_], labels: NDArray[np.bool_], contexts: NDArray[np.int64] | None
) -> tuple[dict[str, NDArray[np.float64]], dict[str, float]]:
    """What K members know of the states ``inside`` (N,), n of them; ``contexts`` (n,): layouts or rooms.

    Returns of each member (K,) ``ranking``, ``at_best_threshold`` (balanced accuracy) and ``calibration_gap`` (how much
    of that its own threshold loses); and of the best member, picked on half of the contexts and scored on the other,
    ``cross_fitted_ranking`` and ``cross_fitted_accuracy``, NaN for fewer than two contexts.
    """
    probabilities, predictions = judged.probabilities[inside], judged.predictions[inside]
    labels = labels[inside]
    accuracy = member_scores(predictions, labels)["balanced_accuracy"]
    best = best_threshold(probabilities, labels)[1]
    columns = {
        "ranking": ranking(probabilities, labels),
        "at_best_threshold": best,
        "calibration_gap": best - accuracy,
    }
    first = None if contexts is None else halves(contexts)
    if first is None:
        return columns, {"cross_fitted_ranking": math.nan, "cross_fitted_accuracy": math.nan}
    ranked, accuracies = [], []
    for half in (first, ~first):
        ranked.append(ranking(probabilities[half], labels[half]))
        accuracies.append(member_scores(predictions[half], labels[half])["balanced_accuracy"])
    crossed = {"cross_fitted_ranking": cross_fitted(*ranked), "cross_fitted_accuracy": cross_fitted(*accuracies)}
    return columns, crossed


def coverage(probabilities: NDArray[np.float32], planted: Mapping[str, NDArray[np.int64]]) -> float:
    """Spec H1: the share of planted features (N,) that some member (N, K) has found: it ranks by it, and by no other.

    Every combination of features is equally frequent, so an area under the ROC curve of .5 is blindness to a feature.
    """
    areas = np.stack([ranking(probabilities, values > 0) for values in planted.values()], axis=1)
    ranks = at_least(areas, OWNED_FROM)
    ignored = at_least(IGNORED_TO - 0.5, np.abs(areas - 0.5))
    owned = ranks & (ignored.sum(axis=1, keepdims=True) == areas.shape[1] - 1)
    return float(owned.any(axis=0).mean())


def of_layouts(results: Results) -> pd.DataFrame:
    """The numbers of ensembles but those judged room by room, which ``rooms`` has."""
    numbers = results.of(scope=[HELDOUT, "unlabelled"])
    return numbers[~numbers["artefact"].isin(results.of(scope="unseen")["artefact"])]


def tables(results: Results) -> dict[str, pd.DataFrame]:
    """Per kind of ensemble and sub-goal, over seeds; the first against the others."""
    numbers = of_layouts(results)
    accuracies = [per_run(numbers, "balanced_accuracy", HELDOUT, which, which) for which in WHICH]
    others = [per_run(numbers, name, HELDOUT) for name in (*KNOWN, "coverage")]
    others.append(per_run(numbers, "disagreement", HELDOUT, name="disagreement_heldout"))
    others.append(per_run(numbers, "disagreement", "unlabelled", name="disagreement_unlabelled"))
    runs = pd.concat([*accuracies, *others])
    return {"hypotheses": over(runs, ["method", "sub_goal"]), "hypotheses-pairs": pairs(compared(results))}


def compared(results: Results) -> pd.DataFrame:
    """The numbers of runs by which ensembles are compared."""
    numbers = of_layouts(results)
    parts = []
    for which in ("best", "mean"):
        name = f"balanced accuracy, {which} member"
        parts.append(per_run(numbers, "balanced_accuracy", HELDOUT, which, name))
    return pd.concat(parts)


def context(results: Results) -> dict[str, Any] | None:
    """For the template: the members' table, pairs, and whether held-out states are of layouts."""
    if of_layouts(results).empty:
        return None
    computed = tables(results)
    more = {
        "disagree, unlabelled": ("disagreement_unlabelled", spread(3)),
        "ranking": ("ranking", spread(3)),
        "ranking, cross-fitted best": ("cross_fitted_ranking", spread(3)),
        "cross-fitted best": ("cross_fitted_accuracy", spread(3)),
        "at best threshold": ("at_best_threshold", spread(3)),
    }
    has_coverage = (computed["hypotheses"]["quantity"] == "coverage").any()
    first = COLUMNS | ({"coverage": ("coverage", spread(2))} if has_coverage else {})
    printed = {title: (quantity, mean(3)) for title, (quantity, _) in COLUMNS.items()}
    return {
        "table": displayed(computed["hypotheses"], BY, first),
        "more": displayed(computed["hypotheses"], BY, more),
        "printed": displayed(computed["hypotheses"], BY, printed),
        "pairs": pairs_displayed(computed["hypotheses-pairs"], {}),
        "has_layouts": bool(results.of(quantity="layouts")["value"].max() > 0),
        "seeds": spans(of_layouts(results)["seed"]),
    }


def figures(results: Results) -> Iterator[Drawn]:
    """Figure 3's quantity for one labelled context."""
    if of_layouts(results).empty:
        return
    table = tables(results)["hypotheses"]
    if table["quantity"].isin(WHICH).any():
        yield Drawn("members", "Members' balanced accuracy on held-out states", members_figure(table))


def members_figure(table: pd.DataFrame) -> Figure:
    """Balanced accuracy by sub-goal and kind of ensemble: the best member filled, a bar the mean, hollow the worst."""
    means = table[table["quantity"].isin(WHICH)].pivot_table(
        index=["method", "sub_goal"], columns="quantity", values="mean", sort=False
    )
    sub_goals = list(means.index.unique("sub_goal"))
    methods = list(means.index.unique("method"))
    step = 0.8 / len(methods)
    with styled():
        figure, axes = plot(1.2 + len(sub_goals) * max(0.42, 0.2 * len(methods)))
        for index, method in enumerate(methods):
            values = means.loc[method].reindex(sub_goals)
            y = np.arange(len(sub_goals)) + (index - (len(methods) - 1) / 2) * step
            colour, marker = PALETTE[index % len(PALETTE)], MARKERS[index % len(MARKERS)]
            axes.hlines(y, values["worst"], values["best"], color=colour, linewidth=1.6, alpha=0.6)
            axes.plot(values["best"], y, marker, color=colour, markersize=7, label=method)
            axes.plot(values["mean"], y, "|", color=colour, markersize=10, markeredgewidth=1.8)
            axes.plot(values["worst"], y, marker, color=colour, markersize=5, fillstyle="none")
        axes.axvline(0.5, color=GREY, linewidth=1.2, linestyle=":")
        axes.set_yticks(range(len(sub_goals)), sub_goals)
        axes.invert_yaxis()
        axes.grid(visible=False, axis="y")
        axes.set_xlim(min(0.45, means["worst"].min() - 0.03), 1.02)
        axes.set_xlabel("balanced accuracy on held-out states")
        legend_below(figure, [axes], 3)
    return figure
