"""What learned options and PPO do where ``studies.misgeneralise`` has planned options.

    PYTHONPATH=examples HYPOGOAL_TRUST=1 python -m studies.misgeneralise_agents runs/misgeneralise \
        docs/results/misgeneralise-agents.csv
    python -m studies.misgeneralise_agents --tables docs/results/misgeneralise-agents.csv

Each row is an agent, a task and a seed, in the same thirty new levels. ``solved``: the share of the last hundred
episodes of training; of PPO that only looks, of two hundred episodes. ``episodes_to_90``: after how many episodes 90 %
of a hundred were solved; empty if they never were.

Learned options learn by Double DQN while the agent chooses among them. PPO is that of ``train-baseline``, its settings
tuned on DoorKey. It learns in the labelled levels, plays others of that kind and new levels without learning, and goes
on learning in new levels; another begins there.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from functools import partial
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch

import hypogoal
from hypogoal.core.seeding import rng_for
from hypogoal.domains.base import Layouts
from hypogoal.domains.find import load_domain
from hypogoal.options.tables import Episodes
from studies.cells import Jobs, Row, parser_of, printed, read_rows, run_cells, share, table
from studies.misgeneralise import FEATURES, LEVELS, METHODS, WORLDS, data_of, levels

LABELLED = "labelled"
LEARNED, PPO = "learned options", "PPO"
SEEN = "PPO, in its labelled levels"
UNSEEN = "PPO, in labelled levels it has not seen"
NEW = "PPO of labelled levels, in new levels"
TUNED = "the same, learning in new levels"
SCRATCH = "PPO, learning in new levels from nothing"
TITLES = {  # as the tables call them
    LEARNED: "options, learning in new levels",
    SEEN: "PPO, learning in labelled levels",
    UNSEEN: "this PPO, frozen, in other labelled levels",
    NEW: "this PPO, frozen, in new levels",
    TUNED: "this PPO, learning on in new levels",
    SCRATCH: "another PPO, learning in new levels from nothing",
}
AGENTS = (LEARNED, SEEN, UNSEEN, NEW, TUNED, SCRATCH)
OPTION_STEPS = 40_000
OPTIONS: dict[str, Any] = {"network": "light", "environments": 16, "epsilon_steps": 15_000}
PPO_STEPS = 40_000
LOOKED_AT = 200  # episodes
ENOUGH, WINDOW = 0.9, 100
CAP = 100  # steps of an episode
OF_AGENTS = (
    "agent",
    "task",
    "episodes in all, median",
    "solved at the end",
    "seeds that came to 90 %",
    "episodes until 90 %, median of these seeds",
)
KEYS = ("world", "agents", "seed")
COLUMNS = (*KEYS, "agent", "task", "step", "episodes", "solved", "episodes_to_90")


def numbers_of(succeeded: Sequence[bool] | np.ndarray) -> Row:
    """How many episodes there were, the share solved of the last ones, and after how many that is enough."""
    solved = np.asarray(succeeded, float)
    row: Row = {"step": 0, "episodes": len(solved), "solved": float(solved[-WINDOW:].mean()), "episodes_to_90": ""}
    if len(solved) >= WINDOW:
        recent = np.convolve(solved, np.ones(WINDOW) / WINDOW, "valid")
        if (recent >= ENOUGH).any():
            row["episodes_to_90"] = int(np.argmax(recent >= ENOUGH)) + WINDOW
    return row


def learned(folder: Path, world: str, seed: int) -> list[Row]:
    """An agent for each feature over options that learn."""
    torch.set_num_threads(1)
    rows = []
    first, *_, last = levels(seed, "new", LEVELS["new"])
    with TemporaryDirectory() as name:
        ensemble = Path(name) / "ensemble"
        data = data_of(folder, world, "independent", seed)
        hypogoal.train_ensemble(data, ensemble, seed=seed, workers=1, quiet=True, **METHODS["independent"])
        for feature in FEATURES:
            out = Path(name) / feature
            where: dict[str, Any] = {"world": (f"task={feature}",), "layouts": f"{first}-{last}"}
            hypogoal.train_meta(ensemble, out, seed=seed, quiet=True, steps=OPTION_STEPS, **where, **OPTIONS)
            row = numbers_of(Episodes.read(out / Episodes.FILE).succeeded)
            rows.append({"world": world, "agents": LEARNED, "seed": seed, "agent": LEARNED, "task": feature, **row})
    return rows


def baselines(_: Path, world: str, seed: int) -> list[Row]:
    """PPO in labelled levels and in new ones."""
    from hypogoal.baselines.agents import make_agent
    from hypogoal.baselines.engine_env import EngineEnv
    from hypogoal.baselines.settings import HYPERPARAMETERS

    torch.set_num_threads(1)
    settings = HYPERPARAMETERS["ppo", "tuned"]
    domain = load_domain(WORLDS[world])

    def env_of(task: str, seeds: Sequence[int]) -> EngineEnv:
        layouts = Layouts(seeds, rng_for(seed, "levels", task))
        engine = domain.make_engine(seeds[0], settings.environments, CAP, layouts=layouts, task=task)
        return EngineEnv(engine)

    def look(agent: Any, task: str, seeds: Sequence[int]) -> Row:
        env = env_of(task, seeds)
        seen = env.reset()
        while len(env.episodes.rows) < LOOKED_AT:
            actions, _state = agent.predict(seen)
            env.step_async(actions)
            seen, *_rest = env.step_wait()
        return numbers_of([bool(episode.succeeded) for episode in env.episodes.rows])

    def learn(agent: Any) -> Row:
        agent.learn(PPO_STEPS, log_interval=None)
        return numbers_of([bool(episode.succeeded) for episode in agent.env.episodes.rows])

    new, own = levels(seed, "new", LEVELS["new"]), levels(seed, LABELLED, LEVELS[LABELLED])
    unseen = tuple(range(own[-1] + 1, own[-1] + 1 + LEVELS["new"]))
    rows: list[Row] = []

    def keep(agent: str, task: str, row: Row) -> None:
        rows.append({"world": world, "agents": PPO, "seed": seed, "agent": agent, "task": task, **row})

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        trained = make_agent(env_of(LABELLED, own), settings, seed)
        keep(SEEN, LABELLED, learn(trained))
        weights = {name: value.clone() for name, value in trained.policy.state_dict().items()}
        keep(UNSEEN, LABELLED, look(trained, LABELLED, unseen))
        for feature in FEATURES:
            keep(NEW, feature, look(trained, feature, new))
            for name in (TUNED, SCRATCH):
                agent = make_agent(env_of(feature, new), settings, seed)
                if name == TUNED:
                    agent.policy.load_state_dict(weights)
                keep(name, feature, learn(agent))
    return rows


def tables(path: Path) -> Iterator[str]:
    """What the rows say, as lines of Markdown: a table for each world."""
    rows = read_rows(path)
    for world in WORLDS:
        shown = []
        for agent, task in product(AGENTS, (LABELLED, *FEATURES)):
            own = [row for row in rows if (row["world"], row["agent"], row["task"]) == (world, agent, task)]
            if not own:
                continue
            arrived = [int(row["episodes_to_90"]) for row in own if row["episodes_to_90"]]
            episodes = np.array([int(row["episodes"]) for row in own])
            solved = share(np.array([float(row["solved"]) for row in own]))
            to_90 = f"{np.median(arrived):,.0f}" if 2 * len(arrived) > len(own) else "never"
            is_look = agent in (UNSEEN, NEW)
            reached = ["-", "-"] if is_look else [f"{len(arrived)} of {len(own)}", to_90]
            shown.append([TITLES[agent], task, f"{np.median(episodes):,.0f}", solved, *reached])
        yield ""
        yield from table(OF_AGENTS, shown)


def main() -> None:
    """Run the cells that are missing."""
    parser = parser_of(__doc__, "100-109", run="the folder of collected states; made where there is none")
    arguments = parser.parse_args()
    if printed(arguments, tables):
        return
    arguments.run.mkdir(parents=True, exist_ok=True)
    jobs: Jobs = {}
    for (name, job), seed, world in product(((LEARNED, learned), (PPO, baselines)), arguments.seeds, WORLDS):
        jobs[world, name, str(seed)] = partial(job, arguments.run, world, seed)
    run_cells(arguments.csv, COLUMNS, KEYS, jobs, lambda _: [0], arguments.workers)


if __name__ == "__main__":
    main()
