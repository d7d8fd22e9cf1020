"""The stage that trains a comparison agent with the primitive actions: stable-baselines3's PPO or DQN."""

from dataclasses import asdict, replace
from pathlib import Path
from typing import Annotated

from typer import Argument, Option

from hypogoal.command.call import DOMAINS, Call, Done, outcome_of
from hypogoal.command.stage import stage
from hypogoal.core.errors import UserError


@stage(
    "train-baseline doorkey --agent ppo --out runs/mine/ppo",
    often=["agent", "steps", "layout_seed", "setting"],
    then="evaluate {run}",
)
def train_baseline(
    call: Call,
    domain: Annotated[str, Argument(help=DOMAINS)],
    *,
    data: Annotated[Path | None, Option(help="Play in the world where these states were collected.")] = None,
) -> Done:
    """Train PPO or DQN without options, to compare.

    Without ``data``, the agent plays in the world of the domain's defaults.
    """
    from hypogoal.baselines import agents
    from hypogoal.baselines.engine_env import EngineEnv
    from hypogoal.baselines.settings import HYPERPARAMETERS, BaselineConfig
    from hypogoal.core.tensors import save_tensors
    from hypogoal.data import open_dataset
    from hypogoal.domains import world
    from hypogoal.domains.find import load_domain
    from hypogoal.observations import PICTURE, standard_of
    from hypogoal.options.tables import Episodes

    config = call.settings(BaselineConfig, domain)
    played = load_domain(domain)
    dataset = None
    collected = {}
    if data:
        dataset = open_dataset(data)
        if dataset.domain != domain:
            raise UserError(f"these are states of {dataset.domain!r}, not of {domain!r}", data, "Name their domain.")
        collected = played.world(dataset.config)
    played_world = world.played_world(played, collected, config)
    chosen = HYPERPARAMETERS[config.agent, config.setting]
    if config.environments:
        chosen = replace(chosen, environments=config.environments)
    engine = world.make_engine(played, played_world, config, chosen.environments)
    if dataset and engine.observation_dtype != PICTURE:
        engine.standard = standard_of(engine.observation_shape, dataset.unlabelled())
    settings = config.model_dump(mode="json") | {
        "domain": domain,
        "domain_config": played_world,
        "environments": chosen.environments,
        "hyperparameters": asdict(chosen),
    }
    inputs = [data] if data else []
    with call.training("baseline", settings, inputs, config.steps) as work:
        env = EngineEnv(engine)
        files = work.draft.files
        kept = work.draft.checkpoints()
        agent = agents.train(env, chosen, config.steps, call.seed, work.log, work.progress, kept, call.device)
        work.progress.update(config.steps)
        Episodes.of_rows(env.episodes.rows).write(files)
        save_tensors(files / "policy.safetensors", agents.weights(agent))
        world.write_layout(files, engine, config, call.seed)
    numbers = env.episodes.counts() | env.episodes.recent()
    return Done(outcome_of(numbers))
