"""How good hypotheses are on layouts that no data came from, and how much members differ (Spec F1, F2, H1).

Also whatever their thresholds, and without the luck of picking the best; and which planted features they have found.
"""

from collections.abc import Iterator, Mapping

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from hypogoal.core.arrays import (
    Bools,
    Doubles,
    Floats,
    Ints,
)
from hypogoal.evaluation import plots
from hypogoal.evaluation.house import (
    at_least,
    per_run,
    tidy,
    tidy_members,
)
from hypogoal.evaluation.judging import Judged
from hypogoal.evaluation.page import Drawn
from hypogoal.hypotheses import scores

TITLE = "Hypotheses"
HELDOUT = "heldout"
# Where held-out states say which rooms training saw, the values of their origin ``seen``: its room was in no training
# set, among the unlabelled states, or among the labelled ones.
SCOPES = {"unseen": (0,), "all": (0, 1, 2), "labelled": (2,)}
VALIDATION = "labelled"
VALIDATED = "validated_member"  # the quantity that is its number
PLANTED = "planted_"  # begins the names of origins that say whether a state has a planted feature
OWNED_FROM, IGNORED_TO = 0.95, 0.6  # areas under the ROC curve
BY = ["method", "sub_goal"]
WHICH = ("best", "mean", "worst")
PAIRED = ("best", "mean")
CROSS_FITTED = ("cross_fitted_ranking", "cross_fitted_accuracy")
KNOWN = ("ranking", *CROSS_FITTED, "at_best_threshold", "calibration_gap")


def look(work, judgement):
    """Spec F1, F2: what members know and how much they disagree, and which one labelled rooms pick."""
    place = work.place_of(judgement)
    labels, origins = judgement.split.labels, judgement.split.origins
    for rows in rows_of(judgement.judged, labels, origins):
        yield rows.assign(**place)
    if "seen" in origins:
        picked = choose(judgement.judged.predictions, labels, origins["seen"])
        of_ensemble = work.validated.setdefault(judgement.case.ensemble.resolve(), {})
        of_ensemble[judgement.sub_goal] = picked[VALIDATED]
        yield tidy(picked, **place, scope=VALIDATION)


def rows_of(
    judged: Judged,
    labels: Bools,
    origins: Mapping[str, Ints],
) -> Iterator[pd.DataFrame]:
    """Spec F1, F2: K members on N held-out states, in each scope: all, or by whether training saw the room.

    ``origins`` (N,) may be ``seen`` (see ``SCOPES``), ``room``, ``layout_seed``, and planted features.
    """
    count = np.array(len(judged.unlabelled))
    members = {
        "threshold": judged.thresholds,
        "positive_unlabelled": scores.ratio(judged.unlabelled.sum(axis=0), count),
    }
    numbers = {
        "layouts": len(np.unique(origins.get("layout_seed", []))),
        "disagreement": scores.mean_disagreement(judged.predictions),
    }
    planted = {name: values for name, values in origins.items() if name.startswith(PLANTED)}
    if planted:
        numbers["coverage"] = coverage(judged.probabilities, planted)
    yield tidy_members(members, scope=HELDOUT)
    yield tidy(numbers, scope=HELDOUT)
    yield tidy({"disagreement": scores.mean_disagreement(judged.unlabelled)}, scope="unlabelled")
    scopes = {HELDOUT: labels | True}
    if "seen" in origins:
        scopes = {scope: np.isin(origins["seen"], values) for scope, values in SCOPES.items()}
    for scope, inside in scopes.items():
        columns = scores.member_scores(judged.predictions[inside], labels[inside])
        columns["ranking"] = scores.ranking(judged.probabilities[inside], labels[inside])
        counts = {"states": inside.sum(), "positives": labels[inside].sum()}
        if "room" in origins:
            counts["rooms"] = len(np.unique(origins["room"][inside]))
        yield tidy_members(columns, scope=scope)
        yield tidy(counts, scope=scope)
    scope, inside = next(iter(scopes.items()))
    contexts = origins.get("layout_seed", origins.get("room"))
    columns, crossed = knowledge(judged, inside, labels, contexts)
    yield tidy_members(columns, scope=scope)
    yield tidy(crossed, scope=scope)


def knowledge(
    judged: Judged,
    inside: Bools,
    labels: Bools,
    contexts: Ints | None,
) -> tuple[dict[str, Doubles], dict[str, float]]:
    """What K members know of the states ``inside``, (N,) like ``labels`` and ``contexts``, layouts or rooms.

    Returns of each member (K,) ``at_best_threshold`` (balanced accuracy) and ``calibration_gap`` (how much of that its
    own threshold loses); and of the best member, picked on half of the contexts and scored on the other,
    ``CROSS_FITTED``; nothing for fewer than two contexts.
    """

    def scored(states):
        areas = scores.ranking(judged.probabilities[states], labels[states])
        of_members = scores.member_scores(judged.predictions[states], labels[states])
        return areas, of_members["balanced_accuracy"]

    _, accuracies = scored(inside)
    _, best = scores.best_threshold(judged.probabilities[inside], labels[inside])
    columns = {"at_best_threshold": best, "calibration_gap": best - accuracies}
    first = None if contexts is None else scores.halves(contexts[inside])
    if first is None:
        return columns, {}
    states = np.flatnonzero(inside)
    crossed = map(scores.cross_fitted, scored(states[first]), scored(states[~first]))
    return columns, dict(zip(CROSS_FITTED, crossed, strict=True))


def choose(
    predictions: Bools,
    labels: Bools,
    seen: Ints,
) -> dict[str, float | None]:
    """Spec F1: the member with the highest balanced accuracy on rooms of labelled groups; ``validation``: that.

    The first of equally good ones, since their order is random; None where those rooms lack a class.
    """
    inside = np.isin(seen, SCOPES[VALIDATION])
    accuracies = scores.member_scores(predictions[inside], labels[inside])["balanced_accuracy"]
    best, _ = scores.most_and_least(accuracies)
    return {VALIDATED: best, "validation": None if best is None else accuracies[best]}


def coverage(probabilities: Floats, planted: Mapping[str, Ints]) -> float:
    """Spec H1: the share of planted features (N,) that some member (N, K) has found: it ranks by it, and by no other.

    Every combination of features is equally frequent, so an area under the ROC curve of .5 is blindness to a feature.
    """
    areas = np.stack(
        [scores.ranking(probabilities, values > 0) for values in planted.values()],
        axis=1,
    )
    ranks = at_least(areas, OWNED_FROM)
    ignored = at_least(IGNORED_TO - 0.5, np.abs(areas - 0.5))
    alone = ignored.sum(axis=1, keepdims=True) == areas.shape[1] - 1
    return float((ranks & alone).any(axis=0).mean())


def runs(results):
    """The numbers of ensembles but those judged room by room, which ``rooms`` has."""
    by_room = results.of(scope="unseen")["artefact"]
    numbers = results.numbers[~results.numbers["artefact"].isin(by_room)]
    values = [
        per_run(
            numbers,
            "balanced_accuracy",
            scope=HELDOUT,
            member=which,
            name=which,
        )
        for which in WHICH
    ]
    values.append(per_run(numbers, *KNOWN, "coverage", scope=HELDOUT))
    for states in ("unlabelled", HELDOUT):
        values.append(per_run(numbers, "disagreement", scope=states, name=f"{{}}_{states}"))
    return pd.concat(values)


def figures(context):
    """Figure 3's quantity for one labelled context."""
    table = context["table"]
    means = table[table["quantity"].isin(WHICH)].pivot_table("mean", BY, "quantity", sort=False)
    if len(means):
        yield Drawn(
            "members",
            "Members' balanced accuracy on held-out states",
            members_figure(means),
        )


def members_figure(means: pd.DataFrame) -> Figure:
    """Balanced accuracy by method and sub-goal, the index of ``best``, ``mean`` and ``worst``: a range of members."""
    wide = means.unstack("method", sort=False)
    ranges = np.stack([wide["mean"] - wide["worst"], wide["best"] - wide["mean"]])
    with plots.styled():
        height = 1 + 0.2 * wide["mean"].size
        figure, axes = plots.bars("barh", wide["mean"], height, xerr=ranges.transpose(2, 0, 1))
        axes.axvline(0.5, **plots.DOTTED)
        axes.invert_yaxis()
        axes.set(xlabel="balanced accuracy on held-out states", ylabel="")
    return figure
