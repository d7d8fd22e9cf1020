"""Spec A7, E7: train a comparison agent with the primitive actions: stable-baselines3's PPO or DQN."""

import dataclasses
from pathlib import Path
from typing import Any

from hypogoal.cards import create_artefact
from hypogoal.core.artefacts import claim
from hypogoal.core.checkpoints import checkpoints_of
from hypogoal.core.compute import prepare
from hypogoal.core.config import as_dict
from hypogoal.core.errors import UserError
from hypogoal.core.preflight import preflight
from hypogoal.core.progress import MetricsLog, Progress
from hypogoal.core.tensors import save_tensors
from hypogoal.dataset import PICTURE, open_dataset, standard_of
from hypogoal.domains.base import load_domain
from hypogoal.learners.baselines.settings import HYPERPARAMETERS, BaselineConfig, DQNSettings
from hypogoal.meta.training import cut, played_world, write_layout
from hypogoal.needs import baseline_needs


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
) -> dict[str, Any]:
    """Train the agent and write the artefact ``out``: episodes.csv, layout.json, metrics.jsonl, policy.safetensors.

    With ``data``, states of the domain, it plays in the world they are of, else in that of the domain's defaults.
    Returns steps, episodes, and success and length over the last 100 episodes. An unknown domain or device, states of
    another domain, or an ``out`` that exists is a ``UserError``, NaN or Inf in a weight a ``NumericalError``.
    """
    from hypogoal.learners.baselines.agents import train, weights
    from hypogoal.learners.baselines.engine_env import EngineEnv

    device = prepare(device)
    inputs = [data] if data else []
    out = claim(out, kind="baseline", inputs=inputs, force=force, resume=resume)
    played = load_domain(domain, given=True)
    lived: dict[str, Any] = {}
    if data:
        dataset = open_dataset(data)
        if dataset.domain != domain:
            what = f"these are states of {dataset.domain!r}, not of {domain!r}"
            raise UserError(what, data, "Name the domain they are of.")
        lived = played.world(dataset.config)
    world = played_world(played, lived, config.world)
    chosen = HYPERPARAMETERS[config.agent, config.setting]
    if config.environments:
        chosen = dataclasses.replace(chosen, environments=config.environments)
    engine = played.make_engine(config.layout_seed, chosen.environments, config.max_episode_steps, **world)
    cut(engine, config.cap)
    if data and engine.observation_dtype != PICTURE:
        engine.standard = standard_of(engine.observation_shape, open_dataset(data).unlabelled())
    env = EngineEnv(engine)
    size = env.observation_space.sample().nbytes
    replay = chosen.replay if isinstance(chosen, DQNSettings) else 0
    preflight("train-baseline", out, baseline_needs(size, replay), resume=resume, quiet=quiet)
    about = as_dict(config) | {"domain": domain, "domain_config": world}
    about |= {"environments": chosen.environments, "hyperparameters": as_dict(chosen)}
    with create_artefact(
        out, kind="baseline", config=about, seed=seed, inputs=inputs, force=force, resume=resume
    ) as folder:
        with Progress("train-baseline", total=config.steps, quiet=quiet) as progress:
            log = MetricsLog(folder / "metrics.jsonl")
            agent = train(env, chosen, config.steps, seed, log, progress, checkpoints_of(folder), device)
            progress.update(config.steps)
        env.episodes.write(folder)
        save_tensors(folder / "policy.safetensors", weights(agent))
        write_layout(folder, engine, config.layout_seed, config.random_episodes, seed)
    episodes = env.episodes
    success = episodes.success() if episodes else 0.0
    return {"steps": episodes.steps, "episodes": len(episodes), "success": success, "length": episodes.length()}
