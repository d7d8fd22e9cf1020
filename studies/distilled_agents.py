"""Do agents over distilled options learn a new layout sooner, or need not learn there at all? DoorKey, D-BAT's members.

    python -m studies.distilled_agents docs/results/distilled-agents.csv

Two kinds of cells. ``plain`` and ``harsh``: an agent learns to choose in one of ``LAYOUTS``, over options that were
distilled elsewhere by ``studies.distilled`` (or planned there), until it has played its steps; the ensembles'
seeds take turns. In the harsh world a wrong key ends the episode, which is cut after 1.5 shortest paths. ``many``: an
agent learns over the layouts that its options were distilled in, and plays 100 others without learning, beside
uniform-random choice among the same options.
"""

from __future__ import annotations

import csv
import json
import math
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from hypogoal.core.artefacts import open_artefact
from hypogoal.core.config import resolve
from hypogoal.core.seeding import rng_for
from hypogoal.evaluation.curves import steps_to_solve
from hypogoal.evaluation.frozen import play
from hypogoal.evaluation.zero_shot import EPISODES, shortest_ways
from hypogoal.meta.config import TrainMetaConfig
from hypogoal.meta.episodes import agent_of
from hypogoal.options.choosers import RandomChooser
from hypogoal.options.tables import Episodes
from hypogoal.stages.train_meta import train_meta
from studies.cells import Cell, Row, interval, parser_of, run_cells, table
from studies.distilled import FIRST, ensemble_of
from studies.many_layouts import new_layouts

LAYOUTS = {  # Figure 6's; those of the page where choosing decides, which can be solved without a wrong key
    "plain": range(300, 310),
    "harsh": (70100, 70101, 70102, 70103, 70105, 70107, 70109, 70110, 70111, 70112),
}
STEPS, STEPS_OF_MANY = 20_000, 200_000
STEP = 1  # of a cell
UNIFORM = "_uniform"  # what columns of uniform-random choice end in
WORLDS: dict[str, dict[str, Any]] = {
    "plain": {"steps": STEPS},
    "harsh": {"steps": 50_000, "world": ("wrong_key=ends",), "cap": 1.5},
    "many": {"steps": STEPS_OF_MANY, "layouts": "1000-1199", "meta_network": "grid", "environments": 32},
}
# A title, the options of studies.distilled (None: planned in the agent's own layouts), who chooses.
OPTIONS: dict[str, tuple[str, str | None, str]] = {
    "distilled": ("distilled", "dbat", "ppo"),
    "uniform": ("the same, uniform-random choice", "dbat", "random"),
    "grid": ("distilled, grid, 200 layouts", "grid", "ppo"),
    "uniform-grid": ("the same, uniform-random choice", "grid", "random"),
    "planned": ("planned there", None, "ppo"),
}
KEYS = ("world", "options", "layout")
COLUMNS = (
    *(*KEYS, "step", "seed", "steps_to_95", "cpu_seconds", "success", "length_ratio"),
    *("success_uniform", "within_2", "within_2_uniform"),
)


def run_cell(work: Path, world: str, options: str, number: int, seed: int) -> list[Row]:
    """An agent learns in layout ``number``, or in many layouts, over the options of an ensemble of this seed."""
    source = ensemble_of(work, "dbat", seed)
    _, distilled, who = OPTIONS[options]
    changes = dict(WORLDS[world]) | ({} if world == "many" else {"layout_seed": number}) | {"chooser": who}
    if distilled is None:
        config, practice = TrainMetaConfig(network="planned", **changes), None
    else:
        practice = work / f"options-{distilled}-{seed}"
        changes["embedding"] = open_artefact(practice, "options").config["embedding"]
        config = resolve(TrainMetaConfig, stage="train-meta", preset="distilled", options=changes)
    out, begun = work / f"agent-{world}-{options}-{number}", time.process_time()
    train_meta(source.path, config, out, options=practice, seed=number, force=True, quiet=True)
    spent, agent = time.process_time() - begun, open_artefact(out, "meta")
    before = agent.config["options_steps"]  # of practice in other layouts
    episodes = Episodes.read(out / Episodes.FILE)
    here = episodes.at(np.flatnonzero(episodes.step > before))
    reached = steps_to_solve(here)
    numbers = {
        "steps_to_95": math.inf if reached is None else float(reached - before),
        "cpu_seconds": spent,
        "success": float(here.last().succeeded.mean()),
    }
    if shortest := json.loads((out / "layout.json").read_text(encoding="utf-8"))["shortest_path"]:
        numbers["length_ratio"] = float(here.last().length.mean()) / shortest
    if world == "many":
        loop = agent_of(agent, seed, 100, tuple(new_layouts(FIRST)))
        ways = shortest_ways(loop.engine)[:, -1:]
        choosers = {"": loop.chooser, UNIFORM: RandomChooser(rng_for(seed, "uniform-choice"))}
        for name, player in choosers.items():
            scores = play(loop, player, EPISODES).scores(ways)
            numbers |= {f"{score}{name}": float(scores[score].mean()) for score in ("success", "within_2")}
    return [{"world": world, "options": options, "layout": number, "step": STEP, "seed": seed, **numbers}]


def read(path: Path) -> dict[tuple[str, str], list[dict[str, float]]]:
    """The numbers of all cells, by world and options."""
    cells: dict[tuple[str, str], list[dict[str, float]]] = defaultdict(list)
    with path.open(encoding="utf-8", newline="") as file:
        for row in csv.DictReader(file):
            numbers = {name: float(row[name]) for name in COLUMNS[len(KEYS) :] if row[name]}
            cells[row["world"], row["options"]].append(numbers)
    return cells


def tables(path: Path) -> Iterator[str]:
    """What the cells say, as lines of Markdown."""
    cells = read(path)
    yield "One new layout: environment steps there until 95 of the last 100 episodes are solved; then the last 100."
    yield ""
    rows = []
    for world, options in ((world, options) for world in ("plain", "harsh") for options in OPTIONS):
        if some := cells[world, options]:
            reached = np.array([row["steps_to_95"] for row in some])
            middle = float(np.median(reached))
            rows.append(
                [
                    f"{world}, {OPTIONS[options][0]}",
                    f"{np.isfinite(reached).sum()} of {len(some)}",
                    f"{middle:,.0f}" if math.isfinite(middle) else "never",
                    interval(np.array([row["success"] for row in some]), 2),
                    interval(np.array([row["length_ratio"] for row in some]), 2),
                    f"{np.median([row['cpu_seconds'] for row in some]):.0f}",
                ]
            )
    titles = ["world, options", "reached 95 %", "95 % at, median", "solved", "length / shortest", "CPU seconds"]
    yield from table(titles, rows)
    yield "100 new layouts, without learning there: agent / uniform-random choice among the same options."
    yield ""
    rows = []
    for options, (title, _, _) in OPTIONS.items():
        if some := cells["many", options]:
            pairs = [
                " / ".join(interval(np.array([row[f"{name}{who}"] for row in some]), 2) for who in ("", UNIFORM))
                for name in ("within_2", "success")
            ]
            rows.append([title, *pairs, str(len(some))])
    yield from table(["options", "within twice the shortest path", "solved", "seeds"], rows)


def main() -> None:
    """Run the cells that are not in the file yet."""
    parser = parser_of(__doc__, "0-4")
    parser.add_argument("--work", type=Path, default=Path("runs/distilled"), help="where studies.distilled worked")
    parser.add_argument("--worlds", default=",".join(WORLDS), help=f"of {', '.join(WORLDS)}")
    parser.add_argument("--options", default=",".join(OPTIONS), help=f"of {', '.join(OPTIONS)}")
    arguments = parser.parse_args()
    if arguments.tables:
        print("\n".join(tables(arguments.csv)))
        return
    jobs: dict[Cell, Callable[[], list[Row]]] = {
        (world, options, str(number)): partial(
            run_cell, arguments.work, world, options, number, arguments.seeds[place % len(arguments.seeds)]
        )
        for world in arguments.worlds.split(",")
        for options in arguments.options.split(",")
        for place, number in enumerate(arguments.seeds if world == "many" else LAYOUTS[world])
    }
    run_cells(arguments.csv, COLUMNS, KEYS, jobs, lambda _: (STEP,), arguments.workers)


if __name__ == "__main__":
    main()
