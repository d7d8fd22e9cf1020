"""The section on Figure 3: members on rooms that training did and did not see, over labelled ladder groups."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from hypogoal.evaluation.ladder_figures import Panel, Series, scores_over_groups
from hypogoal.evaluation.page.blocks import (
    Block,
    Material,
    deviation,
    figure,
    fixed,
    interval,
    listed,
    row,
    section,
    table,
)
from hypogoal.evaluation.page.comparisons import comparison_tables
from hypogoal.evaluation.page.room_details import (
    SCOPES,
    group_name,
    kinds_tables,
    members_table,
    room_tables,
)

SCORES = {"balanced_accuracy": "balanced accuracy", "accuracy": "accuracy"}
WHICH = {
    "best": "best member",
    "validated": "validated member",
    "mean": "mean of members",
    "worst": "worst member",
}
PAPER = (
    "The paper: about 70 % for the best member at N=1 with both ensembles, the single CNN about 20 points lower, and a "
    "big step at N=2. Its test files include training rooms, as 'all rooms' does; how many of their states are "
    "positive is not said, so look at the differences between methods and N rather than at the level."
)


def rooms_section(material: Material) -> Block:
    """Figure 3, its tables, every room and every kind of false positive."""
    rows = material.metrics["rooms"]
    title = "Hypotheses against labelled ladders"
    if not rows:
        missing = ["Figure 3: it needs ensemble artefacts of data whose held-out states say which rooms training saw."]
        return section("rooms", title, [], [], missing)
    text = (
        "N is the number of ladder groups with labels. Members are judged on held-out states of rooms that no training "
        "state came from (unseen), and of all rooms, training rooms included, as in the paper. The best member is "
        "picked on the very states that it is scored on, so it rises with the number of members by chance alone; the "
        "validated member is the one with the highest balanced accuracy on held-out states in the rooms of labelled "
        "groups, which a user could pick too."
    )
    blocks = []
    for sub_goal in dict.fromkeys(entry["sub_goal"] for entry in rows):
        own = [entry for entry in rows if entry["sub_goal"] == sub_goal]
        blocks += [_best(material, own), _four(material, own), *(_table(own, scope) for scope in SCOPES)]
        blocks += [_intervals(own), _differences(own)]
        blocks += kinds_tables(material, own) + room_tables(material, own)
    blocks += comparison_tables(material.comparisons("rooms"), "ensemble seed and N")
    blocks.append(members_table(material))
    return section("rooms", title, [text], blocks)


def _names(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    return list(dict.fromkeys(entry["method"] for entry in rows))


def panel(rows: Sequence[Mapping[str, Any]], title: str, scope: str, score: str, which: str) -> Panel:
    """One plot of Figure 3: a score of one kind of member over N, a line per method of the rows."""
    series = []
    for name in _names(rows):
        own = [entry for entry in rows if entry["method"] == name and entry["groups"] is not None]
        found = [entry["scores"][scope][score][which] for entry in own]
        series.append(
            Series(
                name,
                np.array([entry["groups"] for entry in own], dtype=np.int64),
                np.array([np.nan if one["mean"] is None else one["mean"] for one in found], dtype=np.float64),
                np.array(
                    [np.nan if one["standard_deviation"] is None else one["standard_deviation"] for one in found],
                    dtype=np.float64,
                ),
            )
        )
    blind = {}
    for entry in sorted(rows, key=lambda entry: entry["groups"] or 0):
        never = entry["always_no"][scope] if score == "accuracy" else 0.5 if entry["positives"][scope] else None
        if entry["groups"] is not None and never is not None:
            blind[entry["groups"]] = never
    return Panel(title, blind, series)


def bands(rows: Sequence[Mapping[str, Any]]) -> str:
    """What a figure of these rows shows spread by: a method with one N has a bar in place of a band."""
    alone = [
        len({entry["groups"] for entry in rows if entry["method"] == name and entry["groups"] is not None}) == 1
        for name in _names(rows)
    ]
    if all(alone):
        return "bars (methods side by side, all at the same N)"
    return "bands, and bars where a method has one N (those methods side by side)" if any(alone) else "bands"


def _identity(base: str, rows: Sequence[Mapping[str, Any]], material: Material) -> str:
    """A figure's name; with the sub-goal where there are several."""
    several = len({entry["sub_goal"] for entry in material.metrics["rooms"]}) > 1
    return f"{base}-{rows[0]['sub_goal']}" if several else base


def _best(material: Material, rows: Sequence[Mapping[str, Any]]) -> Block:
    label = "Figure 3: the best member against labelled ladder groups"
    missing = "Its data do not say how many ladder groups have labels (setting 'groups')."
    drawn = None
    if any(entry["groups"] is not None for entry in rows):
        panels = [
            panel(rows, f"{SCORES[score]}, {SCOPES[scope]}", scope, score, "best")
            for score in ("accuracy", "balanced_accuracy")
            for scope in ("all", "unseen")
        ]
        drawn = scores_over_groups(panels, _names(rows))
    caption = (
        "Figure 3 of the paper (top left) and what it leaves out: the best member, mean over ensemble seeds; "
        f"{bands(rows)}: ± one standard deviation over seeds, as in the paper. Dotted: never saying yes. "
        f"{_seeds(material, rows)} {_why_dashes(rows)}{PAPER}"
    )
    return figure(material, _identity("figure3", rows, material), label, drawn, caption, missing)


def _four(material: Material, rows: Sequence[Mapping[str, Any]]) -> Block:
    drawn = None
    if any(entry["groups"] is not None for entry in rows):
        panels = [panel(rows, name, "unseen", "balanced_accuracy", which) for which, name in WHICH.items()]
        drawn = scores_over_groups(panels, _names(rows))
    caption = (
        "Balanced accuracy on unseen rooms of the best, the validated, the mean and the worst member; mean "
        f"over ensemble seeds, {bands(rows)}: ± one standard deviation. {_why_dashes(rows)}"
        "Only the second can be had without labels from the rooms it is for."
    )
    label = "Balanced accuracy on unseen rooms"
    return figure(material, _identity("unseen", rows, material), label, drawn, caption, "As above.")


def _seeds(material: Material, rows: Sequence[Mapping[str, Any]]) -> str:
    names = set(_names(rows))
    seeds = sorted({one["seed"] for one in material.metrics["ensembles"] if one.get("method") in names})
    return f"Ensemble seed{'s' if len(seeds) > 1 else ''} {listed(seeds)}."


def _why_dashes(rows: Sequence[Mapping[str, Any]]) -> str:
    bare = sorted({entry["groups"] for entry in rows if entry["positives"]["unseen"] == 0 and entry["groups"]})
    if not bare:
        return ""
    return (
        f"At N={listed(bare)} no unseen room has a ladder base left, so balanced accuracy on them is not defined (–) "
        "and accuracy there is the share of negatives called negative. "
    )


def _table(rows: Sequence[Mapping[str, Any]], scope: str) -> Block:
    lines, last = [], ""
    for entry in rows:
        found = entry["scores"][scope]
        lines.append(
            row(
                entry["method"] if entry["method"] != last else "",
                group_name(entry["groups"]),
                *(deviation(found[score][which], 2) for score in SCORES for which in WHICH),
                str(entry["ensembles"]),
                mark="first" if entry["method"] != last else "",
            )
        )
        last = entry["method"]
    columns = [f"{name} {which}" for name in ("bal.", "acc.") for which in WHICH]
    return table(
        ("method", "N", *columns, "seeds"),
        lines,
        texts=2,
        tight=True,
        heading=f"On held-out states of {SCOPES[scope]}",
        caption="Balanced accuracy (bal.) and accuracy (acc.) of the best, the validated, the mean and the "
        f"worst member: mean over ensemble seeds ± standard deviation over them. {_never(rows, scope)}"
        f"{_why_dashes(rows) if scope == 'unseen' else PAPER}",
    )


def _never(rows: Sequence[Mapping[str, Any]], scope: str) -> str:
    """What accuracy is worth here: that of a member that never says yes, by N."""
    found = {entry["groups"]: entry["always_no"][scope] for entry in rows if entry["always_no"][scope] is not None}
    told = [
        f"{never:.2f}{'' if groups is None else f' (N={groups})'}" for groups, never in sorted(found.items(), key=str)
    ]
    return f"Never saying yes has accuracy {listed(told)}. " if told else ""


def _intervals(rows: Sequence[Mapping[str, Any]]) -> Block:
    lines, last = [], ""
    for entry in rows:
        found = [entry["scores"][scope]["balanced_accuracy"] for scope in SCOPES]
        lines.append(
            row(
                entry["method"] if entry["method"] != last else "",
                group_name(entry["groups"]),
                *(interval(own[which], 3) for own in found for which in ("best", "validated", "mean")),
                mark="first" if entry["method"] != last else "",
            )
        )
        last = entry["method"]
    columns = [f"{scope}: {which}" for scope in ("unseen", "all") for which in ("best", "validated", "mean")]
    return table(
        ("method", "N", *columns),
        lines,
        texts=2,
        tight=True,
        folded="Interquartile means of balanced accuracy with intervals",
        caption="Interquartile mean over ensemble seeds with its 95 % bootstrap interval (2,000 resamples of seeds); "
        "no interval with one seed.",
    )


def _differences(rows: Sequence[Mapping[str, Any]]) -> Block:
    lines, last = [], ""
    for entry in rows:
        ranked = entry["scores"]["unseen"].get("ranking")  # which an evaluation of before does not have
        lines.append(
            row(
                entry["method"] if entry["method"] != last else "",
                group_name(entry["groups"]),
                deviation(entry["disagreement_unlabelled"], 3),
                deviation(entry["disagreement_heldout"], 3),
                fixed(entry["tied"], 1),
                *(deviation(ranked[which], 3) if ranked else "–" for which in ("best", "mean", "worst")),
                mark="first" if entry["method"] != last else "",
            )
        )
        last = entry["method"]
    return table(
        (
            "method",
            "N",
            "disagree, unlabelled",
            "disagree, held-out",
            "tied on validation",
            "ranking, best",
            "ranking, mean",
            "ranking, worst",
        ),
        lines,
        texts=2,
        tight=True,
        heading="How different the members are, and what they know",
        caption="Share of states on which two members' verdicts differ, mean over pairs; mean over seeds ± standard "
        "deviation. Tied: members with the same, highest balanced accuracy in the rooms of labelled groups, of which "
        "the first counts as validated; where all are tied, validation chooses nothing. Ranking: share of pairs of a "
        "positive and a negative of unseen rooms in which a member gives the positive the higher probability (area "
        "under the ROC curve); what lies between that and balanced accuracy is where its threshold is.",
    )
