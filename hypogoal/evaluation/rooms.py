"""Figure 3: members on rooms that training did and did not see, for each number of labelled ladder groups (Spec F1).

The paper scores the best member on files that hold training rooms too, and picks it on the same files. Here every
score stands on unseen rooms and on all rooms, and beside the best member are the mean, the worst and the one that the
rooms of the labelled groups, the only ones whose labels were to be had, would have picked.
"""

import math
from collections.abc import Iterator, Mapping
from itertools import product
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from hypogoal.evaluation.house import over, pairs, per_run, tidy, tidy_members
from hypogoal.evaluation.hypotheses import KNOWN
from hypogoal.evaluation.judging import Judged, Judgement, Work
from hypogoal.evaluation.names import METHODS, rank
from hypogoal.evaluation.page import Drawn, Results, deviation, displayed, mean, pairs_displayed, spans
from hypogoal.evaluation.plots import GREY, MARKERS, PALETTE, STYLES, WIDTH, legend_below, styled
from hypogoal.hypotheses.scores import member_scores, ranking

TITLE = "Hypotheses in rooms without labels"
# Values of the origin ``seen`` of a held-out state: its room was in no training set, among the unlabelled states, or
# among the labelled ones.
SCOPES = {"unseen": (0,), "all": (0, 1, 2), "labelled": (2,)}
VALIDATION = "labelled"
VALIDATED = "validated_member"  # the quantity that is its number
TABLED = ("unseen", "all")  # scopes of the tables and of Figure 3
SCORED = ("balanced_accuracy", "accuracy", "ranking")
WHICH = {"best": "best", "validated": VALIDATED, "mean": "mean", "worst": "worst"}  # the ``member`` of ``per_run``
PANELS = {  # of Figure 3
    "accuracy, all rooms: best member": "accuracy, all, best",
    "balanced, unseen: best member": "balanced_accuracy, unseen, best",
    "balanced, unseen: validated member": "balanced_accuracy, unseen, validated",
    "balanced, unseen: mean of members": "balanced_accuracy, unseen, mean",
}
PAPERS = "climb-down-ladder"  # the paper's sub-goal; its authors' repository has others
NEEDED = {"figure3": "ensembles of data of 1 to 7 labelled groups"}
BY = {"method": "method", "N": "N"}
COLUMNS = {which: (f"balanced_accuracy, unseen, {which}", deviation(2)) for which in WHICH}
COLUMNS["acc., all"] = ("accuracy, all, best", deviation(2))


def look(work: Work, judgement: Judgement) -> Iterator[pd.DataFrame]:
    """Members room by room, where held-out states say which rooms training saw."""
    split = judgement.split
    if "seen" not in split.origins:
        return
    place = work.place_of(judgement)
    yield from rows_by_room(judgement.judged, split.labels, split.origins, place)
    picked = choose(judgement.judged.predictions, split.labels, split.origins["seen"])
    yield tidy(picked, **place, scope=VALIDATION)
    validated = picked[VALIDATED]
    if validated is not None:
        work.validated[place["artefact"], place["sub_goal"]] = int(validated)


def rows_by_room(
    judged: Judged,
    labels: NDArray[np.bool_],
    origins: Mapping[str, NDArray[np.int64]],
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
        counts = {"states": int(inside.sum()), "positives": int(labels[inside].sum())}
        if "room" in origins:
            counts["rooms"] = len(np.unique(origins["room"][inside]))
        yield tidy(counts, **place, scope=scope)


def choose(
    predictions: NDArray[np.bool_], labels: NDArray[np.bool_], seen: NDArray[np.int64]
) -> dict[str, float | None]:
    """Spec F1: the member with the highest balanced accuracy on rooms of labelled groups; ``validation``: that.

    The first of equally good ones, since their order is random; None where those rooms lack a class.
    """
    inside = np.isin(seen, SCOPES[VALIDATION])
    scores = member_scores(predictions[inside], labels[inside])["balanced_accuracy"]
    if np.isnan(scores).all():
        return {VALIDATED: None, "validation": math.nan}
    return {VALIDATED: int(np.nanargmax(scores)), "validation": float(np.nanmax(scores))}


def tables(results: Results) -> dict[str, pd.DataFrame]:
    """Spec F1, F2: per method, N and sub-goal members' scores and disagreement over seeds; the first and the others."""
    by_room = results.of(scope="unseen")["artefact"]
    numbers = results.of(artefact=[*by_room.unique()])
    runs = []
    for scope, score, (which, member) in product(TABLED, SCORED, WHICH.items()):
        runs.append(per_run(numbers, score, scope, member, f"{score}, {scope}, {which}"))
    runs += [per_run(numbers, name, "unseen") for name in KNOWN]
    for states in ("unlabelled", "heldout"):
        runs.append(per_run(numbers, "disagreement", states, name=f"disagreement, {states}"))
    table = over(pd.concat(runs), [*BY, "sub_goal"])
    order = table["method"].map(rank)
    table = table.assign(rank=order).sort_values(["sub_goal", "rank", "method", "N"], kind="stable")
    return {
        "rooms": table.drop(columns="rank"),
        "rooms-pairs": pairs(compared(results)),
        "rooms-never": _never(numbers),
    }


def compared(results: Results) -> pd.DataFrame:
    """The numbers of runs by which ensembles are compared."""
    parts = []
    for which in ("best", "validated", "mean"):
        name = f"balanced accuracy on unseen rooms, {which} member"
        parts.append(per_run(results.numbers, "balanced_accuracy", "unseen", WHICH[which], name))
    return pd.concat(parts).sort_values("N", kind="stable")


def _never(numbers: pd.DataFrame) -> pd.DataFrame:
    """Accuracy of a member that is never positive, by sub-goal, N and scope, and the ``positives`` there."""
    counts = numbers[numbers["quantity"].isin(["states", "positives"]) & numbers["scope"].isin(TABLED)]
    wide = counts.pivot_table(
        index=["sub_goal", "N", "scope"], columns="quantity", values="value", aggfunc="first", sort=False
    )
    accuracy = 1 - wide["positives"] / wide["states"].where(wide["states"] > 0)
    return wide.assign(all_negative=accuracy).reset_index()


def context(results: Results) -> dict[str, Any] | None:
    """For the template: the table of methods and N, pairs, and what a member that is never positive scores."""
    if results.of(scope="unseen").empty:
        return None
    computed = tables(results)
    more = {
        "disagree, unlabelled": ("disagreement, unlabelled", deviation(3)),
        "disagree, held-out": ("disagreement, heldout", deviation(3)),
    }
    by = dict(BY)
    if computed["rooms"]["sub_goal"].nunique() > 1:
        by["sub_goal"] = "sub-goal"
    printed = {title: (quantity, mean(2)) for title, (quantity, _) in COLUMNS.items()}
    never = computed["rooms-never"]
    bare = never[(never["scope"] == "unseen") & (never["positives"] == 0)]
    return {
        "table": displayed(computed["rooms"], by, COLUMNS | more),
        "printed": displayed(computed["rooms"], by, printed),
        "pairs": pairs_displayed(computed["rooms-pairs"], {}),
        "never": never[never["scope"] == "all"].to_dict("records"),
        "bare": bare["N"].tolist(),
        "is_papers": PAPERS in [*computed["rooms"]["sub_goal"]],
        "seeds": spans(results.of(scope="unseen")["seed"]),
    }


def figures(results: Results) -> Iterator[Drawn]:
    """Figure 3, and what it leaves out, of each sub-goal."""
    if results.of(scope="unseen").empty:
        return
    computed = tables(results)
    sub_goals = computed["rooms"]["sub_goal"].unique()
    for sub_goal in sub_goals:
        table = computed["rooms"][computed["rooms"]["sub_goal"] == sub_goal].dropna(subset="N")
        never = computed["rooms-never"][computed["rooms-never"]["sub_goal"] == sub_goal]
        if len(table):
            suffix = f"-{sub_goal}" if len(sub_goals) > 1 else ""
            figure = scores_over_groups(table, never)
            yield Drawn(f"figure3{suffix}", "Figure 3: members against labelled groups", figure, {"sub_goal": sub_goal})


def scores_over_groups(table: pd.DataFrame, never: pd.DataFrame) -> Figure:
    """Figure 3: scores against the number of labelled ladder groups, a panel for each of ``PANELS``.

    ``table`` is of :func:`tables`, all of one sub-goal; dotted is a member that is never positive.
    """
    methods = list(table["method"].unique())
    ticks = sorted(table["N"].unique().tolist())
    with styled():
        figure = Figure(figsize=(WIDTH, 4.55))
        axes = figure.subplots(2, 2, sharex=True, sharey=True)
        for place, (title, quantity) in zip(axes.flat, PANELS.items(), strict=True):
            for index, method in enumerate(methods):
                rows = table[(table["quantity"] == quantity) & (table["method"] == method)]
                _draw_method(place, rows, index, len(methods))
            _draw_never(place, never, quantity)
            place.set_title(title, fontsize=9.5)
        lowest = min(0.5, (table["mean"] - table["standard_deviation"].fillna(0)).min())
        axes[0, 0].set(ylim=(max(0.0, lowest - 0.03), 1.03), xticks=ticks, xlim=(ticks[0] - 0.4, ticks[-1] + 0.4))
        for place in axes[-1]:
            place.set_xlabel("labelled groups, N")
        for place in axes[:, 0]:
            place.set_ylabel("fraction")
        legend_below(figure, list(axes.flat), 3)
    return figure


def _draw_method(axes: Axes, rows: pd.DataFrame, index: int, count: int) -> None:
    """Mean and standard deviation of one of so many methods against N."""
    colour, line = PALETTE[index % len(PALETTE)], STYLES[index % len(STYLES)]
    groups = rows["N"].to_numpy(np.float64)
    middle, wide = rows["mean"].to_numpy(), rows["standard_deviation"].to_numpy()
    if len(rows) == 1:  # methods with one N would lie at the same place
        groups = groups + (index - (count - 1) / 2) * 0.06
        axes.errorbar(groups, middle, wide, color=colour, capsize=3, linewidth=1.2)
    else:
        axes.fill_between(groups, middle - wide, middle + wide, color=colour, alpha=0.15, linewidth=0)
    marker = MARKERS[index % len(MARKERS)]
    label = rows["method"].iloc[0] if len(rows) else ""
    axes.plot(groups, middle, marker, linestyle=line, color=colour, linewidth=1.6, markersize=5, label=label)


def _draw_never(axes: Axes, never: pd.DataFrame, quantity: str) -> None:
    """What it takes no seeing to score, dotted."""
    score, scope, _ = quantity.split(", ")
    rows = never[never["scope"] == scope].sort_values("N")
    if score == "accuracy":
        blind = rows["all_negative"]
    else:
        blind = pd.Series(0.5, rows.index).where(rows["positives"] > 0)
    if len(rows) == 1:  # a line of one N is a point, which a method's marker may hide
        axes.axhline(blind.iloc[0], color=GREY, linewidth=1.2, linestyle=":", zorder=0)
    else:
        axes.plot(rows["N"].to_numpy(np.float64), blind, ".:", color=GREY, linewidth=1.2, markersize=3)


def missing(work: Work) -> list[str]:
    """Spec F1: the methods that are not there, of a run with ladders."""
    of_ensembles = [work.place(artefact) for artefact in work.contents.ensembles]
    if not work.validated and not work.contents.ladders:
        return []
    return lacking([place["method"] for place in of_ensembles], "ensemble", "Figure 3")


def lacking(methods: list[str], artefact: str, figures_lacking: str) -> list[str]:
    """A line for each of the paper's methods that none of ``methods`` is."""
    papers = [name for name in METHODS if name != "DivDis"]
    absent = [name for name in papers if not any(method.startswith(name) for method in methods)]
    return [f"no {artefact} of {name} ({figures_lacking})" for name in absent]
