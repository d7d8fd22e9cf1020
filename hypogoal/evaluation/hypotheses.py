"""How good hypotheses are on layouts that no data came from, and how much members differ (Spec F1, F2)."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from operator import itemgetter
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from rich.table import Table

from hypogoal.evaluation import page
from hypogoal.evaluation.numbers import Metrics, Row, Rows, grouped, over, pairs, ranked, rows_of, rows_of_members
from hypogoal.evaluation.page import Block, Drawn, Entry, Material, Question
from hypogoal.evaluation.plots import GREY, MARKERS, PALETTE, drawing
from hypogoal.hypotheses.scores import (
    best_mean_worst,
    by_member,
    mean_disagreement,
    member_scores,
)

if TYPE_CHECKING:
    from hypogoal.evaluation.judging import Judgement, Work

WHICH = ("best", "mean", "worst")
COMPARED = ("best", "mean")
STATES = ("unlabelled", "heldout")


def sub_goal_metrics(
    sub_goal: str,
    heldout: NDArray[np.bool_],
    labels: NDArray[np.bool_],
    layout_seeds: NDArray[np.int64] | None,
    unlabelled: NDArray[np.bool_],
    thresholds: NDArray[np.float32],
) -> dict[str, Any]:
    """Spec F1, F2: one sub-goal's K members by their verdicts on N held-out states and on M unlabelled ones.

    Scores of every member, pooled over the layouts, which are told where they are known (N,), at its own threshold
    (K,); best, mean and worst balanced accuracy; the mean disagreement of two members on either set of states.
    """
    scores, members = member_scores(heldout, labels), heldout.shape[1]
    says_yes = unlabelled.mean(0) if len(unlabelled) else np.full(members, math.nan)
    more = {"says_yes_unlabelled": says_yes, "threshold": thresholds.astype(np.float64)}
    return {
        "sub_goal": sub_goal,
        "states": len(labels),
        "positives": int(labels.sum()),
        "members": [{"member": member, **row} for member, row in enumerate(by_member(scores | more))],
        "balanced_accuracy": best_mean_worst(scores["balanced_accuracy"]),
        "layouts": [] if layout_seeds is None else np.unique(layout_seeds).tolist(),
        "disagreement": {"unlabelled": mean_disagreement(unlabelled), "heldout": mean_disagreement(heldout)},
    }


def look(work: Work, judgement: Judgement) -> None:
    """Every member on held-out and unlabelled states."""
    split, judged = judgement.split, judgement.judged
    layouts, said = split.origins.get("layout_seed"), (judged.told, judged.thresholds)
    judgement.row.update(sub_goal_metrics(judgement.case.sub_goal, judged.verdicts, split.labels, layouts, *said))


def of_layouts(ensembles: Sequence[Entry]) -> list[tuple[Entry, Entry]]:
    """Every (ensemble, sub-goal) but those judged room by room, which ``rooms`` has."""
    return [(ensemble, goal) for ensemble in ensembles for goal in ensemble["sub_goals"] if "rooms" not in goal]


def hypotheses_table(ensembles: Sequence[Entry]) -> list[dict[str, Any]]:
    """Spec F1: per kind of ensemble and sub-goal: best, mean and worst member's balanced accuracy, over seeds.

    Ensembles have ``name`` and ``sub_goals`` (see :func:`sub_goal_metrics`). Those judged room by room are left out:
    their table is ``rooms.rooms_table``.
    """
    table = []
    cells = grouped(of_layouts(ensembles), lambda judged: (judged[0]["name"], judged[1]["sub_goal"]))
    for (name, sub_goal), judged in cells.items():
        entry: dict[str, Any] = {"name": name, "sub_goal": sub_goal, "ensembles": len(judged)}
        for which in WHICH:
            values = [goal["balanced_accuracy"][which] for _, goal in judged]
            entry[which] = over(values, "balanced accuracy", name, sub_goal, which)
        for states in STATES:
            values = [goal["disagreement"][states] for _, goal in judged]
            entry[f"disagreement_{states}"] = over(values, "share of states", name, sub_goal, states)
        table.append(entry)
    return table


def rows(metrics: Metrics, arrays: Any) -> Iterator[Row]:
    """Every member on held-out states; on the ladders apart for rooms that no training set holds."""
    for ensemble in metrics["ensembles"]:
        about = {"method": ensemble.get("method", ensemble["name"]), "N": ensemble.get("groups")}
        about |= {"seed": ensemble["seed"], "artefact": ensemble["path"]}
        for goal in ensemble["sub_goals"]:
            about["sub_goal"] = goal["sub_goal"]
            scopes = {name: scope["members"] for name, scope in goal.get("rooms", {}).get("scopes", {}).items()}
            for scope, members in {"heldout": goal["members"], **scopes}.items():
                yield from rows_of_members(members, **about, scope=scope)
            for states in reversed(STATES):
                yield from rows_of({"disagreement": goal["disagreement"][states]}, **about, scope=states)


def against(ensembles: Sequence[Entry]) -> Rows:
    """Spec F1: the first kind of ensembles against each other by balanced accuracy on held-out layouts, paired by seed.

    Rows are over all sub-goals that both have; units are seeds. Ensembles judged by room are left out.
    """
    found: Rows = []
    for which in COMPARED:
        measured = [
            (ensemble["name"], (goal["sub_goal"], ensemble["seed"]), goal["balanced_accuracy"][which])
            for ensemble, goal in of_layouts(ensembles)
        ]
        quantity = f"balanced accuracy, {which} member"
        found += pairs(measured, quantity)
    return found


ENSEMBLE = page.label("ensemble", "name", once=True)
SCORES = tuple(page.number(which, which, page.spread, 3) for which in WHICH)
SEEDS = page.number("seeds", "ensembles")
HYPOTHESES = (
    ENSEMBLE,
    page.label("sub-goal", "sub_goal"),
    *SCORES,
    page.number("disagree, unlabelled", "disagreement_unlabelled", page.spread, 3),
    page.number("disagree, held-out", "disagreement_heldout", page.spread, 3),
    SEEDS,
)
DISAGREE = page.number("disagree", "disagreement_heldout", page.spread, 3)


def summary(metrics: Metrics) -> list[Table]:
    """Balanced accuracy of the best, mean and worst member on held-out states."""
    columns = (ENSEMBLE._replace(title="method"), page.label("sub-goal", "sub_goal"), *SCORES, DISAGREE)
    title = "Balanced accuracy on held-out states: best, mean and worst member"
    return [page.terminal(title, columns, metrics["hypotheses"])] if metrics["hypotheses"] else []


def sections(material: Material) -> list[Block]:
    """Of ensembles judged by layout."""
    return [hypotheses_section(material)] if material.metrics["hypotheses"] else []


def hypotheses_section(material: Material) -> Block:
    """Figure 3's question on held-out layouts: best, mean and worst member, and how much members disagree."""
    metrics = material.metrics
    if _has_layouts(metrics):
        judged = "Members are judged on layouts whose states were in no training set."
    else:
        judged = (
            "Members are judged on the held-out states of the data. Where these are a share of the labelled ones they "
            "say nothing of other contexts."
        )
    text = (
        f"{judged} The best member shows whether a hypothesis that holds there is in the ensemble at all; mean and "
        "worst show what the agent has to choose among. A member that always gives the same answer has 0.5."
    )
    whole = page.table(
        HYPOTHESES,
        metrics["hypotheses"],
        caption="Balanced accuracy on held-out states of the best, mean and worst member, and the share of states "
        "on which two members disagree (mean over pairs); mean over ensemble seeds ± standard error.",
    )
    blocks = [
        *(page.shown(material, figure) for figure in figures(material)),
        whole,
        *page.comparison_tables(material.comparisons("hypotheses"), "ensemble seed and sub-goal"),
    ]
    return page.section("hypotheses", "Hypotheses", [text], blocks)


def _has_layouts(metrics: Entry) -> bool:
    """Whether held-out states are of layouts, as collected ones are, and not only states, as imported ones."""
    return any(goal["layouts"] for ensemble in metrics["ensembles"] for goal in ensemble["sub_goals"])


def figures(material: Material) -> list[Drawn]:
    """Figure 3's quantity for one labelled context."""
    entries = material.metrics["hypotheses"]
    drawn = best_mean_worst_members(entries)
    seeds = sorted({ensemble["seed"] for ensemble in material.metrics["ensembles"]})
    where = "layouts, pooled over them" if _has_layouts(material.metrics) else "states"
    caption = (
        f"The quantity of the paper's Figure 3, for one labelled context: balanced accuracy on held-out {where}. "
        "Filled: best member; bar: mean of members; hollow: worst member; each a mean over ensemble seeds "
        f"({page.listed(seeds)}). Dotted: always the same answer."
    )
    title, nothing = "Members' balanced accuracy on held-out states", "No held-out states have both classes."
    return [Drawn("members", title, drawn, caption, nothing)]


def best_mean_worst_members(entries: Sequence[Entry]) -> Figure | None:
    """Figure 3's quantity for one labelled layout: balanced accuracy on held-out layouts, by kind of ensemble.

    Entries are of :func:`hypotheses_table`; where no mean in them is a number there is no figure.
    """
    means = [entry[which]["mean"] for entry in entries for which in WHICH]
    lowest = min((mean for mean in means if mean is not None), default=None)
    if lowest is None:
        return None
    kinds, sub_goals = grouped(entries, itemgetter("name")), list(dict.fromkeys(map(itemgetter("sub_goal"), entries)))
    step = 0.8 / len(kinds)
    with drawing(1.2 + len(sub_goals) * max(0.42, 0.2 * len(kinds)), 3) as (figure, axes):
        for index, (name, alike) in enumerate(kinds.items()):
            values = np.full((len(sub_goals), len(WHICH)), math.nan)
            for entry in alike:
                values[sub_goals.index(entry["sub_goal"])] = np.array([entry[which]["mean"] for which in WHICH], float)
            y = np.arange(len(sub_goals), dtype=np.float64) + (index - (len(kinds) - 1) / 2) * step
            colour, marker = PALETTE[index % len(PALETTE)], MARKERS[index % len(MARKERS)]
            axes.hlines(y, values[:, 2], values[:, 0], color=colour, linewidth=1.6, alpha=0.6)
            axes.plot(values[:, 0], y, marker, color=colour, markersize=7, label=name)
            axes.plot(values[:, 1], y, "|", color=colour, markersize=10, markeredgewidth=1.8)
            axes.plot(values[:, 2], y, marker, color=colour, markersize=5, fillstyle="none")
        axes.axvline(0.5, color=GREY, linewidth=1.2, linestyle=":")
        axes.set_yticks(range(len(sub_goals)), sub_goals)
        axes.invert_yaxis()
        axes.grid(visible=False, axis="y")
        axes.set_xlim(min(0.45, lowest - 0.03), 1.02)
        axes.set_xlabel("balanced accuracy on held-out states (0.5: chance)")
    return figure


QUESTION = Question(
    look=look,
    numbers=lambda work: {"hypotheses": hypotheses_table(work.ensembles)},
    rows=rows,
    pairs=lambda metrics: {"hypotheses": against(ranked(metrics["ensembles"]))},
    summary=summary,
    sections=sections,
    figures=figures,
)
