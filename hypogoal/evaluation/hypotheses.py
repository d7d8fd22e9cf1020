"""How good hypotheses are on layouts that no data came from, and how much members differ.

Some numbers do not depend on the members' thresholds, or on the luck of picking the best member. Others say which
planted features the members have found.
"""

from collections.abc import Iterator, Mapping
from functools import partial
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from hypogoal.core.arrays import Bools, Doubles, Floats, Ints
from hypogoal.data import PLANTED
from hypogoal.evaluation import plots
from hypogoal.evaluation.judging import Judged
from hypogoal.evaluation.page import Drawn
from hypogoal.evaluation.statistics import at_least, tables_of
from hypogoal.evaluation.table import melted, per_run, tidy
from hypogoal.hypotheses import scores

TITLE = "Hypotheses"
HELDOUT = "heldout"
# Values of the origin ``seen``, which held-out states have if it is known which rooms training saw. 0: the room was in
# no training set; 1: the room is among the unlabelled states; 2: the room is among the labelled states.
SCOPES = {"unseen": (0,), "all": (0, 1, 2), "labelled": (2,)}
VALIDATION = "labelled"
VALIDATED = "validated_member"  # the quantity whose value is the number of that member
OWNED_FROM, IGNORED_TO = 0.95, 0.6  # areas under the ROC curve
BY = ["method", "sub_goal"]
WHICH = ("best", "mean", "worst")
PAIRED = ("best", "mean")
CROSS_FITTED = ("cross_fitted_ranking", "cross_fitted_accuracy")
KNOWLEDGE = ("ranking", *CROSS_FITTED, "at_best_threshold", "calibration_gap")


def look(work, judgement):
    """Yield rows on what members know, on how much they disagree, and on which member the labelled rooms pick."""
    place, judged = work.place_of(judgement), judgement.judged
    for rows in rows_of(judged):
        yield rows.assign(**place)
    if "seen" in judged.origins:
        picked = choose(judged.predictions, judged.labels, judged.origins["seen"])
        of_ensemble = work.validated.setdefault(judgement.artefact.path.resolve(), {})
        of_ensemble[judgement.sub_goal] = picked[VALIDATED]
        yield tidy(picked, **place, scope=VALIDATION)


def rows_of(judged: Judged) -> Iterator[pd.DataFrame]:
    """Yield the rows of K members on N held-out states, in each scope.

    The scopes are all states, or the states by whether training saw their room. Each planted feature is a scope, too,
    in which the feature is the truth.
    """
    labels, origins = judged.labels, judged.origins
    numbers = {
        "layouts": len(np.unique(origins.get("layout_seed", []))),
        "disagreement": scores.mean_disagreement(judged.predictions),
    }
    planted = {name: values for name, values in origins.items() if name.startswith(PLANTED)}
    if planted:
        numbers["coverage"] = coverage(judged.probabilities, planted)
    for name, values in planted.items():
        yield melted(scores.member_scores(judged.predictions, values > 0), scope=name)
    positive = pd.DataFrame(judged.unlabelled).mean()
    yield melted({"threshold": judged.thresholds, "positive_unlabelled": positive}, scope=HELDOUT)
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
        yield melted(columns, scope=scope)
        yield tidy(counts, scope=scope)
    scope, inside = next(iter(scopes.items()))
    contexts = origins.get("layout_seed", origins.get("room"))
    columns, crossed = knowledge(judged, inside, contexts)
    yield melted(columns, scope=scope)
    yield tidy(crossed, scope=scope)


def knowledge(judged: Judged, inside: Bools, contexts: Ints | None) -> tuple[dict[str, Doubles], dict[str, float]]:
    """Return what K members know of the states ``inside``, bool (N,).

    ``contexts`` (N,) are layouts or rooms. The first result has, for each member (K,), ``at_best_threshold`` (balanced
    accuracy) and ``calibration_gap``, which is how much of that balanced accuracy the member's own threshold loses. The
    second has ``CROSS_FITTED``, the scores of the best member, which is picked on half of the contexts and scored on
    the other half. The second is empty if there are fewer than two contexts.
    """

    def scored(states):
        labels = judged.labels[states]
        areas = scores.ranking(judged.probabilities[states], labels)
        return areas, scores.member_scores(judged.predictions[states], labels)["balanced_accuracy"]

    _, accuracies = scored(inside)
    _, best = scores.best_threshold(judged.probabilities[inside], judged.labels[inside])
    columns = {"at_best_threshold": best, "calibration_gap": best - accuracies}
    first = None if contexts is None else scores.halves(contexts[inside])
    if first is None:
        return columns, {}
    states = np.flatnonzero(inside)
    crossed = map(scores.cross_fitted, scored(states[first]), scored(states[~first]))
    return columns, dict(zip(CROSS_FITTED, crossed, strict=True))


def choose(predictions: Bools, labels: Bools, seen: Ints) -> dict[str, float | None]:
    """Return the member with the highest balanced accuracy on rooms of labelled groups, and that as ``validation``.

    Of equally good members, the first is picked, because their order is random. Both values are None if the rooms lack
    a class.
    """
    inside = np.isin(seen, SCOPES[VALIDATION])
    accuracies = scores.member_scores(predictions[inside], labels[inside])["balanced_accuracy"]
    best, _ = scores.most_and_least(accuracies)
    return {VALIDATED: best, "validation": None if best is None else accuracies[best]}


def coverage(probabilities: Floats, planted: Mapping[str, Ints]) -> float:
    """Return the share of planted features (N,) that some member (N, K) has found.

    A member has found a feature if it ranks states by this feature, and by no other. Every combination of features is
    equally frequent, so a member that is blind to a feature has an area under the ROC curve of .5. Returns NaN if some
    combination is missing, because a member that ranks by one feature then ranks by another, too.
    """
    holding = np.stack([values > 0 for values in planted.values()], axis=1)
    if len(np.unique(holding, axis=0)) < 2 ** len(planted):
        return float("nan")
    areas = np.stack([scores.ranking(probabilities, feature) for feature in holding.T], axis=1)
    ranks = at_least(areas, OWNED_FROM)
    ignored = at_least(IGNORED_TO - 0.5, np.abs(areas - 0.5))
    alone = ignored.sum(axis=1, keepdims=True) == areas.shape[1] - 1
    return float((ranks & alone).any(axis=0).mean())


def context(results):
    """Return the tables of ensembles that are not judged room by room, which :mod:`.rooms` has, and a figure.

    The figure is the counterpart of Figure 3 for data of one context.
    """
    by_room = results.of(scope="unseen")["artefact"]
    numbers = results.numbers[~results.numbers["artefact"].isin(by_room)]
    values = [per_run(numbers, "balanced_accuracy", scope=HELDOUT, member=which, name=which) for which in WHICH]
    values.append(per_run(numbers, *KNOWLEDGE, "coverage", scope=HELDOUT))
    for states in ("unlabelled", HELDOUT):
        values.append(per_run(numbers, "disagreement", scope=states, name=f"{{}}_{states}"))
    tables = tables_of(pd.concat(values), BY, PAIRED)
    if not tables:
        return {}
    table = tables["table"]
    means = table[table["quantity"].isin(WHICH)].pivot_table("mean", BY, "quantity", sort=False)
    label = "Members' balanced accuracy on held-out states"
    figure = Drawn("members", label, partial(members_figure, means))
    return tables | chosen_in(results) | {"figures": [figure] if len(means) else []}


def chosen_in(results) -> dict[str, Any]:
    """Return, by ensemble and sub-goal, the weights that ``diversity_weight=auto`` chose and tried."""
    recorded = results.facts.get("provenance", {"artefacts": []})  # not where several runs are compared
    chosen = {}
    for artefact in recorded["artefacts"]:
        for sub_goal, of_goal in artefact["config"].get("chosen", {}).items():
            chosen[f"{artefact['path']}, {sub_goal}"] = of_goal
    return {"chosen": chosen}


def members_figure(means: pd.DataFrame) -> Figure:
    """Draw balanced accuracy by method and sub-goal, as bars with the range of members.

    ``means`` has the index method and sub-goal, and the columns ``best``, ``mean`` and ``worst``.
    """
    wide = means.unstack("method", sort=False)
    ranges = np.stack([wide["mean"] - wide["worst"], wide["best"] - wide["mean"]])
    height = 1 + 0.2 * wide["mean"].size
    figure, axes = plots.bars("barh", wide["mean"], height, xerr=ranges.transpose(2, 0, 1))
    axes.axvline(0.5, **plots.DOTTED)
    axes.invert_yaxis()
    axes.set(xlabel="balanced accuracy on held-out states", ylabel="")
    return figure
