"""Figure 6: what agents achieve on layouts that no data came from, over training and at its end (Spec E6, E7, F5)."""

import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import cycle
from operator import itemgetter
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from rich.table import Table as Printed

from hypogoal.core.artefacts import Artefact
from hypogoal.evaluation import page
from hypogoal.evaluation.judging import Work
from hypogoal.evaluation.numbers import (
    BOOTSTRAP_FROM,
    Metrics,
    by_layout,
    ensemble_name,
    ensemble_title,
    grouped,
    mean_of,
    name_apart,
)
from hypogoal.evaluation.page import Block, Drawn, Entry, Material, Question
from hypogoal.evaluation.plots import BLUE, GREEN, GREY, NARROW, ORANGE, PURPLE, SKY, STYLES, VERMILLION, drawing
from hypogoal.evaluation.run import read_layout
from hypogoal.evaluation.table import Number, Pairs, Row, Table, by_fields, rows_of, select, tabulate, wide
from hypogoal.learners.episodes import LAST
from hypogoal.options.tables import Episodes

FIRST = 20  # episodes that a curve begins with: of many parallel ones, the first to end are the lucky ones
SEVERAL = 3  # runs of an agent from which on intervals and pairs say more than the runs
SOLVED = 0.95  # share of the window's episodes
NEAR = 1.5  # times the shortest path
WITHIN = {"near": NEAR, "within_2": 2.0}  # times the shortest path
LEARNED = "options (learned members)"
RANDOM = "random choice"
ORACLE = "oracle terminations"
ORACLE_RANDOM = "oracle terminations, random choice"
PRETRAINING = "random choice while options learn"
BASELINES = ("PPO tuned", "PPO paper", "DQN tuned", "DQN paper")
ORDER = (LEARNED, RANDOM, PRETRAINING, ORACLE, ORACLE_RANDOM, *BASELINES)
UNITS = {
    "success": "share of episodes",
    "reward": "undiscounted, per episode",
    "length": "steps",
    "length_over_shortest": "ratio to the layout's shortest path",
    "near": "share of episodes",
    "solved_length": "steps",
    "solved_over_shortest": "ratio to the layout's shortest path",
    "ended": "share of episodes",
    "cut": "share of episodes",
}
LAYOUTS_OR_RUNS = "layouts (or runs of one layout)"  # what numbers and curves are over, see ``numbers.by_layout``
BANDS = (
    "runs of one of several layouts count once, by their mean. Thin lines: each of fewer than 8; else bands: ± one "
    "standard error"
)
AXES = {  # of curves: title, and the y axis's label
    "reward": ("Undiscounted reward per episode", "reward per episode"),
    "solved_length": ("Length of solved episodes", "steps of solved episodes"),
}
SHARES = (-0.02, 1.04)  # limits for what lies within 0 and 1, so that a line on either is seen
SOLID, DASHED, MIXED, LONG, SHORT = STYLES
COLOURS = {  # lines differ in how they are drawn, too, for readers who do not see their colours
    LEARNED: (BLUE, SOLID),
    RANDOM: (ORANGE, DASHED),
    PRETRAINING: (ORANGE, SHORT),
    ORACLE: (GREEN, MIXED),
    ORACLE_RANDOM: (GREEN, SHORT),
    "PPO tuned": (VERMILLION, LONG),
    "PPO paper": (VERMILLION, SHORT),
    "DQN tuned": (PURPLE, MIXED),
    "DQN paper": (PURPLE, DASHED),
}
# Of agents with other names; the last ones only where no agent of the figure has them by its name.
OTHERS = ((SKY, SOLID), (GREY, DASHED), (SKY, LONG), (GREY, SOLID), (BLUE, DASHED), *COLOURS.values())


@dataclass(frozen=True)
class Run:
    """One trained agent."""

    kind: str  # options, meta or baseline
    path: str  # of its artefact, relative to the run's folder
    seed: int  # of the training
    config: Mapping[str, Any]  # its resolved settings, with those of its ensemble that matter
    episodes: Episodes  # of its training
    layout: Mapping[str, Any]  # layout_seed, shortest_path, random_success, random_episodes

    @property
    def budget(self) -> int:
        """Environment steps, those of earlier stages included."""
        steps = self.config["ended_at" if "ended_at" in self.config else "steps"]
        return int(steps) + self.practice

    @property
    def practice(self) -> int:
        """The steps of the options that the agent continues, which may have ended before their limit."""
        return int(self.config.get("options_ended_at", self.config.get("options_steps", 0)))


def read_run(artefact: Artefact, path: str) -> Run:
    """The episodes and the layout of one trained agent, whose path in the run is ``path``."""
    config = artefact.config
    if artefact.kind != "baseline":
        config["ensemble"] = ensemble_name(Artefact(artefact.input("ensemble")).config)
    episodes, layout = Episodes.read(artefact.path / "episodes.csv"), read_layout(artefact.path / "layout.json")
    return Run(artefact.kind, path, artefact.seed, config, episodes, layout)


def trailing_mean(
    steps: NDArray[np.int64], values: NDArray[Any], grid: NDArray[np.int64], window: int = LAST, least: int = 1
) -> NDArray[np.float64]:
    """Spec F5: at each point of ``grid`` (G,) the mean of the last ``window`` values known by then, float64 (G,).

    ``steps`` (n,), ascending, say when each of the values (n,) came. Fewer than ``window`` are averaged at the
    beginning; the mean is NaN where fewer than ``least`` are known.
    """
    sums = np.concatenate([[0.0], np.cumsum(values, dtype=np.float64)])
    end = np.searchsorted(steps, grid, side="right")
    start = np.maximum(0, end - window)
    counts = end - start
    return np.where(counts >= max(1, least), (sums[end] - sums[start]) / np.maximum(counts, 1), np.nan)


def curves(episodes: Episodes, grid: NDArray[np.int64], window: int = LAST) -> dict[str, NDArray[np.float64]]:
    """Figure 6: reward, success and length over environment steps, each float64 (G,), see :func:`trailing_mean`.

    ``solved_length``: of the solved ones among them; NaN where none is.
    """
    values = {"reward": episodes.reward, "success": episodes.succeeded, "length": episodes.length}
    values["solved"] = episodes.length * episodes.succeeded
    means = {name: trailing_mean(episodes.step, numbers, grid, window, FIRST) for name, numbers in values.items()}
    success = np.where(means["success"] > 0, means["success"], np.nan)
    return means | {"solved_length": means.pop("solved") / success}


def steps_to_solve(episodes: Episodes, window: int = LAST) -> int | None:
    """Spec F5: the first step at which 95 % of the last ``window`` episodes succeeded; None: never, or too few."""
    if len(episodes.step) < window:
        return None
    sums = np.concatenate([[0], np.cumsum(episodes.succeeded.astype(np.int64))])
    recent = sums[window:] - sums[:-window]
    reached = np.flatnonzero(recent >= SOLVED * window)
    return int(episodes.step[reached[0] + window - 1]) if len(reached) else None


def scores(
    succeeded: NDArray[np.bool_], steps: NDArray[np.int64], shortest: float | NDArray[np.float64] | None
) -> dict[str, NDArray[np.float64]]:
    """``success``, and success within so many times the shortest path, ``WITHIN``: 1 or 0 of each episode (E, ...).

    ``shortest``, steps, is broadcast to the episodes; NaN or None where no path is known, and so are those scores.
    """
    path = np.asarray(np.nan if shortest is None else shortest, dtype=np.float64)
    defined = np.where(np.isnan(path), np.nan, 1.0)
    within = {name: defined * (succeeded & (steps <= factor * path)) for name, factor in WITHIN.items()}
    return {"success": succeeded * 1.0, **within}


def run_numbers(episodes: Episodes, shortest_path: int | None, window: int = LAST) -> dict[str, float | int | None]:
    """Spec F5: the numbers of one run, over its last ``window`` training episodes at most; NaN without episodes.

    ``shortest_path``: primitive steps from the start to the goal at least; None or 0 where unknown. ``window`` in the
    numbers: episodes actually averaged.
    """
    last, shortest = episodes.last(window), shortest_path or math.nan
    length, solved_length = mean_of(last.length), mean_of(last.length[last.succeeded])
    return {
        "episodes": len(episodes.step),
        "window": len(last.step),
        "success": mean_of(last.succeeded),
        "reward": mean_of(last.reward),
        "length": length,
        "length_over_shortest": length / shortest,
        "near": mean_of(scores(last.succeeded, last.length, shortest)["near"]),
        "solved_length": solved_length,
        "solved_over_shortest": solved_length / shortest,
        "ended": mean_of(last.terminated & ~last.succeeded),
        "cut": mean_of(~last.terminated & ~last.succeeded),
        "steps_to_95": steps_to_solve(episodes, window),
    }


def base_name(kind: str, config: Mapping[str, Any]) -> str:
    """Spec E6, E7: an agent's name: how it chooses and what ends its options."""
    if kind == "baseline":
        return f"{config['agent'].upper()} {config['setting']}"
    if kind == "options":
        return PRETRAINING
    chooser, oracle = config["chooser"], config["termination"] == "oracle"
    if chooser == "random":
        return ORACLE_RANDOM if oracle else RANDOM
    return (ORACLE if oracle else LEARNED) + ("" if chooser == "ppo" else f", chooser={chooser}")


def group_runs(runs: Sequence[Run]) -> dict[str, list[Run]]:
    """Runs by the name of their agent, in the order of ``ORDER``; settings that differ, the layout aside, are named."""
    bases = [base_name(run.kind, run.config) for run in runs]
    ranks = [ORDER.index(base) if base in ORDER else len(ORDER) for base in bases]
    names = name_apart(bases, [run.config for run in runs])
    ordered = sorted(zip(ranks, names, runs, strict=True), key=itemgetter(0, 1))
    return {name: [run for *_, run in alike] for name, alike in grouped(ordered, itemgetter(1)).items()}


OVER_RUNS = Table({"name": "method"}, {name: Number(name, "", unit) for name, unit in UNITS.items()})
PAIRS = Pairs("agents", {name: Number(name, higher=name != "length") for name in ("success", "length", "near")})


def rows_of_run(run: Run, name: str) -> Iterator[Row]:
    """Spec F5: what is said of one trained agent at the end of its training."""
    shortest = run.layout.get("shortest_path")
    numbers = {"steps": run.budget, "practice": run.practice, **run_numbers(run.episodes, shortest)}
    return rows_of(numbers | {"shortest_path": shortest}, **_place(run, name))


def _place(run: Run, name: str) -> dict[str, Any]:
    return {"method": name, "layout": run.layout["layout_seed"], "seed": run.seed, "artefact": run.path}


def agents_table(rows: Sequence[Row], groups: Mapping[str, Sequence[Run]]) -> list[dict[str, Any]]:
    """Spec F5: of every agent each run's numbers and, for each of ``UNITS``, its statistics over runs.

    ``steps_to_95``: how many of the runs reached it, and the median over all runs, None where half did not.
    """
    rows = select(rows, method=tuple(groups), scope="", step="", member="")
    by_agent = by_fields(rows, "method")
    table = tabulate(rows, OVER_RUNS)
    for entry in table:
        runs = wide(by_agent[entry["name"],], path="artefact", seed="seed", layout_seed="layout")
        for run, source in zip(runs, groups[entry["name"]], strict=True):
            run |= {"layouts": source.layout["layouts"]} if "layouts" in source.layout else {}
        reached = [math.inf if math.isnan(run["steps_to_95"]) else float(run["steps_to_95"]) for run in runs]
        median = float(np.quantile(reached, 0.5, method="higher"))
        count, unit = int(np.isfinite(reached).sum()), "environment steps"
        solved_at = {"reached": count, "median": median if np.isfinite(median) else None, "n": len(runs), "unit": unit}
        entry |= {"kind": groups[entry["name"]][0].kind, "runs": runs, "steps_to_95": solved_at}
    return table


def agent_curves(runs: Sequence[Run], grid: NDArray[np.int64]) -> dict[str, NDArray[np.float64]]:
    """Figure 6: reward, success and length of every run on the common grid, each (R, G); NaN beyond a run's budget."""
    drawn = [curves(run.episodes, grid) for run in runs]
    beyond = grid > np.array([run.budget for run in runs])[:, None]
    return {name: np.where(beyond, np.nan, np.stack([of_run[name] for of_run in drawn])) for name in drawn[0]}


def common_grid(runs: Sequence[Run], points: int = 151) -> NDArray[np.int64]:
    """Environment steps from 0 to the largest budget, int64 (G,)."""
    return np.linspace(0, max(run.budget for run in runs), points).round().astype(np.int64)


def rows(work: Work) -> Iterator[Row]:
    """Every run at its end, and its curves; random play on each layout.

    Figure 6's curves go to the arrays, too: ``curves/grid`` and ``curves/<agent's index>/{reward,success,length}``,
    float (runs, grid).
    """
    every = [run for runs in work.agents.values() for run in runs]
    if every:
        work.arrays["curves/grid"] = grid = common_grid(every)
    for index, (name, runs) in enumerate(work.agents.items()):
        drawn = agent_curves(runs, grid)
        for quantity, values in drawn.items():
            work.arrays[f"curves/{index}/{quantity}"] = values
        for number, run in enumerate(runs):
            yield from rows_of_run(run, name)
            for quantity, values in drawn.items():
                for step, value in zip(grid.tolist(), values[number].tolist(), strict=True):
                    yield Row(quantity, value, **_place(run, name), step=step)
    for layout in layouts_of(every):
        where = "" if "layouts" in layout else layout["layout_seed"]
        yield from rows_of({"random_success": layout["random_success"]}, layout=where)


def layouts_of(runs: Sequence[Run]) -> list[dict[str, Any]]:
    """The layouts that runs are of, and how hard they are, each once."""
    layouts = {(run.layout["layout_seed"], run.layout.get("layouts", "")): dict(run.layout) for run in runs}
    return [layouts[seed] for seed in sorted(layouts)]


def view(work: Work) -> dict[str, Any]:
    """Every agent, and how hard its layouts are."""
    every = [run for runs in work.agents.values() for run in runs]
    return {"agents": agents_table(work.rows, work.agents), "layouts": layouts_of(every)}


def missing(work: Work) -> list[str]:
    """That there are no agents, of a run that is about them; controls that nobody asked for are not missed."""
    return [] if work.metrics["agents"] or work.metrics["rooms"] or work.contents.ladders else ["no agents"]


def solved(steps: Mapping[str, Any]) -> str:
    """When 95 % were reached: the median over runs, or how many of them did."""
    if steps["reached"] == steps["n"]:
        return page.thousands(steps["median"])
    if steps["reached"] == 0:
        return "never"
    return f"{steps['reached']} of {steps['n']}"


AGENT = page.label("agent", lambda agent: titled(agent["name"]))
RUNS = page.number("runs", lambda agent: len(agent["runs"]))
NEARLY = (f"within {NEAR} shortest paths", "near")
SOLVED_AT = page.number("95 % at", "steps_to_95", solved)
HEADLINE = (
    RUNS,
    page.number("success, %", "success", page.spread, 1, 100),
    page.number("steps", "solved_length", page.spread, 0),
    page.number("× shortest", "solved_over_shortest", page.spread, 2),
    page.number(*NEARLY, page.spread, 2),
    page.number("failed: ended", "ended.mean", page.fixed, 2),
    page.number("cut", "cut.mean", page.fixed, 2),
    SOLVED_AT,
)
HEADLINE_CAPTION = (
    "Over the last 100 training episodes of each run, or all of fewer: mean ± standard error over layouts, or over "
    "runs of one layout. Steps: mean length of solved episodes; × shortest: against the layout's shortest path. "
    "Failed: the share of episodes that ended without success, and that were cut. "
    f"Within {NEAR} shortest paths, in short near: the share of episodes that succeeded so soon. 95 % at: median "
    "number of environment steps, in thousands, at which 95 of the last 100 episodes succeeded, or how many runs got "
    "there"
)
PLAIN = (
    AGENT,
    RUNS,
    page.number("success", "success.mean", page.percent),
    page.number("steps", "solved_length.mean", page.fixed, 0),
    page.number("x shortest", "solved_over_shortest.mean", page.fixed, 1),
    SOLVED_AT,
)
INTERVALS = (
    AGENT,
    page.number("success, %", "success", page.interval, 1, 100),
    page.number("steps", "solved_length", page.interval, 0),
    page.number(*NEARLY, page.interval, 2),
    page.number("runs", "success.n"),
)


def summary(metrics: Metrics) -> list[Printed]:
    """Every agent's headline numbers, mean over runs; also where there is nothing at all."""
    if not metrics["agents"] and (metrics["rooms"] or metrics["hypotheses"] or metrics["distance"]["options"]):
        return []
    return [page.terminal("Training episodes, the last 100 of each run", PLAIN, metrics["agents"])]


def sections(material: Material) -> list[Block]:
    """The summary with film and curves, of a run with agents; intervals of three runs or more, one run's are none."""
    if not material.of_agents():
        return []
    several = max((len(agent["runs"]) for agent in material.metrics["agents"]), default=0) >= SEVERAL
    return [summary_section(material), *([runs_section(material)] if several else [])]


def summary_section(material: Material) -> Block:
    """Curves, and the headline numbers."""
    metrics = material.metrics
    caption = f"{HEADLINE_CAPTION}; steps of train-options count."
    headline = page.table(
        (AGENT, *HEADLINE), metrics["agents"], main=lambda agent: bool(agent["name"] == LEARNED), caption=caption
    )
    drawn = [page.shown(material, figure) for figure in figures(material)]
    blocks = [{"kind": "row", "blocks": drawn}, headline] if drawn else []
    return page.section("summary", "Summary", [], blocks, metrics["missing"])


def runs_of(agent: Entry) -> str:
    """How many runs an agent has, and of which layouts and seeds."""
    runs = agent["runs"]
    seeds = {run["seed"] for run in runs}
    layouts = {run["layout_seed"] for run in runs if not run.get("layouts")}
    texts = [page.spans(layouts)] if layouts else []
    texts += sorted({run["layouts"] for run in runs if run.get("layouts")})
    return (
        f"{len(runs)} run{'s' if len(runs) > 1 else ''}: layout seed{'s' if len(layouts) != 1 else ''} "
        f"{page.listed(texts)}, run seed{'s' if len(seeds) > 1 else ''} {page.spans(seeds)}"
    )


def runs_section(material: Material) -> Block:
    """Intervals and pairs; each run's numbers, and each layout's, are in ``numbers.csv``."""
    agents = material.metrics["agents"]
    caption = f"Over the last 100 episodes of each run. {page.INTERVALS.format(units=LAYOUTS_OR_RUNS)}"
    pairs = page.comparison_tables(material.comparisons("agents"), "layout and seed", LAYOUTS_OR_RUNS)
    intervals = page.table(INTERVALS, agents, caption=caption)
    return page.section("runs", "Intervals and pairs", [], [intervals, *pairs], folded=True)


def figures(material: Material) -> list[Drawn]:
    """Figure 6 and the same of the length of solved episodes, where it is not the same everywhere."""
    drawn = [_curve(material, quantity) for quantity in AXES] if material.metrics["agents"] else []
    return [figure for figure in drawn if figure is not None]


def _curve(material: Material, quantity: str) -> Drawn | None:
    agents, layouts, arrays = material.metrics["agents"], material.metrics["layouts"], material.arrays
    used = {COLOURS.get(agent["name"]) for agent in agents}
    others = cycle(look for look in OTHERS if look not in used)
    lines = []
    for index, agent in enumerate(agents):
        look, of_runs = COLOURS.get(agent["name"]) or next(others), arrays[f"curves/{index}/{quantity}"]
        lines.append(Line(titled(agent["name"]), arrays["curves/grid"], values_of(agent, of_runs), *look))
    if is_flat(quantity, lines):
        return None
    lines = [line for line in lines if quantity == "reward" or np.isfinite(line.values).any()]
    of_paper = material.metrics.get("verdict", {}).get("paper", False)
    if quantity == "reward":
        # A share of episodes says nothing on an axis of other rewards.
        values = [layout["random_success"] for layout in layouts if limits_of(quantity, lines) == SHARES]
        which_figure, name, dotted = "Figure 6 of the paper: ", "random play", "uniformly random play"
    else:
        values = [layout["shortest_path"] or None for layout in layouts]
        which_figure, name, dotted = "Beside Figure 6 of the paper: ", "shortest path", "the shortest path"
    values = [value for value in values if value is not None]
    title, _ = AXES[quantity]
    drawn = learning_curves(lines, quantity, {name: float(np.mean(values))} if values else {})
    reference = f" Dotted: mean over layouts of {dotted}." if values else ""
    practice = ""
    if practised := [run["practice"] for agent in agents for run in agent["runs"] if run.get("practice")]:
        steps = page.thousands(float(np.mean(practised)))
        practice = f" Agents begin after the practice of their options, on average {steps} steps."
    several = f" Lines: mean over runs; {BANDS} over runs." if any(len(agent["runs"]) > 1 for agent in agents) else ""
    caption = (
        f"{f'{which_figure}{title.lower()}' if of_paper else title}, mean of the last 100 episodes at each step."
        f"{practice}{several}{reference}"
    )
    more = "; other agents' runs: numbers.csv" if len(agents) > 1 else ""
    name, file = ("reward", "figure6") if quantity == "reward" else ("length", "figure6-length")
    return Drawn(name, title, drawn, caption, f"{titled(agents[0]['name'])}: {runs_of(agents[0])}{more}.", file=file)


@dataclass(frozen=True)
class Line:
    """One agent's curve: values float (R, G) at ``steps`` (G,), a row per layout or run, NaN where it has no value."""

    name: str
    steps: NDArray[np.int64]
    values: NDArray[np.float64]
    colour: str
    style: Any = SOLID


def titled(name: str) -> str:
    """An agent's name for people: 'options (learned members), ensemble=dbat, K=3' is 'D-BAT, 3 members'."""
    of_ensemble = re.search(r"ensemble=(single CNN|[^,]+, K=\d+)", name)
    if of_ensemble:
        name = name.replace(of_ensemble[0], ensemble_title(of_ensemble[0].removeprefix("ensemble=")))
        return name.removeprefix(f"{LEARNED}, ")
    return name.replace(LEARNED, "option agent")


def is_flat(quantity: str, lines: Sequence[Line]) -> bool:
    """Whether a figure of lengths would show nothing: no episode was solved, or all took as long."""
    every = np.concatenate([line.values[np.isfinite(line.values)] for line in lines])
    return quantity != "reward" and (not len(every) or bool(np.ptp(every) == 0))


def limits_of(quantity: str, lines: Sequence[Line]) -> tuple[float | None, float | None]:
    """The y axis: 0 to 1 where rewards are shares of episodes, else what fits them; lengths from 0."""
    if quantity != "reward":
        return 0.0, None
    values = np.concatenate([line.values.ravel() for line in lines])
    return (None, None) if ((values < 0) | (values > 1)).any() else SHARES


def learning_curves(lines: Sequence[Line], quantity: str, references: Mapping[str, float] | None = None) -> Figure:
    """Figure 6: a quantity of episodes against environment steps, a line per agent, ``references`` dotted across.

    The mean, and of few layouts or runs each, of more a band of one standard error.
    """
    with drawing(2.9, 2, NARROW, beside=True, handlelength=2.4) as (figure, axes):
        for line in lines:
            steps, defined = line.steps / 1000, np.ma.masked_invalid(line.values)
            mean = defined.mean(0).filled(np.nan)
            look: dict[str, Any] = {"color": line.colour, "linestyle": line.style}
            axes.plot(steps, mean, linewidth=1.6, label=line.name, **look)
            if len(defined) >= BOOTSTRAP_FROM:
                error = defined.std(0, ddof=1) / np.sqrt(defined.count(0))
                axes.fill_between(steps, mean - error, mean + error, color=line.colour, alpha=0.18, linewidth=0)
            elif len(defined) > 1:
                axes.plot(steps, line.values.T, linewidth=0.6, alpha=0.5, **look)
        for name, value in (references or {}).items():
            axes.axhline(value, color=GREY, linewidth=1.2, linestyle=":", label=name)
        axes.set_xlabel("environment steps, in thousands")
        axes.set_ylabel(AXES[quantity][1])
        axes.set_xlim(0, max(line.steps[-1] for line in lines) / 1000)
        axes.set_ylim(*limits_of(quantity, lines))
    return figure


def values_of(agent: Entry, values: NDArray[np.float64]) -> NDArray[np.float64]:
    """An agent's curves as they are averaged: of its runs (R, G) each layout's mean where there are several layouts."""
    return by_layout(values, [run["layout_seed"] for run in agent["runs"]])[0]


def variants(entries: Iterable[Entry]) -> list[Entry]:
    """The entries called ``LEARNED``, also those to which settings that differ between runs were added."""
    return [entry for entry in entries if f"{entry['name']}, ".startswith(f"{LEARNED}, ")]


def which(agent: Entry, entries: Sequence[Entry]) -> str:
    """A sentence that says which variant is shown; nothing where there is only one."""
    count = len(variants(entries))
    return f"Shown is {agent['name']}, one of {count} variants of the option agent." if count > 1 else ""


QUESTION = Question(
    rows=rows,
    view=view,
    missing=missing,
    pairs=PAIRS,
    summary=summary,
    sections=sections,
    figures=figures,
    needed={"figure6": "options, meta or baseline artefacts: train-meta, train-baseline"},
)
