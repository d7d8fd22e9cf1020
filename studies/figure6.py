"""Figure 6 at the paper's budget: how soon agents solve a layout, in how many steps, and whether they lose it again.

hypogoal run examples.figure6:figure6 --out runs/figure6
python -m studies.bonus runs/figure6 docs/results/figure6-doorkey.csv
python -m studies.figure6 runs/figure6 docs/results/figure6-doorkey.csv
python -m studies.figure6 --tables docs/results/figure6-doorkey.csv
python -m studies.figure6 --tables --picture docs/results/figure6.png docs/results/figure6-doorkey.csv

Layouts 300 to 309, which nothing was chosen on, seeds 3000 to 3009. Options practise for 40,000 steps under
uniform-random choice, then PPO chooses for 1,460,000. Paid PPO gets .2 for the first positive prediction of each member
in an episode. 95 % at: the first step at which 95 of the last 100 episodes were solved, practice included. Commits:
option agents 213e512, PPO and DQN 8bd54d8, the paper's networks af805d0, without memory 4f87b6a, cedd0918, e4812526
(``hypogoal run doorkey --preset paper --set train-meta.recurrence=1``, layouts 300 to 302, seeds 3000 to 3002).
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from numpy.typing import NDArray

from hypogoal.core.artefacts import Artefact
from hypogoal.core.seeding import rng_for
from hypogoal.domains.episodes import LAST
from hypogoal.evaluation.curves import budget_of, run_numbers
from hypogoal.evaluation.frozen import ENVIRONMENTS, play
from hypogoal.evaluation.run import find_artefacts
from hypogoal.meta.episodes import agent_of
from hypogoal.options.choosers import RandomChooser
from hypogoal.options.tables import Episodes
from studies.cells import amount, parser_of, read_rows, share, table, won, write_rows

METHODS = {
    "dbat-k3": "D-BAT, K = 3",
    "none-k3": "no diversity, K = 3",
    "one": "one classifier, K = 1",
    "oracle": "true sub-goals",
    "ppo-bonus": "PPO, D-BAT's verdicts as a bonus",
    "ppo-tuned": "PPO, our setting",
    "dqn-tuned": "DQN, our setting",
    "ppo-paper": "PPO, the paper's setting",
    "dqn-paper": "DQN, the paper's setting",
    "literal": "D-BAT, the paper's networks, 150,000 steps",
    "literal-none": "D-BAT, the paper's networks without memory, 150,000 steps",
}
COLUMNS = ("method", "layout", "seed", "chooser", "quantity", "value")
Agents = dict[tuple[str, str], list[dict[str, str]]]  # their rows, by method and layout
POINTS = (50, 75, 100, 150, 200, 300, 400, 600, 800, 1000, 1250, 1500)  # thousands of steps: of a curve
LINES = {  # colour, dashes
    "dbat-k3": ("#0b5394", "-"),
    "none-k3": ("#e69138", "--"),
    "one": ("#38761d", "-."),
    "oracle": ("#8a8a8a", ":"),
    "ppo-tuned": ("#990000", (0, (6, 2))),
    "dqn-tuned": ("#c27ba0", (0, (3, 1, 1, 1))),
    "ppo-bonus": ("#000000", (0, (1, 1))),
    "ppo-paper": ("#990000", (0, (1, 3))),
    "dqn-paper": ("#c27ba0", (0, (1, 3))),
}


REFERENCE = "dbat-k3"
UNIFORM = "uniform among its own options"  # in the CSV


@dataclass(frozen=True)
class Run:
    """One trained agent."""

    seed: int
    config: Mapping[str, Any]
    episodes: Episodes  # of its training
    layout: Mapping[str, Any]  # layout_seed, shortest_path


def read_run(artefact: Artefact) -> Run:
    """The episodes and the layout of one trained agent."""
    episodes = Episodes.read(artefact.path / "episodes.csv")
    layout = json.loads((artefact.path / "layout.json").read_bytes())
    return Run(artefact.seed, artefact.config, episodes, layout)


def collect(run: Path, path: Path) -> None:
    """A row for every number of every finished agent, those that are there first."""
    agents = read_agents(path)
    for kind in ("meta", "baseline"):
        for artefact in find_artefacts(run, kind):
            read = read_run(artefact)
            method = method_of(read.config, artefact.path.name)
            agent = (method, str(read.layout["layout_seed"]))
            if agent in agents:
                continue
            agents[agent] = rows_of(method, read, training_numbers(read))
            if kind == "meta":
                agents[agent] += rows_of(method, read, _frozen_numbers(artefact, read))
    write_agents(path, agents)


def read_agents(path: Path) -> Agents:
    """The rows that are there."""
    agents: Agents = {}
    if path.exists():
        for row in read_rows(path):
            agents.setdefault((row["method"], row["layout"]), []).append(row)
    return agents


def write_agents(path: Path, agents: Agents) -> None:
    """All rows, by method and layout."""
    order = list(METHODS)
    places = sorted(agents, key=lambda agent: (order.index(agent[0]), int(agent[1])))
    write_rows(path, COLUMNS, [row for place in places for row in agents[place]])


def method_of(config: Mapping[str, Any], place: str) -> str:
    """Which of ``METHODS`` an agent is, by its settings and the name of its folder."""
    if config.get("termination") == "oracle":
        return "oracle"
    if config.get("network") == "paper":
        return "literal-none" if config.get("recurrence") in (1, "none") else "literal"
    return next(name for name in METHODS if f"-{name}-" in f"-{place}-")


def rows_of(method: str, run: Run, numbers: Iterable[tuple[str, str, float]]) -> list[dict[str, str]]:
    """The rows of an agent with these numbers: chooser, quantity and value."""
    agent = {"method": method, "layout": str(run.layout["layout_seed"]), "seed": str(run.seed)}
    return [agent | {"chooser": chooser, "quantity": name, "value": f"{value:.4f}"} for chooser, name, value in numbers]


def training_numbers(run: Run) -> Iterator[tuple[str, str, float]]:
    """Chooser, quantity and value of one agent's training."""
    shortest = run.layout["shortest_path"]
    numbers = run_numbers(run.episodes, shortest)
    reached = numbers["steps_to_95"]
    yield "agent", "steps", float(budget_of(run.config))
    yield "agent", "shortest_path", float(shortest)
    yield "agent", "steps_to_95", math.inf if math.isnan(reached) else reached
    for name in ("success", "length_over_shortest", "near"):
        yield "agent", name, float(numbers[name] or 0.0)
    yield "agent", "lowest_after", lowest_after(run.episodes.step, run.episodes.succeeded, reached)
    for step in (1_000 * point for point in POINTS if 1_000 * point <= budget_of(run.config)):
        seen = run.episodes.at(run.episodes.step <= step).last()
        yield "agent", f"success_at_{step}", float(seen.succeeded.mean())
        yield "agent", f"length_at_{step}", float(seen.length.mean()) / shortest


def _frozen_numbers(artefact: Artefact, run: Run) -> Iterator[tuple[str, str, float]]:
    """The same of play without learning: of its own choice, and of uniform-random choice among its options."""
    shortest = run.layout["shortest_path"]
    loop = agent_of(artefact, run.seed, ENVIRONMENTS)
    choosers = {"frozen": loop.chooser, UNIFORM: RandomChooser(rng_for(run.seed, "uniform-choice"))}
    for name, chooser in choosers.items():
        episodes = play(loop, chooser)
        for quantity in ("success", "near"):
            yield name, quantity, float(episodes.scores(shortest)[quantity].mean())
        yield name, "length_over_shortest", float(episodes.length.mean()) / shortest


def lowest_after(step: NDArray[np.int64], succeeded: NDArray[np.bool_], since: float | None) -> float:
    """The lowest share solved of any ``LAST`` consecutive episodes that end after step ``since``; NaN if never."""
    if since is None or math.isnan(since):
        return math.nan
    sums = np.concatenate([[0], np.cumsum(succeeded.astype(np.int64))])
    recent = (sums[LAST:] - sums[:-LAST]) / LAST
    return float(recent[step[LAST - 1 :] >= since].min())


def later(reached: NDArray[np.float64], of_reference: NDArray[np.float64]) -> tuple[str, str]:
    """Write how many times the reference's steps agents took on the same layouts.

    What was never reached took longer than all else.

    Returns:
        The median of the ratios, and on how many layouts agents took longer.
    """
    both = ~np.isnan(reached) & ~np.isnan(of_reference)
    ratios = reached[both] / of_reference[both]
    return amount(ratios), won(ratios - 1)


def tables(path: Path) -> Iterator[str]:
    """What the rows say, as lines of Markdown."""
    rows = read_rows(path)
    methods = [method for method in METHODS if any(row["method"] == method for row in rows)]
    layouts = sorted({row["layout"] for row in rows}, key=int)

    def values_of(method: str, quantity: str, chooser: str = "agent") -> NDArray[np.float64]:
        by_layout = {
            row["layout"]: float(row["value"])
            for row in rows
            if (row["method"], row["quantity"], row["chooser"]) == (method, quantity, chooser)
        }
        return np.array([by_layout.get(layout, np.nan) for layout in layouts])

    def finite(values: NDArray[np.float64]) -> NDArray[np.float64]:
        return values[np.isfinite(values)]

    def training(method: str) -> list[str]:
        reached = values_of(method, "steps_to_95")
        ran = int((~np.isnan(reached)).sum())
        soon = float(np.median(reached[~np.isnan(reached)]))
        lowest = finite(values_of(method, "lowest_after"))
        return [
            METHODS[method],
            f"{np.isfinite(finite(reached)).sum()} of {ran}",
            f"{soon:,.0f}" if np.isfinite(soon) else "never",
            *(("-", "-") if method == REFERENCE else later(reached, values_of(REFERENCE, "steps_to_95"))),
            share(finite(values_of(method, "success"))),
            amount(finite(values_of(method, "length_over_shortest"))),
            f"{lowest.min():.2f}" if len(lowest) else "-",
            f"{(lowest >= 0.9).sum()} of {len(lowest)}" if len(lowest) else "-",
        ]

    yield f"Training, {len(layouts)} layouts; of the last 100 episodes over layouts.\n"
    titles = [
        "agent",
        "layouts on which it solves 95 %",
        "steps until then, median",
        "times D-BAT's steps, median",
        "layouts on which it takes longer than D-BAT",
        "solved at the end",
        "length / shortest, median",
        "lowest share solved after that, of all layouts",
        "layouts on which that is .90 or more",
    ]
    yield from table(titles, (training(method) for method in methods))
    frozen = [method for method in methods if len(finite(values_of(method, "success", "frozen")))]
    yield "Without further training: the agent / uniform-random choice among its own options.\n"
    rows_of_play = []
    for method in frozen:
        cells = [METHODS[method]]
        for quantity in ("success", "length_over_shortest", "near"):
            both = [finite(values_of(method, quantity, who)) for who in ("frozen", UNIFORM)]
            shown = amount if quantity == "length_over_shortest" else share
            cells.append(" / ".join(shown(values) for values in both))
        rows_of_play.append([*cells, str(len(finite(values_of(method, "success", "frozen"))))])
    yield from table(["", "solved", "length / shortest", "within 1.5 shortest paths", "layouts"], rows_of_play)
    yield "95 % at, in thousands of steps, layout by layout.\n"
    reached = [[METHODS[method], *map(_thousands, values_of(method, "steps_to_95").tolist())] for method in methods]
    yield from table(["", *layouts], reached)


def draw(path: Path, out: Path) -> None:
    """The curves: means over the layouts of each method, in the last 100 episodes before a step."""
    rows = read_rows(path)
    figure, places = plt.subplots(1, 2, figsize=(10, 3.8), layout="constrained")
    titles = {"success": "share of episodes solved", "length": "episode length / shortest path"}
    for axes, (quantity, title) in zip(places, titles.items(), strict=True):
        for method, (colour, dashes) in LINES.items():
            means = []
            for point in POINTS:
                name = f"{quantity}_at_{1_000 * point}"
                values = [float(row["value"]) for row in rows if (row["method"], row["quantity"]) == (method, name)]
                means.append(float(np.mean(values)) if values else math.nan)
            if np.isfinite(means).any():
                axes.plot(POINTS, means, color=colour, linestyle=dashes, lw=1.8, label=METHODS[method])
        axes.set_xscale("log")
        axes.set_xticks(POINTS[::2], [f"{point:,}" for point in POINTS[::2]], fontsize=8)
        axes.minorticks_off()
        axes.set_xlabel("environment steps, thousands", fontsize=9)
        axes.set_title(title, fontsize=10)
        axes.spines[["top", "right"]].set_visible(False)
    places[1].set_yscale("log")
    places[1].set_yticks([1, 2, 5, 10, 30], ["1", "2", "5", "10", "30"], fontsize=8)
    places[1].minorticks_off()
    figure.legend(*places[0].get_legend_handles_labels(), loc="outside right center", fontsize=8, frameon=False)
    figure.savefig(out, dpi=150)


def _thousands(steps: float) -> str:
    return "-" if math.isnan(steps) else "never" if math.isinf(steps) else f"{steps / 1000:.0f}"


def main() -> None:
    """Take the numbers of a run, or draw the tables."""
    parser = parser_of(__doc__, run="the folder of the sweep")
    parser.add_argument("--picture", type=Path, help="draw the curves, a .png file")
    arguments = parser.parse_args()
    if not arguments.tables:
        collect(arguments.run, arguments.csv)
    if arguments.picture:
        draw(arguments.csv, arguments.picture)
    print("\n".join(tables(arguments.csv)))


if __name__ == "__main__":
    main()
