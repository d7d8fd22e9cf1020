"""Do agents over distilled options learn a new layout sooner, or need not learn there at all? DoorKey, D-BAT's members.

    python -m studies.distilled_agents docs/results/distilled-agents.csv

Two kinds of cells. ``plain`` and ``harsh``: an agent learns to choose in one of ``LAYOUTS``, over options that were
distilled elsewhere by ``studies.distilled`` (or planned there), until it has played its steps; the ensembles'
seeds take turns. In the harsh world a wrong key ends the episode, which is cut after 1.5 shortest paths. ``many`` and
``many-harsh``: an agent learns over the layouts that its options were distilled in, and plays 100 others without
learning, beside uniform-random choice among the same options, and PPO on primitive actions that learned in the same
layouts. There nothing is cut at 1.5 shortest paths, but success within them is counted.
"""

from __future__ import annotations

import json
import math
import time
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import Tensor, nn

from hypogoal.core.artefacts import open_artefact
from hypogoal.core.compute import prepare
from hypogoal.core.config import parse_assignments, resolve
from hypogoal.core.seeding import rng_for, seed_for
from hypogoal.domains.base import Engine, Layouts
from hypogoal.domains.doorkey import DOMAIN
from hypogoal.evaluation.curves import scores, steps_to_solve
from hypogoal.evaluation.frozen import play
from hypogoal.evaluation.zero_shot import EPISODES, shortest_ways
from hypogoal.learners.baselines.agents import own_randomness, train
from hypogoal.learners.baselines.engine_env import EngineEnv
from hypogoal.learners.baselines.networks import CELL, FEATURES, NETWORKS
from hypogoal.learners.baselines.settings import HYPERPARAMETERS
from hypogoal.meta.config import TrainMetaConfig, layout_seeds
from hypogoal.meta.episodes import agent_of
from hypogoal.options.choosers import RandomChooser
from hypogoal.options.networks import GRID, GridEmbedding
from hypogoal.options.tables import Episodes
from hypogoal.stages.train_meta import train_meta
from studies.cells import Jobs, Row, interval, parser_of, printed, read_rows, run_cells, table
from studies.distilled import FIRST, ensemble_of, options_of
from studies.many_layouts import new_layouts

LAYOUTS = {  # Figure 6's; those of the page where choosing decides, which can be solved without a wrong key
    "plain": range(300, 310),
    "harsh": (70100, 70101, 70102, 70103, 70105, 70107, 70109, 70110, 70111, 70112),
}
STEPS, STEPS_OF_MANY = 20_000, 200_000
PIXEL_STEPS = 500_000  # of PPO on primitive actions; an agent has 200,000, its options 204,800
STEP = 1  # of a cell
UNIFORM = "_uniform"  # what columns of uniform-random choice end in
HARSH = ("wrong_key=ends",)
MANY: dict[str, Any] = {
    "steps": STEPS_OF_MANY,
    "layouts": "1000-1199",
    "meta_network": "grid",
    "environments": 32,
}
WORLDS: dict[str, dict[str, Any]] = {
    "plain": {"steps": STEPS},
    "harsh": {"steps": 50_000, "world": HARSH, "cap": 1.5},
    "many": MANY,
    "many-harsh": MANY | {"world": HARSH},
}
# A title, the options of studies.distilled (None: planned in the agent's own layouts), who chooses.
OPTIONS: dict[str, tuple[str, str | None, str]] = {
    "distilled": ("distilled", "dbat", "ppo"),
    "uniform": ("the same, uniform-random choice", "dbat", "random"),
    "grid": ("distilled, grid, 200 layouts", "grid", "ppo"),
    "uniform-grid": ("the same, uniform-random choice", "grid", "random"),
    "planned": ("planned there", None, "ppo"),
}
PIXELS = "pixels-grid"  # PPO on primitive actions, which plays in many layouts alone
KEYS = ("world", "options", "layout")
SCORES = ("success", "near", "within_2")
COLUMNS = (
    *(*KEYS, "step", "seed", "steps_to_95", "cpu_seconds", "success", "length_ratio"),
    *("success_uniform", "within_2", "within_2_uniform", "near", "near_uniform", "solvable"),
)


class GridFeatures(BaseFeaturesExtractor):
    """The embedding that agents over options have in many layouts (``meta_network=grid``), and two dense layers."""

    def __init__(self, space: spaces.Box, tiles: NDArray[np.uint8], rows: int):
        super().__init__(space, FEATURES)
        self.grid, self.tiles = GridEmbedding((rows * CELL, space.shape[0] // rows * CELL, tiles.shape[3])), tiles
        layers = nn.Linear(self.grid.features, FEATURES), nn.ReLU(), nn.Linear(FEATURES, FEATURES), nn.ReLU()
        self.dense = nn.Sequential(*layers)

    def forward(self, observations: Tensor) -> Tensor:
        features: Tensor = self.dense(self.grid.from_codes(observations, self.tiles))
        return features


NETWORKS[GRID] = GridFeatures  # type: ignore[assignment]


def run_cell(work: Path, world: str, options: str, number: int, seed: int) -> list[Row]:
    """An agent learns in layout ``number``, or in many layouts, over the options of an ensemble of this seed."""
    source = ensemble_of(work, "dbat", seed)
    _, distilled, who = OPTIONS[options]
    many = world.startswith("many")
    changes = dict(WORLDS[world]) | ({} if many else {"layout_seed": number}) | {"chooser": who}
    if distilled is None:
        config, practice = TrainMetaConfig(network="planned", **changes), None
    else:
        practice, _ = options_of(work, distilled, seed)
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
    if many:
        loop = agent_of(agent, seed, 100, tuple(new_layouts(FIRST)))
        ways = shortest_ways(loop.engine)[:, -1:]
        choosers = {"": loop.chooser, UNIFORM: RandomChooser(rng_for(seed, "uniform-choice"))}
        for name, player in choosers.items():
            played = play(loop, player, EPISODES)
            numbers |= scored(played.succeeded, played.length, ways, name)
    return [{"world": world, "options": options, "layout": number, "step": STEP, "seed": seed, **numbers}]


def run_pixels(world: str, seed: int) -> list[Row]:
    """PPO on primitive actions learns in many layouts and plays 100 others."""
    prepare()
    chosen = replace(HYPERPARAMETERS["ppo", "tuned"], network=GRID)
    changes = parse_assignments(WORLDS[world].get("world", ()))

    def engine_in(layouts: Layouts, count: int) -> Engine:
        return DOMAIN.make_engine(0, count, TrainMetaConfig.max_episode_steps, layouts=layouts, **changes)

    layouts = Layouts(layout_seeds(WORLDS[world]["layouts"]), rng_for(seed, "layouts"))
    begun, env = time.process_time(), EngineEnv(engine_in(layouts, chosen.environments))
    agent = train(env, chosen, PIXEL_STEPS, seed)
    numbers = {"cpu_seconds": time.process_time() - begun}
    engine = engine_in(Layouts(new_layouts(FIRST)), 100)
    ways = shortest_ways(engine)[:, -1:]
    with own_randomness():
        torch.manual_seed(seed_for(seed, "play"))
        numbers |= scored(*first_episodes(agent, EngineEnv(engine), EPISODES), ways)
    return [{"world": world, "options": PIXELS, "layout": seed, "step": STEP, "seed": seed, **numbers}]


def first_episodes(agent: BaseAlgorithm, env: EngineEnv, count: int) -> tuple[NDArray[np.bool_], NDArray[np.int64]]:
    """Success and length of the first ``count`` episodes of each environment, (E, count) each; actions are drawn."""
    length, succeeded = np.zeros((2, env.num_envs, count), np.int64)
    ended, observations = np.zeros(env.num_envs, np.int64), env.reset()
    while ended.min() < count:
        env.step_async(agent.predict(observations)[0])
        observations, _, over, _ = env.step_wait()
        for place, (_, steps, _, _, success) in zip(np.flatnonzero(over), env.episodes, strict=True):
            if ended[place] < count:
                length[place, ended[place]], succeeded[place, ended[place]] = steps, success
                ended[place] += 1
        env.episodes.clear()
    return succeeded > 0, length


def scored(
    succeeded: NDArray[np.bool_], length: NDArray[np.int64], ways: NDArray[np.float64], name: str = ""
) -> dict[str, float]:
    """Mean ``SCORES`` over episodes (L, n) in the layouts that can be solved, whose shortest ways (L, 1) are known."""
    solvable = np.isfinite(ways[:, 0])
    by_score = scores(succeeded[solvable], length[solvable], ways[solvable])
    return {f"{score}{name}": float(by_score[score].mean()) for score in SCORES} | {"solvable": float(solvable.sum())}


def read(path: Path) -> dict[tuple[str, str], list[dict[str, float]]]:
    """The numbers of all cells, by world and options."""
    cells: dict[tuple[str, str], list[dict[str, float]]] = defaultdict(list)
    for row in read_rows(path):
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
    yield "100 new layouts, without learning there, those that can be solved: agent / uniform-random choice."
    yield ""
    rows = []
    for world, options in ((world, options) for world in ("many", "many-harsh") for options in (*OPTIONS, PIXELS)):
        if some := cells[world, options]:
            title = "no options: PPO from pixels, grid" if options == PIXELS else OPTIONS[options][0]
            pairs = [
                " / ".join(
                    interval(values, 2)
                    for who in ("", UNIFORM)
                    if len(values := np.array([row[score + who] for row in some if score + who in row]))
                )
                for score in ("within_2", "near", "success")
            ]
            cpu = f"{np.median([row['cpu_seconds'] for row in some]):.0f}"
            rows.append([f"{'harsh' if world == 'many-harsh' else 'plain'}, {title}", *pairs, cpu, str(len(some))])
    titles = ["world, options", "within twice the shortest path", "within 1.5 times", "solved", "CPU seconds", "seeds"]
    yield from table(titles, rows)


def main() -> None:
    """Run the cells that are not in the file yet."""
    parser = parser_of(__doc__, "0-4")
    parser.add_argument("--work", type=Path, default=Path("runs/distilled"), help="where studies.distilled worked")
    parser.add_argument("--worlds", default=",".join(WORLDS), help=f"of {', '.join(WORLDS)}")
    parser.add_argument("--options", default=",".join(OPTIONS), help=f"of {', '.join(OPTIONS)}; or {PIXELS}")
    arguments = parser.parse_args()
    if printed(arguments, tables):
        return
    jobs: Jobs = {}
    for world in arguments.worlds.split(","):
        for options in arguments.options.split(","):
            for place, number in enumerate(arguments.seeds if world.startswith("many") else LAYOUTS[world]):
                seed = arguments.seeds[place % len(arguments.seeds)]
                cell = partial(run_cell, arguments.work, world, options, number, seed)
                jobs[world, options, str(number)] = partial(run_pixels, world, seed) if options == PIXELS else cell
    run_cells(arguments.csv, COLUMNS, KEYS, jobs, lambda _: (STEP,), arguments.workers)


if __name__ == "__main__":
    main()
