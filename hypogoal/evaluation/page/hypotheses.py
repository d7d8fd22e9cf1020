"""The sections on the ensembles: accuracy and disagreement of members, and example states."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from hypogoal.evaluation.comparisons import ALL
from hypogoal.evaluation.figures import best_mean_worst_members
from hypogoal.evaluation.page.blocks import (
    Block,
    Material,
    figure,
    fixed,
    listed,
    pick,
    picture,
    row,
    section,
    spread,
    table,
    texts,
)
from hypogoal.evaluation.page.comparisons import comparison_tables

KINDS = {
    "disagree": "members disagree",
    "wrong": "all members wrong",
    "right yes": "all right",
    "right no": "all right",
}


def hypotheses_section(material: Material) -> Block:
    """Figure 3's question on held-out layouts: best, mean and worst member, and how much members disagree."""
    metrics = material.metrics
    if _of_layouts(metrics):
        judged = "Members are judged on layouts whose states were in no training set."
    else:
        judged = (
            "Members are judged on the held-out states of the data. Where these are a share of the labelled ones they "
            "say nothing of other contexts."
        )
    text = (
        f"{judged} The best member shows whether a hypothesis that holds there is in the ensemble at all; mean and "
        "worst show what the agent has to choose among. Balanced accuracy is 0.5 for a member that always says the "
        "same."
    )
    if not metrics["ensembles"]:
        nothing = figure(
            material, "members", "Members' accuracy", None, missing="It needs an ensemble artefact: train-ensemble."
        )
        return section("hypotheses", "Hypotheses", [], [nothing])
    pairs = [entry for entry in material.comparisons("hypotheses") if entry["where"] == ALL]
    shared = "ensemble seed and sub-goal (each sub-goal by itself is in metrics.json)"
    compared = comparison_tables(pairs, shared)
    return section(
        "hypotheses", "Hypotheses", [text], [_dots(material), _table(metrics), *compared, *_members(metrics)]
    )


def _of_layouts(metrics: Mapping[str, Any]) -> bool:
    """Whether held-out states are of layouts, as collected ones are, and not only states, as imported ones."""
    return any(goal["by_layout"] for ensemble in metrics["ensembles"] for goal in ensemble["sub_goals"])


def _dots(material: Material) -> Block:
    rows = material.metrics["hypotheses"]
    sub_goals = list(dict.fromkeys(entry["sub_goal"] for entry in rows))
    kinds = []
    for name in dict.fromkeys(entry["name"] for entry in rows):
        values = np.full((len(sub_goals), 3), np.nan)
        for entry in rows:
            if entry["name"] == name:
                means = [entry[which]["mean"] for which in ("best", "mean", "worst")]
                values[sub_goals.index(entry["sub_goal"])] = [np.nan if mean is None else mean for mean in means]
        kinds.append((name, values))
    drawn = best_mean_worst_members(sub_goals, kinds) if np.isfinite([values for _, values in kinds]).any() else None
    seeds = sorted({ensemble["seed"] for ensemble in material.metrics["ensembles"]})
    where = "layouts, pooled over them" if _of_layouts(material.metrics) else "states"
    caption = (
        f"The quantity of the paper's Figure 3, for one labelled context: balanced accuracy on held-out {where}. "
        "Filled: best member; bar: mean of members; hollow: worst member; each a mean over ensemble seeds "
        f"({listed(seeds)}). Dotted: always the same answer."
    )
    missing = "No held-out states have both classes."
    return figure(material, "members", "Members' balanced accuracy on held-out states", drawn, caption, missing)


def _table(metrics: Mapping[str, Any]) -> Block:
    rows = []
    last = ""
    for entry in metrics["hypotheses"]:
        rows.append(
            row(
                entry["name"] if entry["name"] != last else "",
                entry["sub_goal"],
                *(spread(entry[which], 3) for which in ("best", "mean", "worst")),
                spread(entry["disagreement_unlabelled"], 3),
                spread(entry["disagreement_heldout"], 3),
                str(entry["ensembles"]),
                mark="first" if entry["name"] != last else "",
            )
        )
        last = entry["name"]
    return table(
        ("ensemble", "sub-goal", "best", "mean", "worst", "disagree, unlabelled", "disagree, held-out", "seeds"),
        rows,
        texts=2,
        caption="Balanced accuracy on held-out states of the best, mean and worst member, and the share of states "
        "on which two members disagree (mean over pairs); mean over ensemble seeds ± standard error.",
    )


def _members(metrics: Mapping[str, Any]) -> list[Block]:
    blocks = []
    for ensemble in metrics["ensembles"]:
        rows = []
        for goal in ensemble["sub_goals"]:
            for index, member in enumerate(goal["members"]):
                names = ("balanced_accuracy", "precision", "recall", "accuracy", "f1", "says_yes_unlabelled")
                rows.append(
                    row(
                        goal["sub_goal"] if index == 0 else "",
                        f"member {member['member']}",
                        *(fixed(member[name], 3) for name in names),
                        mark="first" if index == 0 else "",
                    )
                )
        goal = ensemble["sub_goals"][0] if ensemble["sub_goals"] else {"states": 0, "by_layout": []}
        blocks.append(
            table(
                ("sub-goal", "member", "bal. acc.", "precision", "recall", "accuracy", "F1", "yes, unlabelled"),
                rows,
                texts=2,
                folded=f"Every member of {ensemble['path']} ({ensemble['name']}, seed {ensemble['seed']})",
                caption=f"Pooled over {goal['states']} held-out states{_layouts(goal)}; the last "
                "column is the share of unlabelled states that the member calls positive.",
            )
        )
    return blocks


def _layouts(goal: Mapping[str, Any]) -> str:
    return f" of {len(goal['by_layout'])} layouts" if goal["by_layout"] else ""


def examples_section(material: Material) -> Block:
    """Held-out states with each member's verdict beside the truth."""
    names = [name for name in material.arrays if name.startswith("examples/") and name.endswith("/observations")]
    if not names:
        missing = ["No example states: they need an ensemble artefact."]
        return section("examples", "Example states", [], [], missing)
    shown = material.metrics["saliency"]["ensemble"]
    source = pick(material.metrics["ensembles"], "path", shown)
    text = (
        f"Held-out states and what each member of {source['path']} (seed {source['seed']}) says of them: its "
        "probability that the sub-goal is reached. Orange: verdicts that differ from the truth. Chosen to show "
        "each kind, so their frequency here says nothing."
    )
    order = [goal["sub_goal"] for goal in source["sub_goals"]]
    names.sort(key=lambda name: order.index(name.split("/")[1]))
    return section("examples", "Example states", [text], [_cards(material, name.split("/")[1]) for name in names])


def _cards(material: Material, sub_goal: str) -> Block:
    arrays = {
        key: material.arrays[f"examples/{sub_goal}/{key}"]
        for key in ("observations", "probabilities", "verdicts", "labels", "places", "kinds")
    }
    places = texts(arrays["places"])
    cards = []
    for index, kind in enumerate(texts(arrays["kinds"])):
        truth = bool(arrays["labels"][index])
        lines = []
        for member, probability in enumerate(arrays["probabilities"][index]):
            verdict = bool(arrays["verdicts"][index, member])
            said = "yes" if verdict else "no"
            mark = "wrong" if verdict != truth else "yes" if verdict else "no"
            lines.append({"class": mark, "text": f"member {member}: {said} {probability:.2f}"})
        place = f", {places[index]}" if places[index] else ""
        cards.append(
            {
                "png": picture(arrays["observations"][index]),
                "alt": f"A held-out state; {sub_goal} is {'reached' if truth else 'not reached'}.",
                "title": f"{KINDS[kind]}; truth: {'yes' if truth else 'no'}{place}",
                "lines": lines,
            }
        )
    return {"kind": "cards", "heading": sub_goal, "cards": cards}
