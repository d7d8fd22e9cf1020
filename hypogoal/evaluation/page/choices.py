"""The sections on what options stand for and which of them are chosen: Figures 7 and 8, and question 5."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hypogoal.evaluation.figures import preference_against_match
from hypogoal.evaluation.page.blocks import (
    Block,
    Material,
    figure,
    fixed,
    interval,
    listed,
    picture,
    row,
    section,
    table,
)
from hypogoal.evaluation.page.variants import control_of, variants, which

QUANTITIES = {
    "preference": "preference",
    "late_preference": "preference, last quarter",
    "share": "raw share (confounded)",
}


def terminations_section(material: Material) -> Block:
    """Figures 7 and 8: where the most and the least preferred member's options stopped."""
    selection = material.metrics["selection"]
    agent = next(iter(variants(selection)), None)
    title = "Where options stop"
    if agent is None:
        missing = ["Overlaid termination states: they need a meta artefact with learned terminations: train-meta."]
        return section("terminations", title, [], [], missing)
    text = (
        "The states in which a member's classifier ended its option, laid over each other: what all of them share is "
        "sharp, what few of them show is dim. For each sub-goal the member that the agent prefers most and the one "
        "it prefers least; match is the member's balanced accuracy against the true sub-goal on that layout."
    )
    blocks = []
    for index, run in enumerate(agent["runs"]):
        name = f"layout seed {run['layout_seed']}, run seed {run['seed']}"
        blocks.append(
            {
                "kind": "pairs",
                "heading": name if index == 0 else "",
                "folded": "" if index == 0 else name[0].upper() + name[1:],
                "pairs": [_pair(material, run, goal) for goal in run["sub_goals"]],
                "caption": f"Figures 7 and 8 of the paper, for all sub-goals: {run['path']}, {name}. The last "
                "states, 128 at most, in which the option's own classifier said yes.",
            }
        )
    return section("terminations", title, [text, which(agent, selection)], blocks)


def _pair(material: Material, run: Mapping[str, Any], goal: Mapping[str, Any]) -> dict[str, Any]:
    sides = []
    for word in ("most", "least"):
        index = goal[word]
        if index is None:
            sides.append({"png": "", "nothing": "never offered", "title": f"{word} preferred: none", "note": ""})
            continue
        member = goal["members"][index]
        place = f"terminations/{run['path']}/{member['option']}"
        note = f"preference {fixed(member['preference'], 2)}, match {fixed(member['match'], 2)}"
        title = f"{word} preferred: member {index}"
        if place not in material.arrays:
            sides.append({"png": "", "nothing": "its classifier never ended it", "title": title, "note": note})
            continue
        alt = f"Overlaid termination states of {goal['sub_goal']}, member {index}"
        sides.append({"png": picture(material.arrays[place]), "alt": alt, "title": title, "note": note})
    return {"title": goal["sub_goal"], "sides": sides}


def choices_section(material: Material) -> Block:
    """Question 5: does reward lead to the hypotheses that transfer?"""
    selection = material.metrics["selection"]
    agent = next(iter(variants(selection)), None)
    title = "Which hypotheses are chosen"
    if agent is None:
        needed = "It needs a meta artefact with learned terminations: train-meta."
        return section("choices", title, [], [figure(material, "preference", title, None, missing=needed)])
    text = (
        "Preference is how often an option was chosen over how often a uniform choice among the options offered "
        "would have chosen it. Raw shares are confounded by availability: a member that fires everywhere is masked "
        "nearly always, one that never fires is always offered. The random chooser's numbers show what no preference "
        "looks like."
    )
    control = control_of(material, agent, selection)
    blocks = [_scatter(material, agent, control), _correlations(material)]
    for index, run in enumerate(agent["runs"]):
        blocks.append(_members(run, folded=index > 0))
    missing = [] if control else ["No random chooser beside it: it needs a meta artefact with chooser=random."]
    shown = which(agent, selection)
    if shown:
        shown = f"{shown} Rank correlations are those of every variant."
        missing = [] if control else [f"No random choice among the options of {agent['name']} was run."]
    return section("choices", title, [text, shown], blocks, missing)


def _values(agent: Mapping[str, Any], key: str) -> NDArray[np.float64]:
    """Float (runs, sub-goals, members)."""
    return np.array(
        [
            [
                [np.nan if member[key] is None else member[key] for member in goal["members"]]
                for goal in run["sub_goals"]
            ]
            for run in agent["runs"]
        ],
        dtype=np.float64,
    )


def _scatter(material: Material, agent: Mapping[str, Any], control: Mapping[str, Any] | None) -> Block:
    match, preference = _values(agent, "match"), _values(agent, "preference")
    uncaring = (_values(control, "match").ravel(), _values(control, "preference").ravel()) if control else None
    names = [goal["sub_goal"] for goal in agent["runs"][0]["sub_goals"]]
    drawn = preference_against_match(names, match, preference, uncaring)
    layouts = sorted({run["layout_seed"] for run in agent["runs"]})
    caption = (
        "Question 5 of the paper: a point per member and run, over all of training; up: chosen more often than by a "
        f"uniform chooser; right: closer to the true sub-goal on that layout (layout seed {listed(layouts)}; runs: "
        f"{len(agent['runs'])}). {which(agent, material.metrics['selection'])}"
    ).rstrip()
    return figure(material, "preference", "Preference against match", drawn, caption)


def _correlations(material: Material) -> Block:
    rows = []
    for agent in material.metrics["selection"]:
        for index, (key, name) in enumerate(QUANTITIES.items()):
            found = agent["rank_correlation"][key]
            rows.append(
                row(
                    agent["name"] if index == 0 else "",
                    name,
                    interval(found["within"], 2),
                    interval(found["all"], 2),
                    str(found["within"]["n"]),
                    mark="first" if index == 0 else "",
                )
            )
    return table(
        ("chooser", "ranked by", "within sub-goals", "over all options", "runs"),
        rows,
        texts=2,
        heading="Rank correlation with the match",
        caption="Spearman's rank correlation between how a member is ranked and its match with the true sub-goal on "
        "the run's layout; interquartile mean over runs, 95 % bootstrap interval. Within: mean over sub-goals of the "
        "correlation among a sub-goal's members. 1 would mean that reward picks out the hypotheses that transfer, 0 "
        "that it does not.",
    )


def _members(run: Mapping[str, Any], *, folded: bool) -> Block:
    name = f"layout seed {run['layout_seed']}, run seed {run['seed']}"
    rows = []
    for goal in run["sub_goals"]:
        for index, member in enumerate(goal["members"]):
            notes = [word for word in ("most", "least") if goal[word] == index]
            rows.append(
                row(
                    goal["sub_goal"] if index == 0 else "",
                    f"{index}{' (' + notes[0] + ')' if notes else ''}",
                    str(member["offered"]),
                    str(member["chosen"]),
                    fixed(member["expected"], 0),
                    fixed(member["preference"], 2),
                    fixed(member["late_preference"], 2),
                    fixed(None if member["share"] is None else 100 * member["share"], 1),
                    fixed(member["duration"], 1),
                    fixed(member["match"], 2),
                    mark="first" if index == 0 else "",
                )
            )
    return table(
        ("sub-goal", "member", "offered", "chosen", "expected", "preference", "late", "share, %", "steps", "match"),
        rows,
        texts=2,
        heading="" if folded else f"Every member: {name}",
        folded=f"Every member: {name}" if folded else "",
        caption="Decisions at which the option was offered and chosen; expected under uniform choice; preference "
        "over all and over the last quarter of training; raw share of decisions; mean steps of an execution; match "
        "on this layout.",
    )
