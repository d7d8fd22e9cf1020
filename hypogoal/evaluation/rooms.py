"""Figure 3: members on rooms that training did and did not see, for each number of labelled ladder groups (Spec F1).

The paper scores the best member on files that hold training rooms too, and picks it on the same files. Here every
score stands on unseen rooms and on all rooms, and beside the best member are the mean, the worst and the one that the
rooms of the labelled groups, the only ones whose labels were to be had, would have picked.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from itertools import product
from operator import itemgetter
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray
from rich.table import Table as Printed

from hypogoal.evaluation import page
from hypogoal.evaluation.hypotheses import STATES
from hypogoal.evaluation.judging import Judgement, Work
from hypogoal.evaluation.numbers import Metrics, by_method, grouped, methods_lacking
from hypogoal.evaluation.page import Block, Drawn, Entry, Material, Question
from hypogoal.evaluation.plots import GREY, MARKERS, METHOD_COLOURS, STYLES, WIDTH, legend_below, styled
from hypogoal.evaluation.table import VALIDATED, Number, Pairs, Row, Table, rows_by_member, rows_of, select, tabulate
from hypogoal.hypotheses.scores import member_scores, ranking

# Values of the origin ``seen`` of a held-out state: its room was in no training set, among the unlabelled states, or
# among the labelled ones.
SCOPES = {"unseen": (0,), "all": (0, 1, 2), "labelled": (2,)}
VALIDATION = "labelled"
TABLED = ("unseen", "all")  # scopes of the tables and of Figure 3
SCORED = ("balanced_accuracy", "accuracy", "ranking")  # of which best, mean, ... are told
WHICH = {"best": "best", "validated": VALIDATED, "mean": "mean", "worst": "worst"}  # the member of a ``Number``
SHOWN = {"best": "best member", "validated": "validated member", "mean": "mean of members"}
SHARE = "share of states"
SPREAD = ("mean", "standard_deviation")  # of the figures
PAPERS = "climb-down-ladder"  # the paper's sub-goal; its authors' repository has others
PAPER = (
    "The paper: about 70 % for the best member at N=1 with both ensembles, the single CNN about 20 points lower, and a "
    "big step at N=2. Its test files include training rooms, as 'all rooms' does; it does not say how many of their "
    "states are positive, so compare methods and N rather than levels."
)
BESIDE, MOST_BESIDE = 0.06, 0.6  # units of N between methods with one N, and at most from the first to the last


def rows_by_room(
    probabilities: NDArray[np.float32],
    predictions: NDArray[np.bool_],
    labels: NDArray[np.bool_],
    origins: Mapping[str, NDArray[np.int64]],
    **place: Any,
) -> Iterator[Row]:
    """Spec F1: one ensemble's K members on N held-out states by whether training saw the room.

    Probabilities and predictions are (N, K); origins (N,) are ``seen`` (see ``SCOPES``) and, where there is one,
    ``room``. In each scope counts and every member's scores; on labelled rooms, the member that they pick.
    """
    seen = origins["seen"]
    for name, values in SCOPES.items():
        inside = np.isin(seen, values)
        scores = member_scores(predictions[inside], labels[inside])
        scores["ranking"] = ranking(probabilities[inside], labels[inside])
        yield from rows_by_member(scores, **place, scope=name)
        counts = {"states": int(inside.sum()), "positives": int(labels[inside].sum())}
        if "room" in origins:
            counts["rooms"] = len(np.unique(origins["room"][inside]))
        yield from rows_of(counts, **place, scope=name)
    yield from rows_of(choose(predictions, labels, seen), **place, scope=VALIDATION)


def choose(
    predictions: NDArray[np.bool_], labels: NDArray[np.bool_], seen: NDArray[np.int64]
) -> dict[str, int | float | None]:
    """Spec F1: the member with the highest balanced accuracy on rooms of labelled groups; ``validation``: that.

    The first of equally good ones, since their order is random; None where those rooms lack a class.
    """
    inside = np.isin(seen, SCOPES[VALIDATION])
    scores = member_scores(predictions[inside], labels[inside])["balanced_accuracy"]
    if np.isnan(scores).all():
        return {VALIDATED: None, "validation": math.nan}
    return {VALIDATED: int(np.nanargmax(scores)), "validation": float(np.nanmax(scores))}


def _columns() -> Iterator[tuple[str, Number]]:
    for scope, score, (which, member) in product(TABLED, SCORED, WHICH.items()):
        yield f"scores.{scope}.{score}.{which}", Number(score, scope, score, member, cell=(score, scope, which))
    for on in STATES:
        yield f"disagreement_{on}", Number("disagreement", on, SHARE, cell=(SHARE, on))


TABLE = Table(
    {"method": "method", "groups": "N", "sub_goal": "sub_goal"},
    dict(_columns()),
    "ensembles",
    order=by_method,
    deviation=True,
    cell=lambda key: (" ".join(map(str, key)),),
)
PAIRS = Pairs(
    "rooms",
    {
        f"balanced accuracy on unseen rooms, {which} member": Number("balanced_accuracy", "unseen", "", WHICH[which])
        for which in SHOWN
    },
    ranked=True,
)


def rooms_table(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """Spec F1, F2: Figure 3: per method, N and sub-goal its members' scores and disagreement, over seeds.

    ``scores``: scope -> score -> best, validated, mean, worst (see ``numbers.over``); by scope ``positives``, and
    ``all_negative``, the accuracy of negative predictions alone.
    """
    by_room = {row.artefact for row in rows if row.scope == "unseen"}
    rows = [row for row in rows if row.artefact in by_room]
    counts = {
        (row.method, row.N, row.sub_goal, row.scope, row.quantity): row.value
        for row in reversed(select(rows, quantity=("states", "positives")))  # the first ensemble's
    }
    table = tabulate(rows, TABLE)
    for entry in table:
        cell = tuple(entry[name] for name in TABLE.by)
        positives = {scope: counts[*cell, scope, "positives"] for scope in TABLED}
        states = {scope: counts[*cell, scope, "states"] for scope in TABLED}
        entry["positives"] = positives
        entry["all_negative"] = {on: 1 - positives[on] / states[on] if states[on] else math.nan for on in TABLED}
    return table


def look(work: Work, judgement: Judgement) -> Iterator[Row]:
    """Members room by room, where held-out states say which rooms training saw."""
    split, judged = judgement.split, judgement.judged
    if "seen" in split.origins:
        place = work.place(judgement)
        yield from rows_by_room(judged.probabilities, judged.predictions, split.labels, split.origins, **place)


def missing(work: Work) -> list[str]:
    """Spec F1: the methods that are not there, of a run with ladders."""
    rooms = work.metrics["rooms"]
    return methods_lacking(rooms, "ensemble", "Figure 3") if rooms or work.contents.ladders else []


def group_name(entry: Entry) -> str:
    """N as a table shows it."""
    return "–" if entry["groups"] is None else str(entry["groups"])


N = page.label("N", group_name)
UNSEEN = (
    *(page.number(which, f"scores.unseen.balanced_accuracy.{which}", page.deviation, 2) for which in WHICH),
    page.number("acc., all", "scores.all.accuracy.best", page.deviation, 2),
    page.number("seeds", "ensembles"),
)


def summary(metrics: Metrics) -> list[Printed]:
    """Figure 3 by method and N: on unseen rooms, and the paper's number."""
    rows = metrics["rooms"]
    method = page.label("method", page.method_of(rows))
    title = "Balanced accuracy on unseen rooms; the best member's accuracy on all rooms"
    return [page.terminal(title, (method, page.number("N", group_name), *UNSEEN), rows)] if rows else []


def sections(material: Material) -> list[Block]:
    """The question about ladders; Figure 3 and its table: what else is known of members is in ``metrics.json``."""
    if not material.of_ladders():
        return []
    metrics = material.metrics
    question = (
        "A sub-goal, such as being at the base of a ladder, is known from a few rooms only. An ensemble of classifiers "
        "holds several hypotheses about what the sub-goal is. Does one of them hold in rooms that training never saw, "
        "can it be picked, and does an option that ends where it is positive end at the sub-goal?"
    )
    alone = not metrics["agents"]
    identity, title = ("summary", "Summary") if alone else ("ladders", "Summary of the ladders")
    summaries = [page.section(identity, title, [question], [], metrics["missing"] if alone else [])]
    text = (
        "N is the number of groups of rooms with labels. Members are judged on held-out states of rooms that no "
        "training state came from (unseen), and of all rooms, training rooms included, as in the paper. The best "
        "member is picked on the very states that it is scored on, so it rises with the number of members, whatever "
        "they learned; the validated member is the one with the highest balanced accuracy on held-out states in the "
        "rooms of labelled groups, which a user could pick too."
    )
    blocks = [*(page.shown(material, figure) for figure in figures(material)), _table(metrics["rooms"])]
    blocks += page.comparison_tables(material.comparisons("rooms"), "ensemble seed and N")
    judged = page.section("rooms", "Hypotheses in rooms without labels", [text], blocks)
    return [*summaries, judged] if metrics["rooms"] else summaries


def _table(rows: Sequence[Entry]) -> Block:
    return page.table(
        (
            page.label("method", page.method_of(rows), once=True),
            N,
            *UNSEEN,
            page.number("disagree, unlabelled", "disagreement_unlabelled", page.deviation, 3),
            page.number("disagree, held-out", "disagreement_heldout", page.deviation, 3),
        ),
        rows,
        tight=True,
        caption="Balanced accuracy on held-out states of unseen rooms of the best, the validated, the mean and the "
        "worst member; accuracy (acc.) of the best one on those of all rooms; the share of states on which two "
        "members' predictions differ, mean over pairs: mean over ensemble seeds ± standard deviation over them. "
        f"{_never(rows)}{PAPER if any(row['sub_goal'] == PAPERS for row in rows) else ''}",
    )


def _never(rows: Sequence[Entry]) -> str:
    """What accuracy on all rooms is worth here, and where balanced accuracy is not defined."""
    several = len({entry["sub_goal"] for entry in rows}) > 1
    accuracies = {
        (entry["sub_goal"] if several else "", entry["groups"]): entry["all_negative"]["all"]
        for entry in rows
        if entry["all_negative"]["all"] is not None
    }
    texts = []
    for (sub_goal, groups), accuracy in sorted(accuracies.items(), key=str):
        scope = ", ".join([sub_goal] * several + [f"N={groups}"] * (groups is not None))
        texts.append(f"{accuracy:.2f}{scope and f' ({scope})'}")
    text = f"A member that is never positive has accuracy {page.listed(texts)}. " if texts else ""
    bare = sorted({entry["groups"] for entry in rows if entry["positives"]["unseen"] == 0 and entry["groups"]})
    if not bare:
        return text
    return (
        f"{text}At N={page.listed(bare)} no unseen room has positives left: balanced accuracy on them is not "
        "defined (–), and accuracy there is the share of negatives called negative. "
    )


def figures(material: Material) -> Iterator[Drawn]:
    """Figure 3, and what it leaves out, of each sub-goal."""
    by_sub_goal = list(grouped(material.metrics["rooms"], itemgetter("sub_goal")).values())
    panels = [("accuracy, all rooms: best member", "all", "accuracy", "best")]
    panels += [(f"balanced, unseen: {name}", "unseen", "balanced_accuracy", which) for which, name in SHOWN.items()]
    for rows in by_sub_goal:
        methods = {entry["method"] for entry in rows}
        seeds = {entry["seed"] for entry in material.metrics["ensembles"] if entry.get("method") in methods}
        sub_goal = rows[0]["sub_goal"]
        caption = (
            "Figure 3 of the paper (top left) and what it leaves out: balanced accuracy on unseen rooms of the best "
            "member, of the validated one, which alone can be had without labels from the rooms it is for, and of the "
            "mean one; mean over ensemble seeds, bands (bars where a method has one N): ± one standard deviation over "
            "seeds. Dotted: never positive."
            if rows is by_sub_goal[0]
            else f"The same, for {sub_goal}."
        )
        nothing = "Its data do not say how many ladder groups have labels (setting 'groups')."
        title, drawn = "Figure 3: members against labelled groups", scores_over_groups(rows, panels)
        suffix = f"-{sub_goal}" if len(by_sub_goal) > 1 else ""
        heading, runs = sub_goal if suffix else "", f"Ensemble seeds {page.spans(seeds)}."
        yield Drawn(f"figure3{suffix}", title, drawn, caption, runs, nothing, heading=heading)


def scores_over_groups(rows: Sequence[Entry], panels: Sequence[tuple[str, str, str, str]]) -> Figure | None:
    """Figure 3: scores against the number of labelled ladder groups, methods coloured in the order of the rows.

    Rows are of :func:`rooms_table`; those without N are left out, and where all are there is no figure. A panel is a
    title, and of which scope, score and member. Dotted is what it takes no seeing to score.
    """
    names, rows = list(grouped(rows, itemgetter("method"))), [row for row in rows if row["groups"] is not None]
    if not rows:
        return None
    with styled():
        high = -(-len(panels) // 2)
        figure = Figure(figsize=(WIDTH, 2.25 * high + 0.05), layout="constrained")
        axes = figure.subplots(high, 2, sharex=True, sharey=True, squeeze=False)
        ticks, lowest = sorted({row["groups"] for row in rows}), 0.5
        for place, (title, scope, score, which) in zip(axes.flat, panels, strict=False):
            for name, entries in grouped(rows, itemgetter("method")).items():
                scores = [(entry["groups"], entry["scores"][scope][score][which]) for entry in entries]
                points = np.array([(groups, *(over[key] for key in SPREAD)) for groups, over in scores], float).T
                _draw_method(place, name, names, points)
                lowest = float(np.nanmin([lowest, *(points[1] - np.nan_to_num(points[2]))]))
            blind = {}
            for row in sorted(rows, key=itemgetter("groups")):
                never = row["all_negative"][scope] if score == "accuracy" else 0.5 if row["positives"][scope] else None
                if never is not None:
                    blind[row["groups"]] = never
            if len(blind) == 1:  # of one N a line is a point, which a method's marker may hide
                place.axhline(*blind.values(), color=GREY, linewidth=1.2, linestyle=":", zorder=0)
            else:
                place.plot(list(blind), list(blind.values()), ".:", color=GREY, linewidth=1.2, markersize=3)
            place.set_title(title, fontsize=9.5)
        for place in axes.flat:
            place.set(ylim=(max(0.0, lowest - 0.03), 1.03), xticks=ticks, xlim=(ticks[0] - 0.4, ticks[-1] + 0.4))
        for place in axes[-1]:
            place.set_xlabel("labelled groups, N")
        for place in axes[:, 0]:
            place.set_ylabel("fraction")
        legend_below(figure, list(axes.flat), 3, handlelength=2.6)
        return figure


def _draw_method(axes: Axes, name: str, names: Sequence[str], points: NDArray[np.float64]) -> None:
    """One of the methods ``names``; ``points``, (3, n), are N, mean and standard deviation."""
    index, count = names.index(name), len(names)  # of colours there are 6, of lines 5: both again after 30
    colour, line, marker = (looks[index % len(looks)] for looks in (METHOD_COLOURS, STYLES, MARKERS))
    if points.shape[1] == 1:  # the others with one N lie at the same place
        points[0] += (index - (count - 1) / 2) * min(BESIDE, MOST_BESIDE / count)
    axes.plot(*points[:2], marker, linestyle=line, color=colour, linewidth=1.6, markersize=5, label=name)
    groups, mean, deviation = points[:, ~np.isnan(points).any(0)]
    if len(mean) == 1:  # a band would have no width
        axes.errorbar(groups, mean, deviation, color=colour, capsize=3, linewidth=1.2)
    else:
        axes.fill_between(groups, mean - deviation, mean + deviation, color=colour, alpha=0.15, linewidth=0)


QUESTION = Question(
    look=look,
    view=lambda work: {"rooms": rooms_table(work.rows)},
    missing=missing,
    pairs=PAIRS,
    summary=summary,
    sections=sections,
    figures=figures,
    needed={
        "figure3": "ensemble artefacts of data of 1 to 7 labelled ladder groups: run montezuma-ladders --preset figure3"
    },
)
