"""A random search for the tuned settings of PPO and DQN on three-key DoorKey, and for the size of PPO's bonus.

    python -m studies.tuning docs/results/tuning-baselines.csv

``TRIALS`` settings of each agent, number 0 the one that was tuned by hand, the others drawn from ``SPACE``, are tried
for ``SHORT`` steps on each of ``LAYOUTS``; the best ``FINALISTS`` and number 0 for ``LONG`` steps, with another seed.
The best of these by ``rank`` is what ``HYPERPARAMETERS`` calls tuned. With PPO's, ``BONUSES`` are tried for ``LONG``
steps. A trial's rows, one a layout, are appended as soon as it ends; what is there is not run again. ``--tables`` draws
them.
"""

from __future__ import annotations

import dataclasses
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import partial
from pathlib import Path

import numpy as np

from hypogoal.core.artefacts import Artefact, open_artefact
from hypogoal.core.compute import prepare
from hypogoal.core.config import as_dict
from hypogoal.core.seeding import rng_for
from hypogoal.domains.doorkey import DOMAIN, DoorKeyConfig
from hypogoal.hypotheses.config import TrainEnsembleConfig
from hypogoal.learners.baselines.agents import train
from hypogoal.learners.baselines.engine_env import Bonus, EngineEnv
from hypogoal.learners.baselines.settings import DQNSettings, PPOSettings
from hypogoal.meta.training import judged
from hypogoal.stages.train_ensemble import train_ensemble
from studies.cells import Jobs, Row, collect_once, parser_of, printed, read_rows, run_cells, table

Settings = PPOSettings | DQNSettings
Draw = Callable[[np.random.Generator], float | int | str]

LAYOUTS = (400, 401, 402)  # nothing else is learned or tested there
TRIALS, FINALISTS = 30, 3
SHORT, LONG = 60_000, 150_000  # environment steps on each layout
SEEDS = {SHORT: 4000, LONG: 4001}
EPISODE = 500  # steps at most, as in Figure 6
KEYS = ("agent", "trial", "step")
COLUMNS = (*KEYS, "layout", "settings", "episodes", "solved", "first", "seconds")
AGENTS = {"ppo": "PPO", "dqn": "DQN"}
BONUSES = (0.02, 0.05, 0.1, 0.2)
BONUS = "ppo-bonus"  # the agent's name in the file; the trial is the bonus' place in BONUSES
# Number 0: what was called tuned before there was a search.
BY_HAND: dict[str, Settings] = {
    "ppo": PPOSettings(
        network="cells", environments=32, rollout=512, batch=128, epochs=6, learning_rate=5e-4, gae_lambda=0.95
    ),
    "dqn": DQNSettings(
        network="cells",
        environments=32,
        batch=128,
        learning_rate=5e-4,
        target_interval=1,
        target_tau=0.01,
        epsilon_from="first-goal",
        epsilon_final=0.05,
    ),
}


def one_of(*values: float | int | str) -> Draw:
    """Each as likely as the others."""
    return lambda rng: values[int(rng.integers(len(values)))]


def between(low: float, high: float) -> Draw:
    """Log-uniform, to two digits."""
    return lambda rng: float(f"{np.exp(rng.uniform(np.log(low), np.log(high))):.1e}")


# What is not named stays as in number 0.
SPACE: dict[str, Mapping[str, Draw]] = {
    "ppo": {
        "learning_rate": between(1e-4, 2e-3),
        "entropy": between(1e-3, 1e-1),
        "gamma": one_of(0.95, 0.97, 0.98, 0.99, 0.995),
        "gae_lambda": one_of(0.9, 0.95, 0.97, 0.99),
        "environments": one_of(16, 32, 64),
        "rollout": one_of(8, 16, 32),  # times the environments
        "epochs": one_of(3, 4, 6, 8),
        "batch": one_of(64, 128, 256),
        "clip": one_of(0.1, 0.2, 0.3),
    },
    "dqn": {
        "learning_rate": between(1e-4, 2e-3),
        "gamma": one_of(0.9, 0.95, 0.97, 0.99),
        "batch": one_of(32, 64, 128),
        "target_tau": one_of(0.005, 0.01, 0.02, 0.05),
        "epsilon_from": one_of("start", "first-goal"),
        "epsilon_steps": one_of(8_000, 16_000, 32_000, 64_000, 128_000),
        "epsilon_final": one_of(0.01, 0.02, 0.05, 0.1),
        "environments": one_of(16, 32, 64),
    },
}


def settings_of(agent: str, trial: int) -> Settings:
    """The settings of a trial, by its number alone."""
    if not trial:
        return BY_HAND[agent]
    rng = rng_for(trial, "tuning", agent)
    drawn = {name: draw(rng) for name, draw in SPACE[agent].items()}
    if "rollout" in drawn:
        drawn["rollout"] = int(drawn["rollout"]) * int(drawn["environments"])
        drawn["batch"] = min(int(drawn["batch"]), drawn["rollout"])
    return dataclasses.replace(BY_HAND[agent], **drawn)  # type: ignore[arg-type]


def text_of(agent: str, settings: Settings) -> str:
    """The settings that are searched for, as ``name=value`` with spaces between."""
    return " ".join(f"{name}={as_dict(settings)[name]}" for name in SPACE[agent])


def run_trial(agent: str, trial: int, steps: int) -> list[Row]:
    """Train on each layout; what the training episodes were like."""
    chosen = settings_of(agent, trial)
    columns = {"agent": agent, "trial": trial, "step": steps, "settings": text_of(agent, chosen)}
    return tried(chosen, steps, columns)


def run_bonus(trial: int, chosen: Settings, work: Path) -> list[Row]:
    """PPO with its best setting and a bonus for each member's first positive prediction."""
    columns = {"agent": BONUS, "trial": trial, "step": LONG, "settings": f"bonus={BONUSES[trial]}"}
    ensemble = work / "ensemble"
    if not ensemble.exists():
        # Nobody looks at the held-out layouts.
        collect_once(DOMAIN, DoorKeyConfig(heldout_layouts=1), work / "data.h5")
        config = TrainEnsembleConfig(diversity="dbat", members=3, workers=1)
        train_ensemble(work / "data.h5", config, ensemble, seed=4000, quiet=True)
    return tried(chosen, LONG, columns, BONUSES[trial], open_artefact(ensemble, "ensemble"))


def tried(
    chosen: Settings, steps: int, columns: Row, bonus: float = 0.0, ensemble: Artefact | None = None
) -> list[Row]:
    """A row of each layout: ``about``, and what training there was like."""
    prepare()
    rows = []
    for layout in LAYOUTS:
        begun = time.process_time()
        engine = DOMAIN.make_engine(layout, chosen.environments, EPISODE)
        paid = None
        if ensemble:
            members = judged(engine, ensemble.path, ensemble.config, "cpu")
            paid = Bonus(members.of, members.options, engine.count, bonus, members)
        env = EngineEnv(engine, paid)
        train(env, chosen, steps, SEEDS[steps])
        rows.append(
            {**columns, "layout": layout, **training_numbers(env, steps), "seconds": time.process_time() - begun}
        )
    return rows


def training_numbers(env: EngineEnv, steps: int) -> Row:
    """The share of all episodes that were solved, and the step of the first; where none was, the last step."""
    solved = [bool(row[4]) for row in env.episodes]
    first = next((row[0] for row in env.episodes if row[4]), steps)
    return {"episodes": len(solved), "solved": float(np.mean(solved)), "first": min(first, steps)}


Found = dict[tuple[str, int], dict[int, list[dict[str, str]]]]  # by agent and step; by trial its rows


def read(path: Path) -> Found:
    """The trials there are."""
    search: Found = {}
    for row in read_rows(path):
        search.setdefault((row["agent"], int(row["step"])), {}).setdefault(int(row["trial"]), []).append(row)
    return search


def mean(rows: list[dict[str, str]], name: str) -> float:
    """Of a trial, over its layouts."""
    return float(np.mean([float(row[name]) for row in rows]))


def rank(trials: Mapping[int, list[dict[str, str]]]) -> list[int]:
    """The rule: by the share of episodes solved, mean over layouts; ties by the mean step of the first success."""
    return sorted(trials, key=lambda trial: (-mean(trials[trial], "solved"), mean(trials[trial], "first"), trial))


def finalists(search: Found, agent: str) -> list[int]:
    """The best of the short trials, and number 0."""
    return sorted({0, *rank(search[agent, SHORT])[:FINALISTS]})


def over(search: Found, agent: str) -> bool:
    """Whether the search for an agent's settings came to its end."""
    short = len(search.get((agent, SHORT), {})) >= TRIALS
    return short and search.get((agent, LONG), {}).keys() >= set(finalists(search, agent))


def best(search: Found, agent: str) -> int:
    """The trial that is called tuned: the one by hand until the search is over."""
    return rank(search[agent, LONG])[0] if over(search, agent) else 0


def best_bonus(search: Found) -> float:
    """What Figure 6 pays."""
    return BONUSES[rank(search[BONUS, LONG])[0]]


def tables(path: Path) -> Iterator[str]:
    """What the rows say, as lines of Markdown."""
    search = read(path)
    where = f"{SHORT:,} steps on each of {len(LAYOUTS)} layouts"
    yield f"Short trials, {where}: share of episodes solved, mean over layouts."
    yield ""
    yield from table(
        ["", "trials", "some success", "best", "median", "by hand (0)", "core minutes, long ones too"],
        (_round(search, agent) for agent in AGENTS if (agent, SHORT) in search),
    )
    for agent in AGENTS:
        if not over(search, agent):
            continue
        long = search[agent, LONG]
        yield f"{AGENTS[agent]}, {LONG:,} steps, the best first."
        yield ""
        yield from table(
            ["trial", "place in short trials", "solved", "layout by layout", "first success, mean", "settings"],
            (
                [
                    f"{trial} (by hand)" if not trial else str(trial),
                    str(1 + rank(search[agent, SHORT]).index(trial)),
                    *_numbers(long[trial]),
                    long[trial][0]["settings"],
                ]
                for trial in rank(long)
            ),
        )
    if (BONUS, LONG) not in search:
        return
    none = best(search, "ppo")
    paid = [("none", search["ppo", LONG][none])]
    paid += [(str(BONUSES[trial]), rows) for trial, rows in sorted(search[BONUS, LONG].items())]
    yield f"PPO's best setting (trial {none}), {LONG:,} steps, a bonus for each member's first positive in an episode."
    yield ""
    yield from table(
        ["bonus", "solved", "layout by layout", "first success, mean"],
        ([name, *_numbers(rows)] for name, rows in paid),
    )


def _round(search: Found, agent: str) -> list[str]:
    trials = search[agent, SHORT]
    scores = {trial: mean(rows, "solved") for trial, rows in trials.items()}
    seconds = sum(
        float(row["seconds"])
        for step in (SHORT, LONG)
        for rows in search.get((agent, step), {}).values()
        for row in rows
    )
    some = sum(score > 0 for score in scores.values())
    shown = (max(scores.values()), float(np.median(list(scores.values()))), scores[0])
    return [AGENTS[agent], str(len(trials)), str(some), *(f"{score:.3f}" for score in shown), f"{seconds / 60:.0f}"]


def _numbers(rows: list[dict[str, str]]) -> list[str]:
    """Share solved, the same layout by layout, and the mean step of the first success."""
    places = " ".join(f"{float(row['solved']):.3f}" for row in rows)
    return [f"{mean(rows, 'solved'):.3f}", places, f"{mean(rows, 'first'):,.0f}"]


def trials(agent: str, numbers: Iterable[int], steps: int) -> Jobs:
    """What makes the rows of each of these trials."""
    return {(agent, str(trial), str(steps)): partial(run_trial, agent, trial, steps) for trial in numbers}


def main() -> None:
    """Run the trials that are not in the file yet."""
    arguments = parser_of(__doc__, "0").parse_args()
    if printed(arguments, tables):
        return

    def run(jobs: Jobs) -> None:
        run_cells(arguments.csv, COLUMNS, KEYS, jobs, lambda cell: (int(cell[2]),), arguments.workers)

    def search(agent: str) -> None:
        run(trials(agent, range(TRIALS), SHORT))
        run(trials(agent, finalists(read(arguments.csv), agent), LONG))

    search("ppo")
    chosen = settings_of("ppo", best(read(arguments.csv), "ppo"))
    with tempfile.TemporaryDirectory() as work:
        sizes = range(len(BONUSES))
        run({(BONUS, str(trial), str(LONG)): partial(run_bonus, trial, chosen, Path(work)) for trial in sizes})
    search("dqn")


if __name__ == "__main__":
    main()
