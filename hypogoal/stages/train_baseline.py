"""Spec A7, E7: train a comparison agent with the primitive actions: stable-baselines3's PPO or DQN."""

from __future__ import annotations

import dataclasses
import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hypogoal.core.artefacts import claim, create_artefact
from hypogoal.core.checkpoints import checkpoints_of
from hypogoal.core.compute import prepare
from hypogoal.core.config import as_dict, setting
from hypogoal.core.files import write_table
from hypogoal.core.preflight import preflight
from hypogoal.core.progress import MetricsLog, Progress
from hypogoal.core.seeding import rng_for
from hypogoal.core.tensors import save_tensors
from hypogoal.domains.base import Domain, load_domain
from hypogoal.needs import baseline_needs
from hypogoal.options.recording import EPISODE_COLUMNS

LOG_INTERVAL = 5_000  # environment steps


@dataclass(frozen=True)
class BaselineConfig:
    """Which agent, on which layout, for how long; ``learners/baselines/settings.py`` has the hyperparameters."""

    agent: str = setting("ppo", "the algorithm", source="Spec E7", choices=("ppo", "dqn"))
    steps: int = setting(
        300_000, "environment steps, all environments together", unit="steps", source="paper: 1.5e6", low=1
    )
    layout_seed: int = setting(100, "the layout to learn on", source="Spec E4", low=0)
    environments: int = setting(0, "environments stepped together; 0 for the setting's own", low=0, high=4096)
    max_episode_steps: int = setting(500, "an episode is cut after this many steps", unit="steps", source="B1", low=1)
    keyring: bool = setting(True, "several keys can be held", source="Spec B1")
    random_episodes: int = setting(200, "episodes of random play that say how hard the layout is", source="F5", low=0)
    # Last, because from here on the name means this field.
    setting: str = setting(
        "tuned", "hyperparameters: the paper's tables, or tuned ones", source="Spec E7", choices=("paper", "tuned")
    )


def train_baseline(
    domain: str,
    config: BaselineConfig,
    out: Path,
    *,
    seed: int = 0,
    force: bool = False,
    resume: bool = False,
    quiet: bool = False,
    device: str = "auto",
) -> dict[str, Any]:
    """Train the agent and write the artefact ``out``.

    Args:
        domain: doorkey, or module:object.
        config: see :class:`BaselineConfig`.
        out: the artefact to write: episodes.csv, layout.json, metrics.jsonl, policy.safetensors.
        seed, force, resume, quiet, device: as for every stage.

    Returns:
        Steps, episodes, and success and length over the last 100 episodes.

    Raises:
        UserError: unknown domain or device, or ``out`` exists.
        NumericalError: NaN or Inf in a weight.
    """
    from hypogoal.learners.baselines.agents import train, weights
    from hypogoal.learners.baselines.engine_env import EngineEnv
    from hypogoal.learners.baselines.settings import hyperparameters

    device = prepare(device)
    out = claim(out, kind="baseline", force=force, resume=resume)
    played = load_domain(domain, given=True)
    chosen = hyperparameters(config.agent, config.setting)
    if config.environments:
        chosen = dataclasses.replace(chosen, environments=config.environments)
    engine = _make_engine(played, config, chosen.environments)
    env = EngineEnv(engine)
    size = math.prod(env.observation_space.shape or (1,))
    preflight("train-baseline", out, baseline_needs(size, getattr(chosen, "replay", 0)), resume=resume, quiet=quiet)
    about = as_dict(config) | {
        "domain": domain,
        "environments": chosen.environments,
        "hyperparameters": as_dict(chosen),
    }
    with create_artefact(out, kind="baseline", config=about, seed=seed, force=force, resume=resume) as folder:
        checkpoints = checkpoints_of(folder)
        with Progress("train-baseline", total=config.steps, quiet=quiet) as progress:
            report = _Report(MetricsLog(folder / "metrics.jsonl"), progress)
            if not checkpoints.saved:
                report.log.restore(0)
            agent = train(env, chosen, config.steps, seed, report, LOG_INTERVAL, checkpoints, device)
            progress.update(config.steps)
        report.log.close()
        write_table(folder / "episodes.csv", EPISODE_COLUMNS, env.episodes)
        save_tensors(folder / "policy.safetensors", weights(agent))
        random_success = _random_success(engine, config, seed)
        facts = {
            "layout_seed": config.layout_seed,
            "shortest_path": engine.shortest_path() if hasattr(engine, "shortest_path") else None,
            "random_success": random_success,
            "random_episodes": 0 if random_success is None else config.random_episodes,
        }
        (folder / "layout.json").write_text(json.dumps(facts) + "\n", encoding="utf-8")
    last = env.episodes[-100:]
    mean_length = sum(row[1] for row in last) / len(last) if last else float("nan")
    return {"steps": env.steps, "episodes": len(env.episodes), "success": env.success(), "length": mean_length}


class _Report:
    """Tells the log and the progress."""

    def __init__(self, log: MetricsLog, progress: Progress):
        self.log, self.progress = log, progress

    def __call__(self, step: int, numbers: dict[str, float]) -> None:
        self.log.write(step=step, **numbers)
        self.progress.update(min(step, self.progress.total), success=numbers["success"])

    def snapshot(self) -> dict[str, int]:
        return {"log": self.log.snapshot(), "done": self.progress.done}

    def restore(self, snapshot: dict[str, int]) -> None:
        self.log.restore(snapshot["log"])
        self.progress.resume(snapshot["done"])


def _make_engine(domain: Domain, config: BaselineConfig, count: int) -> Any:
    fields = {field.name for field in dataclasses.fields(domain.config_class)}
    extra = {"keyring": config.keyring} if "keyring" in fields else {}
    return domain.make_engine(config.layout_seed, count, config.max_episode_steps, **extra)


def _random_success(engine: Any, config: BaselineConfig, seed: int) -> float | None:
    if not config.random_episodes or not hasattr(engine, "random_success"):
        return None
    return float(engine.random_success(config.random_episodes, rng_for(seed, "random-play")))
