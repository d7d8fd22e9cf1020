"""The page of several runs side by side: what differs, curves with bands, tables, and who wins (Spec F5, F7)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hypogoal.evaluation.comparing import common_names, on_grid
from hypogoal.evaluation.figures import PALETTE, Line, learning_curves, reward_bounds
from hypogoal.evaluation.ladder_figures import scores_over_groups
from hypogoal.evaluation.page.blocks import (
    Block,
    Material,
    deviation,
    figure,
    listed,
    pick,
    row,
    section,
    spread,
    table,
)
from hypogoal.evaluation.page.comparisons import comparison_tables
from hypogoal.evaluation.page.rooms import bands, panel
from hypogoal.evaluation.summary import percent, solved

Runs = Mapping[str, Mapping[str, Any]]  # a run's label -> its metrics
MOST_LINES = len(PALETTE)  # in one figure
POINTS = 151


def compared_sections(
    runs: Runs, curves: Mapping[str, Mapping[str, NDArray[Any]]], about: Mapping[str, Any], material: Material
) -> list[Block]:
    """The page's sections; of results only those that every run has.

    Args:
        runs: in the order given; the first is the one that the others are compared with.
        curves: a run's label -> the arrays of its learning curves.
        about: the comparison's own numbers: ``runs``, ``shared``, ``differences``, ``comparisons``.
        material: figures are added to it.
    """
    sections = [_runs(about), _differences(about)]
    if "agents" in about["shared"]:
        sections.append(_agents(runs, curves, material))
    if "hypotheses" in about["shared"]:
        sections.append(_hypotheses(runs))
    if "rooms" in about["shared"]:
        sections.append(_rooms(runs, material))
    if "distance" in about["shared"]:
        sections.append(_distance(runs))
    sections.append(_pairs(about))
    return sections


def _runs(about: Mapping[str, Any]) -> Block:
    lines = [
        row(
            one["label"],
            one["path"],
            str(one["artefacts"]),
            listed(one["seeds"]),
            listed(one["layout_seeds"]),
            mark="main" if index == 0 else "",
        )
        for index, one in enumerate(about["runs"])
    ]
    text = (
        f"Evaluated runs of {listed(about['domains'])}: {listed([one['label'] for one in about['runs']])}. The first "
        "is the one that the others are compared with. Each run's own report has everything else."
    )
    found = table(("run", "folder", "artefacts", "seeds", "layouts"), lines, texts=5, wrap=True)
    return section("summary", "What is compared", [text], [found])


def _differences(about: Mapping[str, Any]) -> Block:
    labels = [one["label"] for one in about["runs"]]
    lines, last = [], ""
    for one in about["differences"]:
        own = [one["values"][label] for label in labels]
        lines.append(row(one["of"] if one["of"] != last else "", one["setting"], *own, mark=_mark(one["of"] != last)))
        last = one["of"]
    text = (
        "Settings, seeds, data and versions that are not the same in all runs; several values are of several artefacts "
        "in one run. What is not here is the same."
        if lines
        else "Nothing: settings, seeds, data and versions are the same."
    )
    blocks = [table(("of", "setting", *labels), lines, texts=2 + len(labels), wrap=True)] if lines else []
    return section("differences", "What differs", [text], blocks)


def _mark(first: bool) -> str:
    return "first" if first else ""


def _agents(runs: Runs, curves: Mapping[str, Mapping[str, NDArray[Any]]], material: Material) -> Block:
    names = common_names([metrics["agents"] for metrics in runs.values()])
    every = list(dict.fromkeys(agent["name"] for metrics in runs.values() for agent in metrics["agents"]))
    blocks = []
    for index, name in enumerate(names):
        for quantity in ("reward", "length"):
            wanted = [(label, name, label) for label in runs]
            blocks.append(_curve(runs, curves, material, f"{quantity}-{index}", quantity, wanted, name))
    if not names:
        wanted = [
            (label, agent["name"], f"{label}: {agent['name']}") for label in runs for agent in runs[label]["agents"]
        ]
        for quantity in ("reward", "length"):
            blocks.append(_curve(runs, curves, material, quantity, quantity, wanted, "every agent"))
    lines = []
    for name in every:
        first = True
        for label, metrics in runs.items():
            for agent in metrics["agents"]:
                if agent["name"] == name:
                    lines.append(
                        row(
                            name if first else "",
                            label,
                            str(len(agent["runs"])),
                            spread(agent["success"], 1, 100),
                            spread(agent["length"], 0),
                            spread(agent["length_over_shortest"], 2),
                            spread(agent["discounted_return"], 2),
                            solved(agent["steps_to_95"]),
                            mark=_mark(first),
                        )
                    )
                    first = False
    caption = (
        "Over the last 100 training episodes of each run of an agent: mean ± standard error. 95 % at: median number of "
        "environment steps at which 95 of the last 100 episodes succeeded, or how many runs got there."
    )
    columns = ("agent", "run", "runs", "success, %", "steps", "× shortest", "discounted return", "95 % at")
    return section("agents", "Agents", [], [table(columns, lines, texts=2, caption=caption), *blocks])


def _curve(
    runs: Runs,
    curves: Mapping[str, Mapping[str, NDArray[Any]]],
    material: Material,
    identity: str,
    quantity: str,
    wanted: Sequence[tuple[str, str, str]],
    name: str,
) -> Block:
    """A figure with a line for each (run, agent, what it is called)."""
    shown = wanted[:MOST_LINES]
    end = max(int(curves[label]["curves/grid"][-1]) for label, _, _ in shown)
    grid = np.linspace(0, end, POINTS).round().astype(np.int64)
    lines = []
    for index, (label, agent, called) in enumerate(shown):
        place = [one["name"] for one in runs[label]["agents"]].index(agent)
        own = curves[label]
        values = on_grid(own[f"curves/{place}/{quantity}"], own["curves/grid"], grid)
        lines.append(Line(called, values, PALETTE[index], dashed=index % 2 == 1))
    axis = "reward per episode" if quantity == "reward" else "episode length (steps)"
    drawn = learning_curves(grid, lines, axis, (), reward_bounds(lines) if quantity == "reward" else (0.0, None))
    counts = "; ".join(f"{label}, {_count(runs[label], agent)}" for label, agent, _ in shown)
    more = f" Not drawn: {listed([called for _, _, called in wanted[MOST_LINES:]])}." if wanted[MOST_LINES:] else ""
    caption = (
        f"{name}: {axis}, mean over the last 100 episodes known at each step. Lines: mean over layouts and seeds; "
        f"bands: ± one standard error over them ({counts}).{more}"
    )
    label = "Undiscounted reward" if quantity == "reward" else "Episode length"
    return {**figure(material, identity, f"{label}: {name}", drawn, caption), "heading": f"{label}: {name}"}


def _count(metrics: Mapping[str, Any], agent: str) -> str:
    found = pick(metrics["agents"], "name", agent)["runs"]
    layouts, seeds = (sorted({run[key] for run in found}) for key in ("layout_seed", "seed"))
    count = f"{len(found)} run{'s' if len(found) > 1 else ''}"
    return f"{count}: layout seeds {listed(layouts)}, run seeds {listed(seeds)}"


def _hypotheses(runs: Runs) -> Block:
    keys = list(
        dict.fromkeys((one["name"], one["sub_goal"]) for metrics in runs.values() for one in metrics["hypotheses"])
    )
    lines, last = [], ""
    for name, sub_goal in keys:
        for index, (label, metrics) in enumerate(runs.items()):
            found = [one for one in metrics["hypotheses"] if (one["name"], one["sub_goal"]) == (name, sub_goal)]
            for one in found:
                lines.append(
                    row(
                        name if name != last else "",
                        sub_goal if index == 0 else "",
                        label,
                        *(spread(one[which], 3) for which in ("best", "mean", "worst")),
                        spread(one["disagreement_heldout"], 3),
                        str(one["ensembles"]),
                        mark=_mark(index == 0),
                    )
                )
                last = name
    caption = (
        "Balanced accuracy on held-out layouts of the best, mean and worst member, and the share of held-out states on "
        "which two members disagree; mean over ensemble seeds ± standard error."
    )
    columns = ("ensemble", "sub-goal", "run", "best", "mean", "worst", "disagree", "seeds")
    return section("hypotheses", "Hypotheses", [], [table(columns, lines, texts=3, tight=True, caption=caption)])


def _rooms(runs: Runs, material: Material) -> Block:
    blocks = []
    names = common_names([metrics["rooms"] for metrics in runs.values()], "method")
    for index, name in enumerate(names):
        rows = [
            {**one, "method": label}
            for label, metrics in runs.items()
            for one in metrics["rooms"]
            if one["method"] == name
        ]
        if all(one["groups"] is None for one in rows) or len({one["sub_goal"] for one in rows}) > 1:
            continue
        panels = [
            panel(rows, f"{which} member, unseen rooms", "unseen", "balanced_accuracy", which)
            for which in ("best", "validated")
        ]
        caption = (
            f"{name}: balanced accuracy on rooms that training never saw, against labelled ladder groups. Lines: mean "
            f"over ensemble seeds; {bands(rows)}: ± one standard deviation over seeds. Dotted: chance."
        )
        drawn = scores_over_groups(panels, list(runs))
        label = f"Scores on unseen rooms: {name}"
        blocks.append({**figure(material, f"rooms-{index}", label, drawn, caption), "heading": label})
    keys = dict.fromkeys((one["method"], one["groups"]) for metrics in runs.values() for one in metrics["rooms"])
    lines = []
    for method, groups in keys:
        first = True
        for label, metrics in runs.items():
            for one in metrics["rooms"]:
                if (one["method"], one["groups"]) == (method, groups):
                    unseen = one["scores"]["unseen"]["balanced_accuracy"]
                    lines.append(
                        row(
                            method if first else "",
                            ("–" if groups is None else str(groups)) if first else "",
                            label,
                            *(deviation(unseen[which], 2) for which in ("best", "validated", "mean", "worst")),
                            deviation(one["scores"]["all"]["accuracy"]["best"], 2),
                            str(one["ensembles"]),
                            mark=_mark(first),
                        )
                    )
                    first = False
    caption = (
        "Balanced accuracy on unseen rooms of the best, the validated, the mean and the worst member; accuracy of the "
        "best member on all rooms (the paper's Figure 3). Mean over ensemble seeds ± standard deviation."
    )
    columns = ("method", "N", "run", "best", "validated", "mean", "worst", "acc., all", "seeds")
    blocks.append(table(columns, lines, texts=3, tight=True, caption=caption))
    return section("rooms", "Hypotheses against labelled ladders", [], blocks)


def _distance(runs: Runs) -> Block:
    found = {label: metrics["distance"]["over_ladders"] for label, metrics in runs.items()}
    keys = dict.fromkeys((one["method"], one["groups"]) for rows in found.values() for one in rows)
    lines = []
    for method, groups in keys:
        first = True
        for label, rows in found.items():
            for one in rows:
                if (one["method"], one["groups"]) == (method, groups):
                    lines.append(
                        row(
                            method if first else "",
                            ("–" if groups is None else str(groups)) if first else "",
                            label,
                            ", ".join(one["ladders"]),
                            *(deviation(one[which], 1) for which in ("best", "validated", "mean", "worst")),
                            percent(one["reached_base"]["mean"]),
                            str(one["seeds"]),
                            mark=_mark(first),
                        )
                    )
                    first = False
    caption = (
        "Distance (units of position, lower is better) from where options stop to the nearest true base, mean over the "
        "ladders named: of the best, the validated, the mean and the worst member; share of the best member's "
        "executions that got to one. Mean over seeds ± standard deviation. Runs with other ladders are not alike."
    )
    columns = ("method", "N", "run", "ladders", "best", "validated", "mean", "worst", "at base", "seeds")
    return section("distance", "Options on ladders", [], [table(columns, lines, texts=4, tight=True, caption=caption)])


def _pairs(about: Mapping[str, Any]) -> Block:
    first = about["runs"][0]["label"]
    digits = {"length": 0, "success": 2, "discounted_return": 2, "distance, best member": 1}
    rows = about["comparisons"]
    blocks = comparison_tables(rows, "seed, and layout, sub-goal or ladder", "layouts, or seeds of ensembles,", digits)
    text = (
        f"{first} against each other run, over what both have with the same seed."
        if blocks
        else "No two runs share a seed (and layout, sub-goal or ladder) of the same agent or method: no pairs."
    )
    return section("pairs", "Who wins, seed by seed", [text], blocks)
