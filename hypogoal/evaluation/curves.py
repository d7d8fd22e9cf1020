"""Figure 6: what agents achieve on layouts that no data came from, over training and at its end."""

import json
from collections.abc import Mapping
from functools import partial
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from hypogoal.core.arrays import Bools, Doubles, Ints
from hypogoal.domains.episodes import LAST
from hypogoal.evaluation.page import Drawn
from hypogoal.evaluation.plots import DOTTED, legend_below, plot
from hypogoal.evaluation.run import Results, choice_of
from hypogoal.evaluation.statistics import at_least, tables_of
from hypogoal.evaluation.table import melted, per_run, tidy
from hypogoal.options.tables import Episodes

TITLE = "Summary"
FIRST = 20  # episodes before a curve begins, because the first of parallel episodes to end are lucky
SOLVED = 0.95  # share of a window's episodes that counts as solved
WITHIN = {"near": 1.5, "within_2": 2.0}  # multiples of the shortest path
POINTS = 151  # points of a curve
SHORT = 20  # episodes that a point of a curve over episodes averages, and of which 95 % must be solved
WINDOWS = ((1, 10), (11, 20), (21, 50), (51, 100))  # the first and the last episode of each window
BY_EPISODE = "solved_by_episode"
MOST = 10_000  # episodes of a curve over episodes
BY = ["method"]
QUANTITIES = (
    "success",
    "reward",
    "length",
    "length_over_shortest",
    "near",
    "solved_length",
    "solved_over_shortest",
    "ended",
    "cut",
    "steps_to_95",
    *(f"solved_{first}_{last}" for first, last in WINDOWS),
    "episodes_to_95",
)
PAIRED = ("success", "length", "near")
FIGURES = {  # by quantity: file, label, and the quantity that is dotted across
    "reward": ("figure6", "Undiscounted reward per episode", "random_success"),
    BY_EPISODE: ("figure6-episodes", "Share of episodes solved", "random_success"),
    "solved_length": ("figure6-length", "Length of solved episodes", "shortest_path"),
}


def scores(
    succeeded: Bools,
    steps: Ints,
    shortest: float | Doubles | None,
) -> dict[str, Doubles]:
    """Return ``success``, and success within the multiples ``WITHIN`` of the shortest path, 1 or 0 (E, ...) each.

    ``shortest``, in steps, is broadcast to the episodes. If it is NaN or None, no path is known, and the scores within
    multiples are NaN.
    """
    path = np.asarray(shortest, float)
    columns: dict[str, Any] = {"success": succeeded * 1.0}
    for name, factor in WITHIN.items():
        within = succeeded & (steps <= factor * path)
        columns[name] = np.where(np.isnan(path), np.nan, within)
    return columns


def table_of(episodes: Episodes) -> pd.DataFrame:
    """Return what is averaged of each episode, a column each. ``solved_length`` is NaN if the episode failed."""
    failed = ~episodes.succeeded
    columns = {
        "success": episodes.succeeded,
        "reward": episodes.reward,
        "length": episodes.length,
        "solved_length": np.where(failed, np.nan, episodes.length),
        "ended": episodes.terminated & failed,
        "cut": ~episodes.terminated & failed,
    }
    return pd.DataFrame(columns, dtype=float)


def curves(episodes: Episodes, grid: Ints) -> pd.DataFrame:
    """Return Figure 6's curves: by each step of ``grid`` (G,), the means of the last ``LAST`` episodes that had ended.

    The index is the steps by which ``FIRST`` episodes had ended. Columns: reward, success, length and solved_length,
    which is NaN if no episode is solved.
    """
    values = table_of(episodes).drop(columns=["ended", "cut"])
    means = values.rolling(LAST, min_periods=1).mean()
    count = np.searchsorted(episodes.step, grid, side="right")
    enough = count >= FIRST
    return means.loc[count[enough] - 1].set_axis(grid[enough]).rename_axis("step")


def by_episode(succeeded: Bools) -> pd.DataFrame:
    """Return the share solved of the last ``SHORT`` of (n,) episodes, from the tenth on.

    The index is the number of the episode.
    """
    solved = pd.Series(succeeded, np.arange(1, len(succeeded) + 1), dtype=float).rename_axis("step")
    shares = solved.rolling(SHORT, min_periods=1).mean()
    grid = np.geomspace(10, MOST, POINTS).round().astype(np.int64)
    shown = np.unique(grid[grid <= len(solved)])
    return shares[shown].to_frame(BY_EPISODE)


def episode_numbers(succeeded: Bools) -> dict[str, float]:
    """Return how soon (n,) episodes succeed, in the order in which they ended.

    Each of ``WINDOWS`` has the share solved, NaN if the window is not complete. ``episodes_to_95`` is the number of
    episodes until 95 % of the last ``SHORT`` had succeeded, or NaN if they never had.
    """
    solved = pd.Series(succeeded, np.arange(1, len(succeeded) + 1), dtype=float)
    numbers = {}
    for first, last in WINDOWS:
        means = solved.rolling(last - first + 1).mean()
        numbers[f"solved_{first}_{last}"] = means.get(last, np.nan)
    reached = at_least(solved.rolling(SHORT).mean(), SOLVED)
    return {**numbers, "episodes_to_95": solved.index[reached].min()}


def run_numbers(episodes: Episodes, shortest_path: int | None) -> dict[Any, float]:
    """Return the numbers of one run, over its last ``LAST`` training episodes at most. Without episodes, they are NaN.

    ``shortest_path``: the least number of primitive steps from the start to the goal, None or 0 if unknown.
    ``steps_to_95``: the first step at which 95 % of the last ``LAST`` episodes had succeeded, NaN if there is none.
    """
    last = episodes.last()
    shortest = shortest_path or np.nan
    near = scores(last.succeeded, last.length, shortest)["near"]
    means = table_of(last).assign(near=near).mean()
    solved = pd.Series(episodes.succeeded).rolling(LAST).sum()
    reached = at_least(solved, SOLVED * LAST)
    return {
        **means.to_dict(),
        "episodes": len(episodes),
        "length_over_shortest": means["length"] / shortest,
        "solved_over_shortest": means["solved_length"] / shortest,
        "steps_to_95": pd.Series(episodes.step)[reached].min(),
        **episode_numbers(episodes.succeeded),
    }


def budget_of(config: Mapping[str, Any]) -> int:
    """Return the environment steps that an agent took, with those of the options that it continues.

    Training may end before its limit.
    """
    practice = config.get("options_ended_at", config.get("options_steps", 0))
    return int(config.get("ended_at", config.get("steps", 0)) + practice)


def rows(work):
    """Yield the numbers of every agent's run at its end, its curves, and random play on each layout."""
    agents = work.ranked(work.contents.agents)
    most = max((budget_of(artefact.config) for artefact in agents), default=0)
    grid = np.linspace(0, most, POINTS).round().astype(int)
    random = {}
    for artefact in agents:
        place, steps = work.place(artefact), budget_of(artefact.config)
        layout = json.loads((artefact.path / "layout.json").read_bytes())
        episodes = Episodes.read(artefact.path / Episodes.FILE)
        numbers = run_numbers(episodes, layout["shortest_path"])
        yield tidy({"steps": steps, "shortest_path": layout["shortest_path"], **numbers}, **place)
        yield melted(curves(episodes, grid[grid <= steps]), **place)
        yield melted(by_episode(episodes.succeeded), **place)
        random[None if layout.get("layouts") else place["layout"]] = layout["random_success"]
    for seed, success in random.items():
        yield tidy({"random_success": success}, layout=seed)


def facts(work):
    """Return each agent's ``members`` and its ``choice`` among them (learned, random or empty), by its name."""
    agents = {}
    for artefact in work.contents.agents:
        name, members = work.place(artefact)["method"], artefact.config.get("members")
        agents[name] = {"members": members, "choice": choice_of(artefact)}
    return {"agents": agents}


def chosen_by(results: Results, choice: str) -> dict[str, dict[str, Any]]:
    """Return the agents whose choice among members' options is ``choice``, learned or random."""
    agents = results.facts["agents"]
    return {name: agent for name, agent in agents.items() if agent["choice"] == choice}


def context(results):
    """Return every agent's numbers, and Figure 6."""
    agents = results.of(method=[*results.facts["agents"]])
    tables = tables_of(per_run(agents, *QUANTITIES), BY, PAIRED)
    return tables and tables | {"figures": [*_figures(results)]}


def _figures(results):
    """Yield Figure 6, and the other ``FIGURES`` whose values are not all equal."""
    for quantity, (name, label, reference) in FIGURES.items():
        drawn = results.of(quantity=quantity).dropna(subset="step")
        if drawn.empty or (quantity != "reward" and drawn["value"].nunique() < 2):
            continue
        references = results.of(quantity=reference).drop_duplicates("layout")["value"]
        if quantity == "reward" and not drawn["value"].between(0, 1).all():
            references = references[:0]  # a share of episodes says nothing beside other rewards
        draw = partial(learning_curves, drawn, label, references.mean())
        yield Drawn(name, label, draw, {"dotted": reference if len(references) else ""})


def learning_curves(
    drawn: pd.DataFrame,
    label: str,
    reference: float = np.nan,
) -> Figure:
    """Draw Figure 6: a quantity of episodes against environment steps, a line per method, and a dotted ``reference``.

    ``drawn`` are rows of the table of numbers; those of ``BY_EPISODE`` are drawn against episodes. A line is the mean
    over layouts, or over runs of one layout, with a band of one standard error.
    """
    unit = "layout" if drawn["layout"].nunique() > 1 else "artefact"
    figure, axes = plot(2.9)
    in_episodes = (drawn["quantity"] == BY_EPISODE).all()
    for method, rows in drawn.groupby("method", sort=False):
        values = rows.pivot_table(index="step", columns=unit, values="value", dropna=False)
        steps = values.index.astype(float) / (1 if in_episodes else 1000)
        middle, wide = values.mean(axis=1), values.sem(axis=1)
        [line] = axes.plot(steps, middle, label=method)
        colour = line.get_color()
        axes.fill_between(
            steps,
            middle - wide,
            middle + wide,
            color=colour,
            alpha=0.18,
            linewidth=0,
        )
    axes.axhline(reference, **DOTTED)
    axes.set(xlabel="environment steps, in thousands", ylabel=label.lower())
    if in_episodes:
        axes.set(xlabel="episodes", xscale="log")
        axes.xaxis.set_major_formatter("{x:.0f}")
    legend_below(figure, 2)
    return figure
