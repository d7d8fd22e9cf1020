"""Figure 6: what agents achieve on layouts that no data came from, over training and at its end (Spec E6, E7, F5)."""

import math
from collections.abc import Iterator, Mapping
from itertools import cycle
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from numpy.typing import NDArray

from hypogoal.core.artefacts import Artefact
from hypogoal.evaluation.house import BOOTSTRAP_FROM, mean_of, over, pairs, per_run, tidy
from hypogoal.evaluation.judging import Work
from hypogoal.evaluation.names import rank
from hypogoal.evaluation.page import (
    Drawn,
    Results,
    bounded,
    displayed,
    fixed,
    listed,
    mean,
    pairs_displayed,
    spans,
    spread,
)
from hypogoal.evaluation.plots import GREY, PALETTE, STYLES, legend_below, plot, styled
from hypogoal.evaluation.run import read_layout
from hypogoal.learners.episodes import LAST
from hypogoal.options.tables import Episodes

TITLE = "Summary"
FIRST = 20  # episodes that a curve begins with: of many parallel ones, the first to end are the lucky ones
SEVERAL = 3  # runs of an agent from which on intervals and pairs say more than the runs
SOLVED = 0.95  # share of the window's episodes
NEAR = 1.5  # times the shortest path
WITHIN = {"near": NEAR, "within_2": 2.0}  # times the shortest path
POINTS = 151  # of a curve
OVER = (
    *("success", "reward", "length", "length_over_shortest", "near", "solved_length", "solved_over_shortest"),
    *("ended", "cut"),
)
COLUMNS = {  # of tables: title, quantity, how it is written
    "success, %": ("success", spread(1, 100)),
    "steps": ("solved_length", spread(0)),
    "× shortest": ("solved_over_shortest", spread(2)),
    f"within {NEAR} shortest paths": ("near", spread(2)),
    "failed: ended": ("ended", mean(2)),
    "cut": ("cut", mean(2)),
}
DECIMALS = {"length": 0, "success": 2, "near": 2}
SHARES = (-0.02, 1.04)  # limits for what lies within 0 and 1, so that a line on either is seen
FIGURES = {"reward": "Undiscounted reward per episode", "solved_length": "Length of solved episodes"}
NEEDED = {"figure6": "options, meta or baseline artefacts"}


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
    means = (sums[end] - sums[start]) / np.maximum(counts, 1)
    return np.where(counts >= max(1, least), means, np.nan)


def curves(episodes: Episodes, grid: NDArray[np.int64], window: int = LAST) -> dict[str, NDArray[np.float64]]:
    """Figure 6: reward, success and length over environment steps, each float64 (G,), see :func:`trailing_mean`.

    ``solved_length``: of the solved ones among them; NaN where none is.
    """
    values = {"reward": episodes.reward, "success": episodes.succeeded, "length": episodes.length}
    values["solved"] = episodes.length * episodes.succeeded
    means = {name: trailing_mean(episodes.step, numbers, grid, window, FIRST) for name, numbers in values.items()}
    success = np.where(means["success"] > 0, means["success"], np.nan)
    means["solved_length"] = means.pop("solved") / success
    return means


def steps_to_solve(episodes: Episodes, window: int = LAST) -> int | None:
    """Spec F5: the first step at which 95 % of the last ``window`` episodes succeeded; None: never, or too few."""
    if len(episodes.step) < window:
        return None
    sums = np.concatenate([[0], np.cumsum(episodes.succeeded.astype(np.int64))])
    recent = sums[window:] - sums[:-window]
    reached = np.flatnonzero(recent >= SOLVED * window)
    return int(episodes.step[reached[0] + window - 1]) if len(reached) else None


def run_numbers(episodes: Episodes, shortest_path: int | None, window: int = LAST) -> dict[str, float | int | None]:
    """Spec F5: the numbers of one run, over its last ``window`` training episodes at most; NaN without episodes.

    ``shortest_path``: primitive steps from the start to the goal at least; None or 0 where unknown. ``window`` in the
    numbers: episodes actually averaged.
    """
    last = episodes.last(window)
    shortest = shortest_path or math.nan
    length = mean_of(last.length)
    solved_length = mean_of(last.length[last.succeeded])
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


def practice_of(config: Mapping[str, Any]) -> int:
    """The steps of the options that an agent continues, which may have ended before their limit."""
    return int(config.get("options_ended_at", config.get("options_steps", 0)))


def budget_of(config: Mapping[str, Any]) -> int:
    """An agent's environment steps, those of earlier stages included."""
    return int(config.get("ended_at", config.get("steps", 0))) + practice_of(config)


def rows(work: Work) -> Iterator[pd.DataFrame]:
    """Every agent's run at its end, and its curves; random play on each layout."""
    agents = work.contents.agents
    most = max((budget_of(artefact.config) for artefact in agents), default=0)
    grid = np.linspace(0, most, POINTS).round().astype(np.int64)
    layouts: dict[int | str, float | None] = {}
    for artefact in sorted(agents, key=lambda artefact: rank(work.place(artefact)["method"])):
        layout = read_layout(artefact.path / "layout.json")
        layouts["" if "layouts" in layout else layout["layout_seed"]] = layout["random_success"]
        yield from _rows_of_agent(artefact, layout, grid, work.place(artefact))
    for seed, success in layouts.items():
        yield tidy({"random_success": success}, layout=None if seed == "" else seed)


def _rows_of_agent(
    artefact: Artefact, layout: Mapping[str, Any], grid: NDArray[np.int64], place: Mapping[str, Any]
) -> Iterator[pd.DataFrame]:
    config = artefact.config
    episodes = Episodes.read(artefact.path / "episodes.csv")
    shortest = layout["shortest_path"]
    numbers = {"steps": budget_of(config), "practice": practice_of(config), "shortest_path": shortest}
    yield tidy(numbers | run_numbers(episodes, shortest), **place)
    drawn = pd.DataFrame(curves(episodes, grid)).assign(step=grid)
    drawn = drawn[drawn["step"] <= budget_of(config)]
    yield drawn.melt("step", var_name="quantity").assign(**place)


def facts(work: Work) -> dict[str, Any]:
    """Of each agent, by its name, how it was made: its kind, members, chooser; of many layouts which."""
    agents: dict[str, Any] = {}
    for artefact in work.contents.agents:
        config = artefact.config
        keys = ("members", "chooser", "termination", "layouts")
        agents[work.place(artefact)["method"]] = {"kind": artefact.kind, **{key: config.get(key) for key in keys}}
    return {"agents": agents}


def tables(results: Results) -> dict[str, pd.DataFrame]:
    """Every agent's numbers over runs; the first against the others; when 95 % of episodes were solved."""
    agents = results.numbers[results.numbers["method"].isin([*results.facts["agents"]])]
    runs = pd.concat([per_run(agents, quantity) for quantity in OVER])
    computed = {"agents": over(runs, ["method"]), "agents-pairs": pairs(compared(results))}
    return computed | {"agents-solved": _solved(agents)}


def compared(results: Results) -> pd.DataFrame:
    """The numbers of runs by which agents are compared."""
    agents = results.numbers[results.numbers["method"].isin([*results.facts["agents"]])]
    return pd.concat([per_run(agents, quantity) for quantity in ("success", "length", "near")])


def _solved(agents: pd.DataFrame) -> pd.DataFrame:
    """Of each agent how many ``runs`` there are, how many ``reached`` 95 %, and the ``median`` step over all runs."""
    final = agents[agents["step"].isna()]
    rows = []
    for method, of_agent in final.groupby("method", sort=False):
        steps = of_agent[of_agent["quantity"] == "steps_to_95"]["value"]
        count = int((of_agent["quantity"] == "steps").sum())
        every = np.concatenate([steps, np.full(count - len(steps), np.inf)])
        median = np.quantile(every, 0.5, method="higher")
        rows.append({"method": method, "runs": count, "reached": len(steps), "median": median})
    return pd.DataFrame(rows)


def context(results: Results) -> dict[str, Any] | None:
    """For the template: the table of agents and, of several runs, intervals and pairs."""
    if not results.facts["agents"]:
        return None
    computed = tables(results)
    solved = computed["agents-solved"].set_index("method")
    by = {"method": "agent"}
    agents = computed["agents-solved"][["method"]]
    table = displayed(computed["agents"], by, COLUMNS, agents)
    counts = [str(solved["runs"][name]) for name in table.index]
    solved_at = [_solved_at(*solved.loc[name]) for name in table.index]
    table.insert(0, "runs", counts)
    table["95 % at"] = solved_at
    short = {"success, %": ("success", mean(0, 100)), "steps": ("solved_length", mean(0))}
    printed = displayed(computed["agents"], by, short, agents)
    several = solved["runs"].max() >= SEVERAL
    columns = {
        "success, %": ("success", bounded(1, 100)),
        "steps": ("solved_length", bounded(0)),
        f"within {NEAR} shortest paths": ("near", bounded(2)),
    }
    practised = results.of(quantity="practice")["value"]
    return {
        "table": table,
        "printed": printed.assign(**{"95 % at": solved_at, "runs": counts}),
        "intervals": displayed(computed["agents"], by, columns) if several else None,
        "pairs": pairs_displayed(computed["agents-pairs"], DECIMALS) if several else None,
        "practice": mean_of(practised[practised > 0]),
        "several": solved["runs"].max() > 1,
        "seeds": spans(results.of(quantity="steps")["seed"]),
        "layouts": _layouts(results),
        "missing": results.facts["missing"],
    }


def _solved_at(runs: float, reached: float, median: float) -> str:
    """When 95 % were reached: the median over runs, or how many of them did."""
    if reached == 0:
        return "never"
    if reached < runs:
        return f"{reached:.0f} of {runs:.0f}"
    return f"{fixed(median, 0, 1e-3)} k"


def _layouts(results: Results) -> str:
    seeds = results.of(quantity="steps")["layout"].dropna()
    many = sorted({agent["layouts"] for agent in results.facts["agents"].values() if agent["layouts"]})
    return listed(many) if many else spans(seeds)


def figures(results: Results) -> Iterator[Drawn]:
    """Figure 6 and the same of the length of solved episodes, where it is not the same everywhere."""
    for quantity, label in FIGURES.items():
        drawn = results.of(quantity=quantity)
        drawn = drawn[drawn["step"].notna() & drawn["method"].isin([*results.facts["agents"]])]
        flat = drawn["value"].nunique() < 2
        if drawn.empty or (flat and quantity != "reward"):
            continue
        is_share = bool(drawn["value"].between(0, 1).all())
        if quantity == "reward":
            # A share of episodes says nothing on an axis of other rewards.
            dotted, reference = ("random play", "random_success") if is_share else ("", "")
            limits: tuple[float | None, float | None] = SHARES if is_share else (None, None)
        else:
            dotted, reference, limits = "shortest path", "shortest_path", (0.0, None)
        values = results.of(quantity=reference).drop_duplicates(["layout"])["value"]
        references = {dotted: values.mean()} if len(values) else {}
        figure = learning_curves(drawn, label, references, limits)
        name = "figure6" if quantity == "reward" else "figure6-length"
        yield Drawn(name, label, figure, {"quantity": quantity, "dotted": list(references)})


def learning_curves(
    drawn: pd.DataFrame, label: str, references: Mapping[str, float], limits: tuple[float | None, float | None]
) -> Figure:
    """Figure 6: a quantity of episodes against environment steps, a line per method, ``references`` dotted across.

    ``drawn`` are rows of the table of numbers. The mean over layouts, or runs of one layout; of few each as a thin
    line, of more a band of one standard error.
    """
    unit = "layout" if drawn["layout"].nunique() > 1 else "artefact"
    with styled():
        figure, axes = plot(2.9)
        for (method, rows), colour, style in zip(drawn.groupby("method", sort=False), cycle(PALETTE), cycle(STYLES)):
            values = rows.pivot_table(index="step", columns=unit, values="value", dropna=False)
            steps = values.index.to_numpy(np.float64) / 1000
            middle, error = values.mean(axis=1), values.sem(axis=1)
            axes.plot(steps, middle, color=colour, linestyle=style, linewidth=1.6, label=method)
            if values.shape[1] >= BOOTSTRAP_FROM:
                axes.fill_between(steps, middle - error, middle + error, color=colour, alpha=0.18, linewidth=0)
            elif values.shape[1] > 1:
                axes.plot(steps, values, color=colour, linestyle=style, linewidth=0.6, alpha=0.5)
        for name, value in references.items():
            axes.axhline(value, color=GREY, linewidth=1.2, linestyle=":", label=name)
        axes.set_xlabel("environment steps, in thousands")
        axes.set_ylabel(label.lower())
        axes.set_xlim(0, float(drawn["step"].max()) / 1000)
        axes.set_ylim(*limits)
        legend_below(figure, [axes], 2)
    return figure


def missing(work: Work) -> list[str]:
    """That there are no agents, of a run that is about them; controls that nobody asked for are not missed."""
    contents = work.contents
    about_ladders = contents.ladders or any(place["N"] is not None for place in work.places.values() if "N" in place)
    return [] if contents.agents or about_ladders else ["no agents"]


def is_learned(agent: Mapping[str, Any]) -> bool:
    """Whether an agent learned to choose among members' options."""
    return agent["kind"] == "meta" and agent["chooser"] != "random" and agent["termination"] != "oracle"
