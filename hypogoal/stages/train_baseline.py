"""Spec A7, E7: train a comparison agent with the primitive actions: stable-baselines3's PPO or DQN."""

import dataclasses
from pathlib import Path
from typing import Any

from hypogoal.core.artefacts import claim, open_artefact
from hypogoal.core.compute import prepare
from hypogoal.core.config import as_dict
from hypogoal.core.errors import UserError
from hypogoal.core.tensors import save_tensors
from hypogoal.core.training import training
from hypogoal.dataset import PICTURE, open_dataset, standard_of
from hypogoal.domains.base import load_domain, require_one_kind
from hypogoal.learners.baselines.settings import HYPERPARAMETERS, BaselineConfig
from hypogoal.meta.training import check_start, cut, judged, played_world, write_layout
from hypogoal.needs import baseline_needs, judging_member
from hypogoal.options.tables import Episodes


def train_baseline(
    domain: str,
    config: BaselineConfig,
    out: Path,
    *,
    data: Path | None = None,
    ensemble: Path | None = None,
    seed: int = 0,
    force: bool = False,
    resume: bool = False,
    quiet: bool = False,
    device: str = "auto",
    tensorboard: Path | None = None,
) -> dict[str, Any]:
    """Train the agent and write the artefact ``out``: episodes.csv, layout.json, metrics.jsonl, policy.safetensors.

    With ``data``, states of the domain, it plays in the world they are of; without, in that of the ``ensemble``, whose
    members' positive predictions earn the bonus; else in that of the domain's defaults.
    ``tensorboard``, a folder, gets the numbers of the log.
    Returns steps, episodes, and success and length over the last 100 episodes. An unknown domain or device, states or
    an ensemble of another domain, a bonus without an ensemble or the other way round, or an ``out`` that exists is a
    ``UserError``, NaN or Inf in a weight a ``NumericalError``.
    """
    from hypogoal.learners.baselines.agents import train, weights
    from hypogoal.learners.baselines.engine_env import Bonus, EngineEnv

    device = prepare(device)
    if ensemble and not config.bonus:
        raise UserError("an ensemble without a bonus changes nothing", ensemble, "Give --set bonus=0.1 too.")
    if config.bonus and not ensemble:
        fault = "a bonus is paid where an ensemble's members are positive"
        raise UserError(fault, f"bonus={config.bonus:g}", "Give --ensemble too, or leave bonus out.")
    taught = open_artefact(ensemble, "ensemble").whole() if ensemble else None
    if taught and taught.config["domain"] != domain:
        fault = f"this ensemble is for {taught.config['domain']!r}, not for {domain!r}"
        raise UserError(fault, taught.path, "Name its domain.")
    inputs = [path for path in (data, ensemble) if path]
    out = claim(out, kind="baseline", inputs=inputs, force=force, resume=resume)
    played = load_domain(domain, by_user=True)
    lived: dict[str, Any] = played.world(taught.config["domain_config"]) if taught else {}
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
    judges = 0.0
    if taught:
        members = len(taught.config["sub_goals"]) * taught.config["members"]
        judges = members * judging_member(taught.config["network"], engine.observation_shape, engine.observation_dtype)
    size = EngineEnv(engine).observation_space.sample().nbytes
    needs = baseline_needs(size, played.played_bytes(config.steps, 0), config.steps, chosen, judges)
    settings = as_dict(config) | {"domain": domain, "domain_config": world}
    settings |= {"environments": chosen.environments, "hyperparameters": as_dict(chosen)}
    artefact: dict[str, Any] = {"kind": "baseline", "config": settings, "seed": seed, "inputs": inputs, "force": force}
    how: dict[str, Any] = {"steps": config.steps, "quiet": quiet, "resume": resume, "tensorboard": tensorboard}
    with training("train-baseline", out, needs, **how, **artefact) as work:
        bonus = None
        if taught:
            terminations = judged(engine, taught.path, taught.config, device)
            bonus = Bonus(terminations.of, terminations.options, engine.count, config.bonus, terminations)
        env = EngineEnv(engine, bonus)
        agent = train(env, chosen, config.steps, seed, work.log, work.progress, work.checkpoints, device)
        work.progress.update(config.steps)
        Episodes.of_rows(env.episodes).write(work.folder)
        save_tensors(work.folder / "policy.safetensors", weights(agent))
        write_layout(work.folder, engine, config.layout_seed, config.random_episodes, seed, **begins)
    return env.episodes.counts() | env.episodes.recent()
