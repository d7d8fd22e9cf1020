"""Figure 3: members on rooms that training did and did not see, for each number of labelled ladder groups (Spec F1).

The paper scores the best member on files that hold training rooms too, and picks it on the same files. Here every
score stands on unseen rooms and on all rooms, and beside the best member are the mean, the worst and the one that the
rooms of the labelled groups, the only ones whose labels were to be had, would have picked.
"""

from collections.abc import Iterator, Mapping
from itertools import product
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from hypogoal.core.arrays import Bools, Ints
from hypogoal.evaluation.house import per_run, tidy, tidy_members
from hypogoal.evaluation.hypotheses import KNOWN
from hypogoal.evaluation.judging import Judged, Judgement, Work
from hypogoal.evaluation.page import Drawn, Results
from hypogoal.evaluation.plots import DOTTED, WIDTH, legend_below, looks, styled, whiskers
from hypogoal.hypotheses.scores import member_scores, most_and_least, ranking

TITLE = "Hypotheses in rooms without labels"
# Values of the origin ``seen`` of a held-out state: its room was in no training set, among the unlabelled states, or
# among the labelled ones.
SCOPES = {"unseen": (0,), "all": (0, 1, 2), "labelled": (2,)}
VALIDATION = "labelled"
VALIDATED = "validated_member"  # the quantity that is its number
SCORED = ("balanced_accuracy", "accuracy", "ranking")
WHICH = {"best": "best", "validated": VALIDATED, "mean": "mean", "worst": "worst"}  # the ``member`` of ``per_run``
BY = ["method", "N", "sub_goal"]
NEVER = "accuracy, all, never positive"
PAIRED = [f"balanced_accuracy, unseen, {which}" for which in ("best", "validated", "mean")]
PANELS = {  # of Figure 3, and what it takes no seeing to score
    "accuracy, all, best": "accuracy, all rooms: best",
    "balanced_accuracy, unseen, best": "balanced, unseen: best",
    "balanced_accuracy, unseen, validated": "balanced, unseen: validated",
    "balanced_accuracy, unseen, mean": "balanced, unseen: mean",
}
NEEDED = {"figure3": "ensembles of data of 1 to 7 labelled groups"}


def look(work: Work, judgement: Judgement) -> Iterator[pd.DataFrame]:
    """Members room by room, where held-out states say which rooms training saw."""
    split = judgement.split
    if "seen" not in split.origins:
        return
    place = work.place_of(judgement)
    yield from rows_by_room(judgement.judged, split.labels, split.origins, place)
    picked = choose(judgement.judged.predictions, split.labels, split.origins["seen"])
    yield tidy(picked, **place, scope=VALIDATION)
    work.validated[judgement.case.ensemble.resolve(), judgement.sub_goal] = picked[VALIDATED]


def rows_by_room(
    judged: Judged,
    labels: Bools,
    origins: Mapping[str, Ints],
    place: Mapping[str, Any],
) -> Iterator[pd.DataFrame]:
    """Spec F1: K members on N held-out states by whether training saw the room: in each scope counts and scores.

    ``origins`` (N,) are ``seen`` (see ``SCOPES``) and, where there is one, ``room``.
    """
    for scope, values in SCOPES.items():
        inside = np.isin(origins["seen"], values)
        columns = member_scores(judged.predictions[inside], labels[inside])
        columns["ranking"] = ranking(judged.probabilities[inside], labels[inside])
        yield tidy_members(columns, **place, scope=scope)
        counts = {"states": inside.sum(), "positives": labels[inside].sum()}
        if "room" in origins:
            counts["rooms"] = len(np.unique(origins["room"][inside]))
        yield tidy(counts, **place, scope=scope)


def choose(predictions: Bools, labels: Bools, seen: Ints) -> dict[str, float | None]:
    """Spec F1: the member with the highest balanced accuracy on rooms of labelled groups; ``validation``: that.

    The first of equally good ones, since their order is random; None where those rooms lack a class.
    """
    inside = np.isin(seen, SCOPES[VALIDATION])
    accuracies = member_scores(predictions[inside], labels[inside])["balanced_accuracy"]
    best, _ = most_and_least(accuracies)
    return {VALIDATED: best, "validation": None if best is None else accuracies[best]}


def runs(results: Results) -> pd.DataFrame:
    """Spec F1, F2: members' scores and disagreement, and what a member that is never positive has."""
    by_room = results.of(scope="unseen")["artefact"]
    numbers = results.of(artefact=[*by_room.unique()])
    states = per_run(numbers, "states", scope="all")
    never = per_run(numbers, "positives", scope="all", name=NEVER)
    never = never.assign(of="accuracy", value=1 - never["value"] / states["value"])
    values = [never, per_run(numbers, *KNOWN, scope="unseen")]
    for scope in ("unlabelled", "heldout"):
        values.append(per_run(numbers, "disagreement", scope=scope, name=f"{{}}, {scope}"))
    for scope, (which, member) in product(("unseen", "all"), WHICH.items()):
        values.append(per_run(numbers, *SCORED, scope=scope, member=member, name=f"{{}}, {scope}, {which}"))
    return pd.concat(values)


def figures(context: Mapping[str, Any]) -> Iterator[Drawn]:
    """Figure 3, and what it leaves out, of each sub-goal."""
    table = context["table"]
    sub_goals = table["sub_goal"].unique()
    for sub_goal in sub_goals:
        rows = table[table["sub_goal"] == sub_goal].dropna(subset="N")
        suffix = f"-{sub_goal}" if len(sub_goals) > 1 else ""
        figure = scores_over_groups(rows)
        yield Drawn(f"figure3{suffix}", "Figure 3: members against labelled groups", figure, {"sub_goal": sub_goal})


def scores_over_groups(table: pd.DataFrame) -> Figure:
    """Figure 3: scores against the number of labelled ladder groups, a panel for each of ``PANELS``.

    Of a table of :func:`house.over`, all of one sub-goal; dotted is a member that is never positive.
    """
    with styled():
        figure = Figure(figsize=(WIDTH, 4.55))
        axes = figure.subplots(2, 2, sharex=True, sharey=True)
        for place, (quantity, title) in zip(axes.flat, PANELS.items(), strict=True):
            shown = table[table["quantity"] == quantity]
            for method, look in looks(table["method"]).items():
                whiskers(place, shown[shown["method"] == method].set_index("N"), label=method, **look)
            never = table[table["quantity"] == NEVER].drop_duplicates("N").set_index("N")["mean"]
            blind = never if quantity.startswith("accuracy") else never * 0 + 0.5
            place.plot(blind.index, blind, **DOTTED, marker=".")
            place.set_title(title, fontsize=9.5)
        axes[0, 0].set_xticks(sorted(table["N"].unique()))
        for place in axes[-1]:
            place.set_xlabel("labelled groups, N")
        for place in axes[:, 0]:
            place.set_ylabel("fraction")
        legend_below(figure, list(axes.flat), 3)
    return figure
