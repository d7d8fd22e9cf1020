"""The sections on what the agents achieved: headline table, curves, runs and layouts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import cycle
from typing import Any

import numpy as np

from hypogoal.evaluation.agents import LEARNED, ORACLE, ORACLE_RANDOM, PRETRAINING, RANDOM
from hypogoal.evaluation.figures import (
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    PURPLE,
    SHARES,
    SKY,
    VERMILLION,
    Bounds,
    Line,
    learning_curves,
    reward_bounds,
)
from hypogoal.evaluation.page.blocks import (
    Block,
    Material,
    figure,
    fixed,
    interval,
    listed,
    row,
    section,
    spread,
    table,
)
from hypogoal.evaluation.page.comparisons import comparison_tables
from hypogoal.evaluation.page.variants import control_of, same_settings, variants
from hypogoal.evaluation.summary import percent, solved, thousands

COLOURS = {
    LEARNED: (BLUE, False),
    RANDOM: (ORANGE, False),
    PRETRAINING: (ORANGE, True),
    ORACLE: (GREEN, False),
    ORACLE_RANDOM: (GREEN, True),
    "PPO tuned": (VERMILLION, False),
    "PPO paper": (VERMILLION, True),
    "DQN tuned": (PURPLE, False),
    "DQN paper": (PURPLE, True),
}
# Of agents with other names; the last ones only where no agent of the figure has them by its name.
OTHERS = ((SKY, False), (GREY, False), (SKY, True), (GREY, True), (BLUE, True), *COLOURS.values())


def summary_section(material: Material) -> Block:
    """What was asked, what came out."""
    metrics = material.metrics
    asked = (
        "Each sub-goal is known from one context only. An ensemble of classifiers holds several hypotheses about what "
        "the sub-goal is; every member becomes an option of its own, and a policy over all of them is rewarded by "
        "the task alone. Does that agent solve layouts that no data came from, and does it come to prefer the "
        "hypotheses that are true there?"
    )
    headline = [_headline(material)] if metrics["agents"] else []
    return section("summary", "Summary", [asked, *_answers(material)], headline, metrics["missing"])


def _answers(material: Material) -> list[str]:
    """What came out: a paragraph for each variant of the option agent, with its name where there are several."""
    agents = material.agents()
    found = variants(agents)
    several = len(found) > 1
    paragraphs = []
    for agent in found:
        name = f"the agent '{agent['name']}'" if several else "the option agent"
        text = _achieved(agent, name, material.metrics["settings"]["window"])
        control = control_of(material, agent, agents)
        if agent["success"]["mean"] is not None and control is not None:
            alike = not several or same_settings(agent, control)
            text += f" {_by_chance(control, 'options of the same members' if alike else 'options of its ensemble')}"
        elif several and control is None:
            text += " No random choice among options of the same members was run."
        paragraphs.append(text)
    return paragraphs


def _achieved(agent: Mapping[str, Any], name: str, window: int) -> str:
    success, ratio = agent["success"]["mean"], agent["length_over_shortest"]["mean"]
    if success is None:
        return f"No episode of {name} came to its end ({_runs(agent)}): it needs more steps."
    against = "" if ratio is None else f", {fixed(ratio, 1)} times the shortest path"
    return (
        f"{name[0].upper()}{name[1:]} reached the goal in {percent(success)} of its last {_episodes(agent, window)}, "
        f"which took {fixed(agent['length']['mean'], 0)} steps{against} ({_runs(agent)})."
    )


def _by_chance(control: Mapping[str, Any], among: str) -> str:
    if control["success"]["mean"] is None:
        return f"Of uniformly random choice among {among} no episode came to its end."
    return (
        f"Uniformly random choice among {among}: {percent(control['success']['mean'])}, "
        f"{fixed(control['length']['mean'], 0)} steps. Where success ties, length tells a policy from chance."
    )


def _episodes(agent: Mapping[str, Any], window: int) -> str:
    """How many of its last training episodes an agent is judged by: fewer where a run had fewer."""
    counts = [min(window, run["episodes"]) for run in agent["runs"] if run["episodes"]]
    fewest, most = min(counts), max(counts)
    count = str(most) if fewest == most else f"{fewest} to {most}"
    return f"{count} training episode{'s' if most > 1 else ''}"


def _runs(agent: Mapping[str, Any]) -> str:
    runs = agent["runs"]
    layouts = sorted({run["layout_seed"] for run in runs})
    seeds = sorted({run["seed"] for run in runs})
    count = f"{len(runs)} run{'s' if len(runs) > 1 else ''}"
    return (
        f"{count}: layout seed{'s' if len(layouts) > 1 else ''} {listed(layouts)}, "
        f"run seed{'s' if len(seeds) > 1 else ''} {listed(seeds)}"
    )


def _headline(material: Material) -> Block:
    rows = []
    for agent in material.agents():
        rows.append(
            row(
                agent["name"],
                str(len(agent["runs"])),
                spread(agent["success"], 1, 100),
                spread(agent["length"], 0),
                spread(agent["length_over_shortest"], 2),
                spread(agent["discounted_return"], 2),
                solved(agent["steps_to_95"]),
                mark="main" if agent["name"] == LEARNED else "",
            )
        )
    return table(
        ("agent", "runs", "success, %", "steps", "× shortest", "discounted return", "95 % at"),
        rows,
        caption="Over the last 100 training episodes of each run: mean over runs ± standard error. Steps: length of "
        "an episode, failures counted at the cap; × shortest: against the layout's shortest path. Discounted return: "
        "0.99 per step. 95 % at: median number of environment steps, in thousands, at which 95 of the last 100 "
        "episodes succeeded, or how many runs got there; steps of train-options count.",
    )


def curves_section(material: Material) -> Block:
    """Figure 6 with controls and baselines, and every run's numbers."""
    agents = material.agents()
    text = (
        "Success at a cap of 500 steps cannot show by itself that choices are learned, so episode length stands "
        "beside it. Oracle terminations use the true sub-goals: an upper bound. Baselines act with the primitive "
        "actions on the same observations and budget."
    )
    if not agents:
        nothing = "It needs options, meta or baseline artefacts: train-meta, train-baseline."
        return section("curves", "Learning curves", [], [figure(material, "reward", "Reward", None, missing=nothing)])
    blocks = [_curve(material, "reward"), _curve(material, "length")]
    blocks += [_intervals(agents)]
    blocks += comparison_tables(
        material.comparisons("agents"),
        "layout and seed",
        "layouts",
        {"length": 0, "success": 2, "discounted_return": 2},
    )
    blocks += [_every_run(agents), _layouts(material)]
    return section("curves", "Learning curves", [text], blocks)


def _curve(material: Material, quantity: str) -> Block:
    metrics, grid = material.metrics, material.arrays["curves/grid"]
    used = {COLOURS.get(agent["name"]) for agent in metrics["agents"]}
    others = cycle(look for look in OTHERS if look not in used)
    lines = []
    for index, agent in enumerate(metrics["agents"]):
        colour, dashed = COLOURS.get(agent["name"]) or next(others)
        lines.append(Line(agent["name"], material.arrays[f"curves/{index}/{quantity}"], colour, dashed))
    layouts = metrics["layouts"]
    bounds: Bounds
    if quantity == "reward":
        label, axis, bounds = "Undiscounted reward per episode", "reward per episode", reward_bounds(lines)
        # A share of episodes says nothing on an axis of other rewards.
        known = [layout["random_success"] for layout in layouts if bounds == SHARES]
        random = [share for share in known if share is not None]
        references = [("random play", float(np.mean(random)))] if random else []
    else:
        shortest = [layout["shortest_path"] for layout in layouts if layout["shortest_path"]]
        references = [("shortest path", float(np.mean(shortest)))] if shortest else []
        label, axis, bounds = "Episode length", "episode length (steps)", (0.0, None)
    drawn = learning_curves(grid, lines, axis, references, bounds)
    number = "Figure 6 of the paper" if quantity == "reward" else "Beside Figure 6 of the paper"
    first = metrics["agents"][0]
    dotted = "uniformly random play" if quantity == "reward" else "the shortest path"
    reference = f" Dotted: mean over layouts of {dotted}." if references else ""
    caption = (
        f"{number}: {label.lower()}, mean over the last 100 episodes known at each step. Lines: mean over runs; "
        f"bands: ± one standard error over runs. {first['name']}: {_runs(first)}; "
        f"the other agents: {_others(metrics['agents'])}.{reference}"
    )
    return figure(material, quantity, label, drawn, caption)


def _others(agents: Sequence[Mapping[str, Any]]) -> str:
    if len(agents) < 2:
        return "none"
    counts = sorted({len(agent["runs"]) for agent in agents[1:]})
    same = all(
        {(run["layout_seed"], run["seed"]) for run in agent["runs"]}
        == {(run["layout_seed"], run["seed"]) for run in agents[0]["runs"]}
        for agent in agents[1:]
    )
    return "the same layouts and seeds" if same else f"runs each: {listed(counts)}, see the table of runs"


def _intervals(agents: Sequence[Mapping[str, Any]]) -> Block:
    rows = [
        row(
            agent["name"],
            interval(agent["success"], 1, 100),
            interval(agent["length"], 0),
            interval(agent["discounted_return"], 2),
            f"{agent['success']['n']}",
        )
        for agent in agents
    ]
    over = sorted({agent["success"]["interval_over"] for agent in agents if agent["success"]["n"] > 1})
    resamples = (
        f"its 95 % bootstrap interval (2,000 resamples of {listed(over)})" if over else "no interval: one run each"
    )
    return table(
        ("agent", "success, %", "steps", "discounted return", "runs"),
        rows,
        heading="Interquartile means",
        caption=f"Interquartile mean over runs with {resamples}; over the last 100 episodes of each run.",
    )


def _every_run(agents: Sequence[Mapping[str, Any]]) -> Block:
    rows = []
    for agent in agents:
        for index, run in enumerate(agent["runs"]):
            rows.append(
                row(
                    agent["name"] if index == 0 else "",
                    str(run["layout_seed"]),
                    str(run["seed"]),
                    thousands(run["steps"]),
                    str(run["episodes"]),
                    percent(run["success"]),
                    fixed(run["length"], 1),
                    fixed(run["length_over_shortest"], 2),
                    fixed(run["discounted_return"], 2),
                    thousands(run["steps_to_95"]) if run["steps_to_95"] is not None else "never",
                    mark="first" if index == 0 else "",
                )
            )
    return table(
        ("agent", "layout", "seed", "budget", "episodes", "success", "steps", "× shortest", "return", "95 % at"),
        rows,
        folded="Every run",
    )


def _layouts(material: Material) -> Block:
    rows = [
        row(
            str(layout["layout_seed"]),
            fixed(layout["shortest_path"], 0),
            percent(layout["random_success"]),
            str(layout["random_episodes"]),
        )
        for layout in material.metrics["layouts"]
    ]
    return table(
        ("layout seed", "shortest path, steps", "random play succeeds", "episodes of random play"),
        rows,
        heading="How hard the layouts are",
        caption="Random play: uniformly random primitive actions, the same cap.",
    )
