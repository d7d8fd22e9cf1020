"""Spec A7, E7: train a comparison agent with the primitive actions: stable-baselines3's PPO or DQN."""

import dataclasses
from pathlib import Path
from typing import Any

from hypogoal.cards import create_artefact
from hypogoal.core.artefacts import claim, open_artefact
from hypogoal.core.checkpoints import checkpoints_of
from hypogoal.core.compute import prepare
from hypogoal.core.config import as_dict
from hypogoal.core.errors import UserError
from hypogoal.core.preflight import preflight
from hypogoal.core.progress import MetricsLog, Progress
from hypogoal.core.tensors import save_tensors
from hypogoal.dataset import PICTURE, open_dataset, standard_of
from hypogoal.domains.base import load_domain
from hypogoal.learners.baselines.settings import HYPERPARAMETERS, BaselineConfig
from hypogoal.meta.training import cut, judged, played_world, write_layout
from hypogoal.needs import baseline_needs, judging_member


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
) -> dict[str, Any]:
    """Train the agent and write the artefact ``out``: episodes.csv, layout.json, metrics.jsonl, policy.safetensors.

    With ``data``, states of the domain, it plays in the world they are of; without, in that of the ``ensemble``, whose
    members' verdicts earn the bonus; else in that of the domain's defaults.
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
        what = "a bonus is paid where an ensemble's members say yes"
        raise UserError(what, f"bonus={config.bonus:g}", "Give --ensemble too, or leave bonus out.")
    taught = open_artefact(ensemble, "ensemble").whole() if ensemble else None
    if taught and taught.config["domain"] != domain:
        what = f"this ensemble is for {taught.config['domain']!r}, not for {domain!r}"
        raise UserError(what, taught.path, "Name its domain.")
    inputs = [path for path in (data, ensemble) if path]
    out = claim(out, kind="baseline", inputs=inputs, force=force, resume=resume)
    played = load_domain(domain, given=True)
    lived: dict[str, Any] = played.world(taught.config["domain_config"]) if taught else {}
    if data:
        dataset = open_dataset(data)
        if dataset.domain != domain:
            what = f"these are states of {dataset.domain!r}, not of {domain!r}"
            raise UserError(what, data, "Name their domain.")
        lived = played.world(dataset.config)
    world = played_world(played, lived, config.world)
    chosen = HYPERPARAMETERS[config.agent, config.setting]
    if config.environments:
        chosen = dataclasses.replace(chosen, environments=config.environments)
    engine = played.make_engine(config.layout_seed, chosen.environments, config.max_episode_steps, **world)
    cut(engine, config.cap)
    if data and engine.observation_dtype != PICTURE:
        engine.standard = standard_of(engine.observation_shape, open_dataset(data).unlabelled())
    bonus = None
    if taught:
        members = judged(engine, taught.path, taught.config, device)
        bonus = Bonus(members.of, members.options, engine.count, config.bonus, members)
    env = EngineEnv(engine, bonus)
    size = env.observation_space.sample().nbytes
    judges = 0.0
    if taught and bonus:
        shape, network = engine.observation_shape, taught.config["network"]
        judges = bonus.members * judging_member(network, shape, engine.observation_dtype)
    needs = baseline_needs(size, played.played_bytes(config.steps, 0), config.steps, chosen, judges)
    preflight("train-baseline", out, needs, resume=resume, quiet=quiet)
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
    counted = {"steps": episodes.steps, "episodes": len(episodes)}
    return counted | {"success": episodes.success(), "length": episodes.length()}
