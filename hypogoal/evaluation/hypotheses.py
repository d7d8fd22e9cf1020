"""How good hypotheses are on layouts that no data came from, and how much members differ (Spec F1, F2, H1).

Also whatever their thresholds, and without the luck of picking the best; and which planted features they have found.
"""

import math
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from hypogoal.core.arrays import Bools, Doubles, Floats, Ints
from hypogoal.evaluation import plots
from hypogoal.evaluation.house import at_least, per_run, tidy, tidy_members
from hypogoal.evaluation.judging import Judged, Judgement, Work
from hypogoal.evaluation.page import Drawn, Results
from hypogoal.hypotheses import scores

TITLE = "Hypotheses"
HELDOUT = "heldout"
PLANTED = "planted_"  # begins the names of origins that say whether a state has a planted feature
OWNED_FROM, IGNORED_TO = 0.95, 0.6  # areas under the ROC curve
BY = ["method", "sub_goal"]
WHICH = ("best", "mean", "worst")
PAIRED = ("best", "mean")
KNOWN = ("ranking", "cross_fitted_ranking", "cross_fitted_accuracy", "at_best_threshold", "calibration_gap")


def look(work: Work, judgement: Judgement) -> Iterator[pd.DataFrame]:
    """Spec F1, F2: each member on held-out states, pooled over layouts, and how much members disagree."""
    split, judged = judgement.split, judgement.judged
    place = work.place_of(judgement)
    count = np.array(len(judged.unlabelled))
    columns = scores.member_scores(judged.predictions, split.labels)
    columns["threshold"] = judged.thresholds.astype(np.float64)
    columns["positive_unlabelled"] = scores.ratio(judged.unlabelled.sum(axis=0), count)
    numbers = {
        "states": len(split.labels),
        "positives": split.labels.sum(),
        "layouts": len(np.unique(split.origins.get("layout_seed", []))),
        "disagreement": scores.mean_disagreement(judged.predictions),
    }
    planted = {name: values for name, values in split.origins.items() if name.startswith(PLANTED)}
    if planted:
        numbers["coverage"] = coverage(judged.probabilities, planted)
    yield tidy_members(columns, **place, scope=HELDOUT)
    yield tidy(numbers, **place, scope=HELDOUT)
    yield tidy({"disagreement": scores.mean_disagreement(judged.unlabelled)}, **place, scope="unlabelled")
    yield from (rows.assign(**place) for rows in _knowledge_of(judgement))


def _knowledge_of(judgement: Judgement) -> Iterator[pd.DataFrame]:
    """What members know of contexts that training did not see."""
    labels, origins = judgement.split.labels, judgement.split.origins
    by_room = "seen" in origins
    unseen = origins["seen"] == 0 if by_room else np.full(len(labels), fill_value=True)
    contexts = origins.get("layout_seed", origins.get("room"))
    columns, crossed = knowledge(judgement.judged, unseen, labels, contexts)
    if by_room:  # ``rooms`` has their ranking
        del columns["ranking"]
    scope = "unseen" if by_room else HELDOUT
    yield tidy_members(columns, scope=scope)
    yield tidy(crossed, scope=scope)


def knowledge(
    judged: Judged,
    inside: Bools,
    labels: Bools,
    contexts: Ints | None,
) -> tuple[dict[str, Doubles], dict[str, float]]:
    """What K members know of the states ``inside``, (N,) like ``labels`` and ``contexts``, layouts or rooms.

    Returns of each member (K,) ``ranking``, ``at_best_threshold`` (balanced accuracy) and ``calibration_gap`` (how much
    of that its own threshold loses); and of the best member, picked on half of the contexts and scored on the other,
    ``cross_fitted_ranking`` and ``cross_fitted_accuracy``, NaN for fewer than two contexts.
    """

    def scored(where: Bools | Ints) -> tuple[Doubles, Doubles]:
        areas = scores.ranking(judged.probabilities[where], labels[where])
        return areas, scores.member_scores(judged.predictions[where], labels[where])["balanced_accuracy"]

    areas, accuracies = scored(inside)
    _, best = scores.best_threshold(judged.probabilities[inside], labels[inside])
    columns = {"ranking": areas, "at_best_threshold": best, "calibration_gap": best - accuracies}
    first = None if contexts is None else scores.halves(contexts[inside])
    if first is None:
        return columns, {"cross_fitted_ranking": math.nan, "cross_fitted_accuracy": math.nan}
    states = np.flatnonzero(inside)
    in_first, in_second = scored(states[first]), scored(states[~first])
    crossed = {
        "cross_fitted_ranking": scores.cross_fitted(in_first[0], in_second[0]),
        "cross_fitted_accuracy": scores.cross_fitted(in_first[1], in_second[1]),
    }
    return columns, crossed


def coverage(probabilities: Floats, planted: Mapping[str, Ints]) -> float:
    """Spec H1: the share of planted features (N,) that some member (N, K) has found: it ranks by it, and by no other.

    Every combination of features is equally frequent, so an area under the ROC curve of .5 is blindness to a feature.
    """
    areas = np.stack([scores.ranking(probabilities, values > 0) for values in planted.values()], axis=1)
    ranks = at_least(areas, OWNED_FROM)
    ignored = at_least(IGNORED_TO - 0.5, np.abs(areas - 0.5))
    alone = ignored.sum(axis=1, keepdims=True) == areas.shape[1] - 1
    return float((ranks & alone).any(axis=0).mean())


def runs(results: Results) -> pd.DataFrame:
    """The numbers of ensembles but those judged room by room, which ``rooms`` has."""
    by_room = results.of(scope="unseen")["artefact"]
    numbers = results.numbers[~results.numbers["artefact"].isin(by_room)]
    values = [per_run(numbers, "balanced_accuracy", scope=HELDOUT, member=which, name=which) for which in WHICH]
    values.append(per_run(numbers, *KNOWN, "coverage", scope=HELDOUT))
    for states in ("unlabelled", HELDOUT):
        values.append(per_run(numbers, "disagreement", scope=states, name=f"{{}}_{states}"))
    return pd.concat(values)


def figures(context: Mapping[str, Any]) -> Iterator[Drawn]:
    """Figure 3's quantity for one labelled context."""
    table = context["table"]
    means = table[table["quantity"].isin(WHICH)].pivot_table("mean", BY, "quantity", sort=False)
    if len(means):
        yield Drawn("members", "Members' balanced accuracy on held-out states", members_figure(means))


def members_figure(means: pd.DataFrame) -> Figure:
    """Balanced accuracy by method and sub-goal, the index of ``best``, ``mean`` and ``worst``: a range of members."""
    methods = plots.looks(means.index.unique("method"))
    sub_goals = means.index.unique("sub_goal")
    with plots.styled():
        figure, axes = plots.plot(1.2 + len(sub_goals) * max(0.42, 0.2 * len(methods)))
        for index, (method, look) in enumerate(methods.items()):
            rows = means.loc[method].reindex(sub_goals)
            y = np.arange(len(rows)) + 0.6 * index / len(methods)
            below, beyond = rows["mean"] - rows["worst"], rows["best"] - rows["mean"]
            points = look | {"linestyle": "none", "marker": "o"}
            axes.errorbar(rows["mean"], y, xerr=[below, beyond], capsize=3, label=method, **points)
        axes.axvline(0.5, **plots.DOTTED)
        axes.set_yticks(range(len(sub_goals)), sub_goals)
        axes.invert_yaxis()
        axes.set_xlabel("balanced accuracy on held-out states")
        plots.legend_below(figure, [axes], 3)
    return figure
