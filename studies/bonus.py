"""Figure 6's agent with the same knowledge and no options: PPO is paid for what an ensemble's members know.

Each of the sweep's D-BAT ensembles pays a fresh agent on the layout that goes with its seed. Rows that are there stay.

python -m studies.bonus runs/figure6 docs/results/figure6-doorkey.csv
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from examples.figure6 import PLAYED, STEPS, TRAINED
from hypogoal.baselines.agents import train
from hypogoal.baselines.engine_env import EngineEnv
from hypogoal.baselines.settings import HYPERPARAMETERS, BaselineConfig
from hypogoal.core.artefacts import Artefact, open_artefact
from hypogoal.core.checkpoints import Checkpoints
from hypogoal.core.processes import prepare
from hypogoal.core.progress import MetricsLog, Progress
from hypogoal.domains.base import Engine, Step
from hypogoal.domains.doorkey.domain import DOMAIN
from hypogoal.domains.episodes import EpisodeRecorder
from hypogoal.meta.config import TrainMetaConfig
from hypogoal.meta.setup import Setup, of_ensemble
from hypogoal.options.tables import Episodes
from hypogoal.options.termination import Terminations
from studies.figure6 import Run, read_agents, rows_of, training_numbers, write_agents

BONUS = 0.2  # the best of .02, .05, .1 and .2 on three other layouts
METHOD = "ppo-bonus"


class LastStep(EpisodeRecorder):
    """Also keeps the states, int64 (E,), that the last step arrived in."""

    arrived: NDArray[np.int64]

    def see(self, step: Step) -> None:
        super().see(step)
        self.arrived = step.next_ids


class PaidEnv(EngineEnv):
    """Pays ``BONUS`` for a member's first positive prediction in an episode, on top of the reward.

    The state in which an episode begins is not judged, the one in which it ends is.
    """

    def __init__(self, engine: Engine, members: Terminations):
        super().__init__(engine)
        self.members = members
        self.episodes: LastStep = LastStep(engine.count)
        self.fired = np.zeros((engine.count, members.options), dtype=np.bool_)  # in the running episodes

    def reset(self) -> Any:
        """Put every environment at the start of an episode."""
        self.fired[:] = False
        return super().reset()

    def step_wait(self) -> Any:
        """Step every environment, and pay."""
        observations, rewards, done, infos = super().step_wait()
        positive = self.members.of(self.episodes.arrived)
        first = (positive & ~self.fired).sum(axis=1)
        self.fired |= positive
        self.fired[done] = False
        return observations, rewards + (BONUS * first).astype(np.float32), done, infos


def paid(ensemble: Artefact, layout: int, steps: int) -> Run:
    """PPO in its tuned setting, with the ensemble's seed, in the world of the ensemble's states."""
    device = prepare("cpu")
    chosen = HYPERPARAMETERS["ppo", "tuned"]
    world = DOMAIN.world(ensemble.config["domain_config"])
    engine = DOMAIN.make_engine(layout, chosen.environments, BaselineConfig.max_episode_steps, **world)
    setup = Setup(DOMAIN, ensemble.config, ensemble.path, TrainMetaConfig.of(), ensemble.seed, device)
    env = PaidEnv(engine, of_ensemble(setup, engine))
    with tempfile.TemporaryDirectory() as folder:
        log, progress = MetricsLog(Path(folder) / "metrics.jsonl"), Progress("", steps, quiet=True)
        train(env, chosen, steps, ensemble.seed, log, progress, Checkpoints(None))
    place = {"layout_seed": layout, "shortest_path": engine.shortest_path()}
    return Run(ensemble.seed, {"steps": steps}, Episodes.of_rows(env.episodes.rows), place)


def main() -> None:
    """Train those that are missing; ``studies.figure6`` prints the tables."""
    parser = argparse.ArgumentParser(description="PPO that is paid for what an ensemble's members know.")
    parser.add_argument("run", type=Path, help="the folder of the sweep")
    parser.add_argument("csv", type=Path, help="the file of all agents' numbers")
    arguments = parser.parse_args()
    agents = read_agents(arguments.csv)
    for layout, seed in zip(PLAYED, TRAINED, strict=True):
        agent = (METHOD, str(layout))
        if agent in agents:
            continue
        ensemble = open_artefact(arguments.run / f"ensemble/method-dbat-k3-seed-{seed}", "ensemble")
        run = paid(ensemble, layout, STEPS)
        agents[agent] = rows_of(METHOD, run, training_numbers(run))
        write_agents(arguments.csv, agents)


if __name__ == "__main__":
    main()
