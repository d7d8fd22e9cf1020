"""Figure 6: what agents achieve on layouts that no data came from, over training and at its end (Spec E6, E7, F5)."""

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from hypogoal.core.arrays import Bools, Doubles, Ints
from hypogoal.core.artefacts import Artefact
from hypogoal.evaluation.house import ROUNDING, per_run, tidy
from hypogoal.evaluation.judging import Work
from hypogoal.evaluation.names import rank
from hypogoal.evaluation.page import Drawn, Results
from hypogoal.evaluation.plots import DOTTED, banded, legend_below, looks, plot, styled
from hypogoal.evaluation.run import read_layout
from hypogoal.learners.episodes import LAST
from hypogoal.options.tables import Episodes

TITLE = "Summary"
FIRST = 20  # episodes that a curve begins with: of many parallel ones, the first to end are the lucky ones
SOLVED = 0.95  # share of the window's episodes
NEAR = 1.5  # times the shortest path
WITHIN = {"near": NEAR, "within_2": 2.0}  # times the shortest path
POINTS = 151  # of a curve
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
)
PAIRED = ("success", "length", "near")
FIGURES = {  # file, label, and what is dotted across
    "reward": ("figure6", "Undiscounted reward per episode", "random_success"),
    "solved_length": ("figure6-length", "Length of solved episodes", "shortest_path"),
}
NEEDED = {"figure6": "options, meta or baseline artefacts"}


def scores(succeeded: Bools, steps: Ints, shortest: float | Doubles | None) -> dict[str, Doubles]:
    """``success``, and success within so many times the shortest path, ``WITHIN``: 1 or 0 of each episode (E, ...).

    ``shortest``, steps, is broadcast to the episodes; NaN or None where no path is known, and so are those scores.
    """
    path = np.asarray(shortest, dtype=np.float64)
    where_known = np.where(np.isnan(path), np.nan, 1.0)
    columns: dict[str, Any] = {"success": succeeded * 1.0}
    for name, factor in WITHIN.items():
        columns[name] = where_known * (succeeded & (steps <= factor * path))
    return columns


def table_of(episodes: Episodes) -> pd.DataFrame:
    """What is averaged of each episode, a column each; ``solved_length`` is NaN where it failed."""
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


def curves(episodes: Episodes, grid: Ints, window: int = LAST) -> pd.DataFrame:
    """Figure 6: means of the last ``window`` episodes known by each step of ``grid`` (G,), its index.

    From ``FIRST`` on. Columns reward, success, length and solved_length; that is NaN where none is solved.
    """
    values = table_of(episodes).drop(columns=["ended", "cut"])
    means = values.rolling(window, min_periods=1).mean()
    count = np.searchsorted(episodes.step, grid, side="right")
    enough = count >= FIRST
    return means.loc[count[enough] - 1].set_axis(grid[enough])


def run_numbers(episodes: Episodes, shortest_path: int | None, window: int = LAST) -> dict[str, float]:
    """Spec F5: the numbers of one run, over its last ``window`` training episodes at most; NaN without episodes.

    ``shortest_path``: primitive steps from the start to the goal at least; None or 0 where unknown. ``window`` in the
    numbers: episodes actually averaged. ``steps_to_95``: the first step at which 95 % of the last ``window`` had
    succeeded; NaN: never, or too few.
    """
    last = episodes.last(window)
    shortest = shortest_path or np.nan
    near = scores(last.succeeded, last.length, shortest)["near"]
    means = table_of(last).assign(near=near).mean()
    numbers = {str(name): mean for name, mean in means.items()}
    solved = pd.Series(episodes.succeeded).rolling(window).sum()
    reached = solved >= SOLVED * window - ROUNDING
    return {
        **numbers,
        "episodes": len(episodes),
        "window": len(last),
        "length_over_shortest": means["length"] / shortest,
        "solved_over_shortest": means["solved_length"] / shortest,
        "steps_to_95": pd.Series(episodes.step)[reached].min(),
    }


def practice_of(config: Mapping[str, Any]) -> int:
    """The steps of the options that an agent continues, which may have ended before their limit."""
    return int(config.get("options_ended_at", config.get("options_steps", 0)))


def budget_of(config: Mapping[str, Any]) -> int:
    """An agent's environment steps, those of earlier stages included."""
    return int(config.get("ended_at", config.get("steps", 0))) + practice_of(config)


def rows(work: Work) -> Iterator[pd.DataFrame]:
    """Every agent's run at its end, and its curves; random play on each layout."""
    agents = sorted(work.contents.agents, key=lambda artefact: rank(work.place(artefact)["method"]))
    most = max((budget_of(artefact.config) for artefact in agents), default=0)
    grid = np.linspace(0, most, POINTS).round().astype(np.int64)
    random: dict[int | None, float | None] = {}
    for artefact in agents:
        layout = read_layout(artefact.path / "layout.json")
        yield from _rows_of_agent(artefact, layout.shortest_path, grid, work.place(artefact))
        random[None if layout.layouts else layout.layout_seed] = layout.random_success
    for seed, success in random.items():
        yield tidy({"random_success": success}, layout=seed)


def _rows_of_agent(
    artefact: Artefact,
    shortest: int | None,
    grid: Ints,
    place: Mapping[str, Any],
) -> Iterator[pd.DataFrame]:
    steps = budget_of(artefact.config)
    episodes = Episodes.read(artefact.path / "episodes.csv")
    facts: dict[str, Any] = {"steps": steps, "practice": practice_of(artefact.config), "shortest_path": shortest}
    yield tidy(facts | run_numbers(episodes, shortest), **place)
    drawn = curves(episodes, grid[grid <= steps]).rename_axis("step").reset_index()
    yield drawn.melt("step", var_name="quantity").assign(**place)


def facts(work: Work) -> dict[str, Any]:
    """Of each agent, by its name, its ``members``, ``layouts``, and ``choice``: learned, random, or none of members."""
    agents = {}
    for artefact in work.contents.agents:
        config = artefact.config
        choice = ""
        if artefact.kind == "meta" and config["termination"] != "oracle":
            choice = "random" if config["chooser"] == "random" else "learned"
        agents[work.place(artefact)["method"]] = {
            "members": config.get("members"),
            "layouts": config.get("layouts"),
            "choice": choice,
        }
    return {"agents": agents}


def chosen_by(results: Results, choice: str) -> dict[str, dict[str, Any]]:
    """The agents whose choice among members' options is learned or random."""
    agents = results.facts["agents"]
    return {name: agent for name, agent in agents.items() if agent["choice"] == choice}


def runs(results: Results) -> pd.DataFrame:
    """Every agent's numbers."""
    return per_run(_of_agents(results), *QUANTITIES)


def _of_agents(results: Results) -> pd.DataFrame:
    return results.of(method=[*results.facts["agents"]])


def figures(context: Mapping[str, Any]) -> Iterator[Drawn]:
    """Figure 6 and the same of the length of solved episodes, where it is not the same everywhere."""
    results = context["results"]
    points = _of_agents(results).dropna(subset="step")
    for quantity, (name, label, reference) in FIGURES.items():
        drawn = points[points["quantity"] == quantity]
        if drawn.empty or (quantity != "reward" and drawn["value"].nunique() < 2):
            continue
        references = results.of(quantity=reference).drop_duplicates("layout")["value"]
        if quantity == "reward" and not drawn["value"].between(0, 1).all():
            references = references[:0]  # a share of episodes says nothing beside other rewards
        figure = learning_curves(drawn, label, references.mean())
        yield Drawn(name, label, figure, {"dotted": reference if len(references) else ""})


def learning_curves(drawn: pd.DataFrame, label: str, reference: float = np.nan) -> Figure:
    """Figure 6: a quantity of episodes against environment steps, a line per method, a ``reference`` dotted across.

    ``drawn`` are rows of the table of numbers. The mean over layouts, or runs of one layout, and a band of one standard
    error.
    """
    unit = "layout" if drawn["layout"].nunique() > 1 else "artefact"
    with styled():
        figure, axes = plot(2.9)
        for method, look in looks(drawn["method"]).items():
            rows = drawn[drawn["method"] == method]
            values = rows.pivot_table(index="step", columns=unit, values="value", dropna=False)
            values.index = values.index.astype(float) / 1000
            banded(axes, values.mean(axis=1), values.sem(axis=1), label=method, **look)
        axes.axhline(reference, **DOTTED)
        axes.set(xlabel="environment steps, in thousands", ylabel=label.lower())
        legend_below(figure, [axes], 2)
    return figure


def missing(work: Work) -> list[str]:
    """That there are no agents, of a run that is about them; controls that nobody asked for are not missed."""
    contents = work.contents
    groups = [place.get("N") for place in work.places.values()]
    about_ladders = contents.ladders or any(groups)
    return [] if contents.agents or about_ladders else ["no agents"]
