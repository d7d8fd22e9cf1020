"""How good hypotheses are on layouts that no data came from, and how much members differ (Spec F1, F2)."""

import math
from collections.abc import Iterator, Sequence
from operator import itemgetter
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from rich.table import Table as Printed

from hypogoal.evaluation import page
from hypogoal.evaluation.judging import Judgement, Work
from hypogoal.evaluation.numbers import Metrics, ensemble_title, grouped
from hypogoal.evaluation.page import Block, Drawn, Entry, Material, Question
from hypogoal.evaluation.plots import GREY, MARKERS, PALETTE, drawing
from hypogoal.evaluation.table import (
    Number,
    Pairs,
    Row,
    Table,
    by_fields,
    rows_by_member,
    rows_of,
    select,
    tabulate,
    with_members,
)
from hypogoal.hypotheses.scores import mean_disagreement, member_scores

WHICH = ("best", "mean", "worst")
STATES = ("unlabelled", "heldout")
TABLE = Table(
    {"name": "method", "sub_goal": "sub_goal"},
    {
        **{which: Number("balanced_accuracy", "heldout", "balanced accuracy", which) for which in WHICH},
        **{f"disagreement_{on}": Number("disagreement", on, "share of states", cell=(on,)) for on in STATES},
    },
    "ensembles",
)


def look(work: Work, judgement: Judgement) -> Iterator[Row]:
    """Spec F1, F2: each member on held-out states, pooled over layouts, and how much members disagree."""
    split, judged, place = judgement.split, judgement.judged, work.place(judgement)
    layouts = split.origins.get("layout_seed", np.zeros(0))
    calls = judged.unlabelled.mean(0) if len(judged.unlabelled) else np.full(judged.unlabelled.shape[1], math.nan)
    more = {"positive_unlabelled": calls, "threshold": judged.thresholds.astype(np.float64)}
    yield from rows_by_member(member_scores(judged.predictions, split.labels) | more, **place, scope="heldout")
    counts = {"states": len(split.labels), "positives": int(split.labels.sum()), "layouts": len(np.unique(layouts))}
    yield from rows_of(counts | {"disagreement": mean_disagreement(judged.predictions)}, **place, scope="heldout")
    yield from rows_of({"disagreement": mean_disagreement(judged.unlabelled)}, **place, scope="unlabelled")


def of_layouts(rows: Sequence[Row]) -> list[Row]:
    """The rows of ensembles but those judged room by room, which ``rooms`` has."""
    by_room = {row.artefact for row in rows if row.scope == "unseen"}
    return [row for row in select(rows, scope=STATES) if row.artefact not in by_room]


PAIRS = Pairs(
    "hypotheses",
    {f"balanced accuracy, {which} member": TABLE.numbers[which] for which in ("best", "mean")},
    of_layouts,
    ranked=True,
)


def view(work: Work) -> dict[str, Any]:
    """Over seeds; and of every ensemble and sub-goal its members and other numbers, by scope."""
    by_path = {work.contents.name(artefact): artefact for artefact in work.contents.ensembles}
    judged = [row for row in work.rows if row.artefact in by_path]
    names, ensembles = dict(zip(by_path, work.ensemble_names[0], strict=True)), []
    for (path, method, groups, seed), rows in by_fields(judged, "artefact", "method", "N", "seed").items():
        goals = [
            {"sub_goal": sub_goal, **{entry.pop("scope"): entry for entry in with_members(of_goal, scope="scope")}}
            for (sub_goal,), of_goal in by_fields(rows, "sub_goal").items()
        ]
        entry = {"path": path, "name": names[path], "seed": seed, "members": by_path[path].config["members"]}
        ensembles.append(entry | {"method": method, "groups": groups, "sub_goals": goals})
    return {"hypotheses": tabulate(of_layouts(work.rows), TABLE), "ensembles": ensembles}


CAPTION = (
    "Balanced accuracy on held-out states of the best, mean and worst member, and the share of states on which two "
    "members disagree (mean over pairs); mean over ensemble seeds ± standard error."
)
ENSEMBLE = page.label("ensemble", lambda entry: ensemble_title(str(entry["name"])), once=True)
SCORES = tuple(page.number(which, which, page.spread, 3) for which in WHICH)
SEEDS = page.number("seeds", "ensembles")
DISAGREE = page.number("disagree", "disagreement_heldout", page.spread, 3)
HYPOTHESES = (
    *(ENSEMBLE, page.label("sub-goal", "sub_goal"), *SCORES),
    page.number("disagree, unlabelled", "disagreement_unlabelled", page.spread, 3),
    DISAGREE._replace(title="disagree, held-out"),
    SEEDS,
)


def summary(metrics: Metrics) -> list[Printed]:
    """Balanced accuracy of the best, mean and worst member on held-out states."""
    columns = (ENSEMBLE._replace(title="method"), page.label("sub-goal", "sub_goal"), *SCORES, DISAGREE)
    title = "Balanced accuracy on held-out states: best, mean and worst member"
    return [page.terminal(title, columns, metrics["hypotheses"])] if metrics["hypotheses"] else []


def sections(material: Material) -> list[Block]:
    """Figure 3's question on held-out layouts: best, mean and worst member, and how much members disagree."""
    metrics = material.metrics
    if not metrics["hypotheses"]:
        return []
    judged = (
        "Members are judged on layouts whose states were in no training set."
        if _has_layouts(metrics)
        else "Members are judged on the held-out states of the data, which say nothing of other contexts where they "
        "are a share of the labelled ones."
    )
    text = (
        f"{judged} The best member shows whether a hypothesis that holds there is in the ensemble at all; mean and "
        "worst show what the agent has to choose among. A member that always gives the same answer has 0.5."
    )
    blocks = [page.shown(material, figure) for figure in figures(material)]
    blocks.append(page.table(HYPOTHESES, metrics["hypotheses"], caption=CAPTION))
    blocks += page.comparison_tables(material.comparisons("hypotheses"), "ensemble seed and sub-goal")
    return [page.section("hypotheses", "Hypotheses", [text], blocks)]


def _has_layouts(metrics: Entry) -> bool:
    """Whether held-out states are of layouts, as collected ones are, and not only states, as imported ones."""
    return any(goal["heldout"]["layouts"] for ensemble in metrics["ensembles"] for goal in ensemble["sub_goals"])


def figures(material: Material) -> list[Drawn]:
    """Figure 3's quantity for one labelled context."""
    entries = material.metrics["hypotheses"]
    drawn = best_mean_worst_members(entries)
    seeds = {ensemble["seed"] for ensemble in material.metrics["ensembles"]}
    where = "layouts, pooled over them" if _has_layouts(material.metrics) else "states"
    caption = (
        f"The quantity of the paper's Figure 3, for one labelled context: balanced accuracy on held-out {where}. "
        "Filled: best member; bar: mean of members; hollow: worst member; each a mean over ensemble seeds. "
        "Dotted: always the same answer."
    )
    title, nothing = "Members' balanced accuracy on held-out states", "No held-out states have both classes."
    return [Drawn("members", title, drawn, caption, f"Ensemble seeds {page.spans(seeds)}.", nothing)]


def best_mean_worst_members(entries: Sequence[Entry]) -> Figure | None:
    """Balanced accuracy on held-out layouts by kind of ensemble, from entries of ``TABLE``; None if undefined."""
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
        axes.set_xlabel("balanced accuracy on held-out states (0.5: uniform-random)")
    return figure


QUESTION = Question(look=look, view=view, pairs=PAIRS, summary=summary, sections=sections, figures=figures)
