"""Figure 3: members on rooms that training did and did not see, for each number of labelled ladder groups.

The paper scores the best member on files that hold training rooms too, and picks that member on the same files. Here,
every score is given on unseen rooms and on all rooms. Beside the best member are the mean, the worst, and the member
that the rooms of the labelled groups would have picked, the only rooms whose labels were to be had.
"""

from functools import partial
from itertools import product

import pandas as pd
from matplotlib.figure import Figure

from hypogoal.evaluation import plots
from hypogoal.evaluation.hypotheses import KNOWLEDGE, VALIDATED
from hypogoal.evaluation.page import Drawn
from hypogoal.evaluation.statistics import tables_of
from hypogoal.evaluation.table import per_run

TITLE = "Hypotheses in rooms without labels"
SCORED = ("balanced_accuracy", "accuracy", "ranking")
WHICH = {
    "best": "best",
    "validated": VALIDATED,
    "mean": "mean",
    "worst": "worst",
}  # the ``member`` of ``per_run``
BY = ["method", "N", "sub_goal"]
NEVER = "accuracy, all, never positive"
PAIRED = [f"balanced_accuracy, unseen, {which}" for which in ("best", "validated", "mean")]
PANELS = {  # panels of Figure 3: the quantity, and the title
    "accuracy, all, best": "accuracy, all rooms: best",
    "balanced_accuracy, unseen, best": "balanced, unseen: best",
    "balanced_accuracy, unseen, validated": "balanced, unseen: validated",
    "balanced_accuracy, unseen, mean": "balanced, unseen: mean",
}


def context(results):
    """Return members' scores and disagreement, the accuracy of a member that is never positive, and Figure 3."""
    by_room = results.of(scope="unseen")["artefact"]
    if by_room.empty:
        return {}
    numbers = results.of(artefact=[*by_room.unique()])
    states = per_run(numbers, "states", scope="all")
    never = per_run(numbers, "positives", scope="all", name=NEVER)
    never = never.assign(of="accuracy", value=1 - never["value"] / states["value"])
    values = [never, per_run(numbers, *KNOWLEDGE, scope="unseen")]
    for scope in ("unlabelled", "heldout"):
        values.append(per_run(numbers, "disagreement", scope=scope, name=f"{{}}, {scope}"))
    for scope, (which, member) in product(("unseen", "all"), WHICH.items()):
        name = f"{{}}, {scope}, {which}"
        values.append(per_run(numbers, *SCORED, scope=scope, member=member, name=name))
    tables = tables_of(pd.concat(values), BY, PAIRED)
    return tables | {"figures": [*_figures(tables["table"])]}


def _figures(table):
    """Yield Figure 3 for each sub-goal."""
    sub_goals = table["sub_goal"].unique()
    for sub_goal in sub_goals:
        rows = table[table["sub_goal"] == sub_goal].dropna(subset="N")
        suffix = f"-{sub_goal}" if len(sub_goals) > 1 else ""
        label = "Figure 3: members against labelled groups"
        yield Drawn(
            f"figure3{suffix}",
            label,
            partial(scores_over_groups, rows),
            {"sub_goal": sub_goal},
        )


def scores_over_groups(table: pd.DataFrame) -> Figure:
    """Draw Figure 3: scores against the number of labelled ladder groups, a panel for each of ``PANELS``.

    ``table`` is a table of :func:`statistics.over` with one sub-goal. A member that is never positive is dotted.
    """
    never = table[table["quantity"] == NEVER].drop_duplicates("N").set_index("N")["mean"]
    figure = Figure(figsize=(plots.WIDTH, 4.55))
    axes = figure.subplots(2, 2, sharex=True, sharey=True).flat
    for place, (quantity, title) in zip(axes, PANELS.items(), strict=True):
        shown = table[table["quantity"] == quantity].set_index("N")
        for method in table["method"].unique():
            rows = shown[shown["method"] == method]
            errors = rows["standard_deviation"].fillna(0)
            place.errorbar(
                rows.index,
                rows["mean"],
                errors,
                label=method,
                marker="o",
                markersize=4,
                alpha=0.8,
            )
        blind = never if quantity.startswith("accuracy") else never * 0 + 0.5
        place.plot(blind.index, blind, **plots.DOTTED, marker=".")
        place.set_title(title, fontsize=9.5)
        place.set(xlabel="labelled groups, N", ylabel="fraction", xticks=sorted(never.index))
        place.label_outer()
    plots.legend_below(figure, 3)
    return figure
