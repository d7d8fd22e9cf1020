"""Spec A7, E7: train a comparison agent with the primitive actions: stable-baselines3's PPO or DQN."""

import dataclasses
from pathlib import Path
from typing import Any

from hypogoal.core.config import as_dict
from hypogoal.core.errors import UserError
from hypogoal.core.processes import prepare
from hypogoal.core.tensors import save_tensors
from hypogoal.core.training import training
from hypogoal.data import open_dataset
from hypogoal.domains.base import load_domain, require_one_kind
from hypogoal.learners.baselines.settings import HYPERPARAMETERS, BaselineConfig
from hypogoal.meta.training import check_start, cut, played_world, write_layout
from hypogoal.observations import PICTURE, standard_of
from hypogoal.options.tables import Episodes


def train_baseline(
    domain: str,
    config: BaselineConfig,
    out: Path,
    *,
    data: Path | None = None,
    seed: int = 0,
    force: bool = False,
    resume: bool = False,
    quiet: bool = False,
    device: str = "auto",
    tensorboard: Path | None = None,
) -> dict[str, Any]:
    """Train the agent and write the artefact ``out``: episodes.csv, layout.json, metrics.jsonl, policy.safetensors.

    With ``data``, states of the domain, it plays in the world they are of; else in that of the domain's defaults.
    ``tensorboard``, a folder, gets the numbers of the log.
    Returns steps, episodes, and success and length over the last 100 episodes. An unknown domain or device, states of
    another domain, or an ``out`` that exists is a ``UserError``, NaN or Inf in a weight a ``NumericalError``.
    """
    from hypogoal.learners.baselines.agents import train, weights
    from hypogoal.learners.baselines.engine_env import EngineEnv

    device = prepare(device)
    inputs = [data] if data else []
    played = load_domain(domain)
    lived: dict[str, Any] = {}
    if data:
        dataset = open_dataset(data)
        if dataset.domain != domain:
            fault = f"these are states of {dataset.domain!r}, not of {domain!r}"
            raise UserError(fault, data, "Name their domain.")
        lived = played.world(dataset.config)
    world = played_world(played, lived, config.world)
    begins: dict[str, str] = {}
    if config.start:
        check_start(played, config.start)
        begins = {"start": config.start}
    chosen = HYPERPARAMETERS[config.agent, config.setting]
    if config.environments:
        chosen = dataclasses.replace(chosen, environments=config.environments)
    engine = played.make_engine(config.layout_seed, chosen.environments, config.max_episode_steps, **world, **begins)
    cut(engine, config.cap)
    require_one_kind(engine)
    if data and engine.observation_dtype != PICTURE:
        engine.standard = standard_of(engine.observation_shape, open_dataset(data).unlabelled())
    settings = as_dict(config) | {"domain": domain, "domain_config": world}
    settings |= {"environments": chosen.environments, "hyperparameters": as_dict(chosen)}
    artefact: dict[str, Any] = {"kind": "baseline", "config": settings, "seed": seed, "inputs": inputs, "force": force}
    how: dict[str, Any] = {"steps": config.steps, "quiet": quiet, "resume": resume, "tensorboard": tensorboard}
    with training("train-baseline", out, **how, **artefact) as work:
        env = EngineEnv(engine)
        agent = train(env, chosen, config.steps, seed, work.log, work.progress, work.checkpoints, device)
        work.progress.update(config.steps)
        Episodes.of_rows(env.episodes).write(work.folder)
        save_tensors(work.folder / "policy.safetensors", weights(agent))
        write_layout(work.folder, engine, config.layout_seed, config.random_episodes, seed, **begins)
    return env.episodes.counts() | env.episodes.recent()
