"""PPO and DQN of stable-baselines3, made from the table of settings and trained on an engine."""

import contextlib
import random
import warnings
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import torch
from stable_baselines3 import DQN, PPO
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger
from torch import Tensor

from hypogoal.baselines.engine_env import CELL, FEATURES, NETWORKS, EngineEnv
from hypogoal.baselines.settings import DQNSettings, PPOSettings
from hypogoal.core.checkpoints import Checkpoints, Resumable, State, restored, snapshot_of
from hypogoal.core.errors import NumericalError, UserError
from hypogoal.core.progress import MetricsLog, Progress
from hypogoal.core.seeding import rng_for, seed_for
from hypogoal.domains.episodes import EpisodeRecorder
from hypogoal.observations import PICTURE
from hypogoal.options.double_dqn import linear_epsilon

LOG_INTERVAL = 5_000  # environment steps
UPDATED = "train/"  # before the names of the library's numbers of an update
# What changes while an agent learns, where it has it: first counts, then what each environment showed last.
CHANGING = (
    "num_timesteps",
    "_n_updates",
    "_episode_num",
    "_current_progress_remaining",
    "_n_calls",
    "exploration_rate",
    "_last_obs",
    "_last_episode_starts",
)
REPLAY_COLUMNS = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")


class ExploringDQN(DQN):
    """DQN whose every environment explores on its own, with an epsilon that may wait for the first goal.

    stable-baselines3 tosses one coin for all environments at once and counts epsilon's fall from step 0.
    """

    explore_rng: np.random.Generator

    def predict(
        self,
        observation: Any,
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = False,
    ) -> Any:
        """Epsilon-greedy actions (N,) for observations (N, C, H, W); greedy where ``deterministic``."""
        actions, state = self.policy.predict(
            observation,
            state,
            episode_start,
            deterministic=True,
        )
        if not deterministic:
            explore = self.explore_rng.random(len(actions)) < self.exploration_rate
            anything = self.explore_rng.integers(self.action_space.n, size=len(actions))  # type: ignore[attr-defined]
            actions = np.where(explore, anything, actions)
        return actions, state


class Watch(BaseCallback):
    """Logs every ``LOG_INTERVAL`` steps, stops at NaN, and offers a checkpoint of all before each rollout."""

    def __init__(
        self,
        env: EngineEnv,
        checkpoints: Checkpoints,
        log: MetricsLog,
        progress: Progress,
    ):
        super().__init__()
        self.env, self.checkpoints, self.log, self.progress = env, checkpoints, log, progress

    def _on_rollout_start(self) -> None:
        self.checkpoints.offer(self.snapshot)

    def snapshot(self) -> State:
        """Where the agent is, and how much is logged."""
        return {"agent": agent_snapshot(self.model, self.env), "log": self.log.snapshot()}

    def _on_step(self) -> bool:
        episodes = self.env.episodes
        steps = episodes.steps
        shown = {}
        if steps // LOG_INTERVAL > (steps - self.env.num_envs) // LOG_INTERVAL:
            check_finite(self.model, steps)
            shown = {"success": episodes.recent()["success"] if episodes.rows else 0.0}
            numbers = {name.removeprefix(UPDATED): value for name, value in _updated(self.model).items()}
            if isinstance(self.model, DQN):
                numbers["epsilon"] = float(self.model.exploration_rate)
            self.log.write(
                step=steps,
                episodes=len(episodes.rows),
                **shown,
                **numbers,
            )
        self.progress.update(min(steps, self.progress.total), **shown)
        return True


def check_finite(model: BaseAlgorithm, step: int) -> None:
    """A ``NumericalError`` where a weight of the agent is NaN or infinite."""
    for name, weight in model.policy.named_parameters():
        if not torch.isfinite(weight).all():
            raise NumericalError(f"NaN or Inf in {type(model).__name__}'s {name} at step {step}")


def make_agent(
    env: EngineEnv,
    chosen: PPOSettings | DQNSettings,
    seed: int,
    device: str = "cpu",
) -> BaseAlgorithm:
    """A fresh agent; a ``UserError`` where PPO has more environments than steps between two updates."""
    seen: dict[str, Any] = {"net_arch": [FEATURES, FEATURES]}  # of numbers
    if env.observation_space.dtype == PICTURE:
        network = {"tiles": env.tiles, "rows": env.engine.observation_shape[0] // CELL}
        features = {"features_extractor_class": NETWORKS[chosen.network], "features_extractor_kwargs": network}
        seen = {**features, "net_arch": []}
    common: dict[str, Any] = {
        "policy": "MlpPolicy",
        "env": env,
        "learning_rate": chosen.learning_rate,
        "batch_size": chosen.batch,
        "gamma": chosen.gamma,
        "policy_kwargs": {**seen, "optimizer_kwargs": {"fused": True}},
        "seed": seed_for(seed, "agent") % 2**32,
        "device": device,
    }
    agent: BaseAlgorithm
    if isinstance(chosen, DQNSettings):
        agent = ExploringDQN(
            **common,
            buffer_size=chosen.replay,
            learning_starts=chosen.warm_up,
            tau=chosen.target_tau,
            train_freq=1,
            target_update_interval=chosen.target_interval * env.num_envs,  # it counts environment steps
        )
        agent.explore_rng = rng_for(seed, "explore")
        agent.exploration_schedule = lambda _: epsilon(chosen, env.episodes)
        agent.exploration_rate = 1.0
    elif env.num_envs > chosen.rollout:
        raise UserError(
            f"PPO updates every {chosen.rollout} steps, fewer than there are environments",
            f"environments={env.num_envs}",
            f"Give --set environments={chosen.rollout} or fewer.",
        )
    else:
        with warnings.catch_warnings():
            # Table 5's 100 decisions do not divide into batches of 64; and advice on the device, which the user chose.
            warnings.simplefilter("ignore")
            agent = PPO(
                **common,
                n_steps=chosen.rollout // env.num_envs,
                n_epochs=chosen.epochs,
                gae_lambda=chosen.gae_lambda,
                clip_range=chosen.clip,
                ent_coef=chosen.entropy,
            )
    agent.set_logger(Logger(folder=None, output_formats=[]))
    return agent


def train(
    env: EngineEnv,
    chosen: PPOSettings | DQNSettings,
    steps: int,
    seed: int,
    log: MetricsLog,
    progress: Progress,
    checkpoints: Checkpoints,
    device: str = "cpu",
) -> BaseAlgorithm:
    """Train a fresh agent for ``steps`` environment steps of all environments, rounded up to whole rollouts.

    ``env.episodes`` is filled; ``log`` and ``progress`` are told of every ``LOG_INTERVAL`` steps. Checkpoints
    are of no use where the engine cannot be resumed. NaN or Inf in a weight is a ``NumericalError``.
    """
    if not env.engine.resumes:
        checkpoints = Checkpoints(None)
    watch = Watch(env, checkpoints, log, progress)
    with own_randomness():
        agent = make_agent(env, chosen, seed, device)
        saved = checkpoints.load()
        log.restore(saved["log"] if saved else 0)
        if saved:
            restore_agent(agent, env, saved["agent"])
            progress.resume(min(env.episodes.steps, steps))
        agent.learn(
            steps - agent.num_timesteps,
            callback=watch,
            log_interval=None,  # type: ignore[arg-type]
            reset_num_timesteps=not saved,
        )
    check_finite(agent, env.episodes.steps)
    return agent


def agent_snapshot(agent: BaseAlgorithm, env: EngineEnv) -> State:
    """An agent before a rollout, its environments, and the global generators that it draws from.

    The library saves its agents as pickles, without their environments and random numbers. Here what it knows between
    two rollouts is written down field by field; within a rollout (under a second) it cannot be interrupted.
    """
    snapshot = {
        "parts": [snapshot_of(part) for part in _parts(agent, env)],
        "values": {name: getattr(agent, name) for name in CHANGING if hasattr(agent, name)},
        "updated": _updated(agent),
    }
    if isinstance(agent, ExploringDQN):
        buffer: Any = agent.replay_buffer
        kept = buffer.buffer_size if buffer.full else buffer.pos
        columns = {name: getattr(buffer, name)[:kept].copy() for name in REPLAY_COLUMNS}
        snapshot["replay"] = {"pos": buffer.pos, "full": buffer.full, "columns": columns}
    return snapshot


def restore_agent(agent: BaseAlgorithm, env: EngineEnv, snapshot: Mapping[str, Any]) -> None:
    """Continue from an ``agent_snapshot`` of such an agent."""
    for part, saved in zip(_parts(agent, env), snapshot["parts"], strict=True):
        restored(part, saved)
    for name, value in snapshot["values"].items():
        setattr(agent, name, value)
    agent.logger.name_to_value.update(snapshot["updated"])
    if isinstance(agent, ExploringDQN):
        buffer: Any = agent.replay_buffer
        replay = snapshot["replay"]
        buffer.pos, buffer.full = replay["pos"], replay["full"]
        for name, values in replay["columns"].items():
            getattr(buffer, name)[: len(values)] = values


def _parts(agent: BaseAlgorithm, env: EngineEnv) -> list[Any]:
    """Networks, optimiser and generators of an agent, and its environments."""
    parts = [agent.policy, agent.policy.optimizer, agent.action_space.np_random, env, GlobalRandomness()]
    return [*parts, agent.explore_rng] if isinstance(agent, ExploringDQN) else parts


def _updated(agent: BaseAlgorithm) -> dict[str, float]:
    """The library's numbers of the last update."""
    logged = agent.logger.name_to_value
    return {name: float(value) for name, value in logged.items() if name.startswith(UPDATED)}


class GlobalRandomness(Resumable):
    """The global generators that the library draws from."""

    def snapshot(self) -> State:
        return {"torch": torch.get_rng_state(), "numpy": np.random.get_state(legacy=False)}  # noqa: NPY002

    def restore(self, snapshot: Mapping[str, Any]) -> None:
        torch.set_rng_state(snapshot["torch"])
        np.random.set_state(snapshot["numpy"])  # noqa: NPY002


@contextlib.contextmanager
def own_randomness() -> Iterator[None]:
    """Lend stable-baselines3 the global generators, which it seeds, and put them back afterwards."""
    lent, python = GlobalRandomness(), random.getstate()
    before = lent.snapshot()
    try:
        yield
    finally:
        lent.restore(before)
        random.setstate(python)


def weights(agent: BaseAlgorithm) -> dict[str, Tensor]:
    """The agent's weights by name, shared ones once, without the target network's."""
    named = agent.policy.named_parameters()
    return {name: weight.detach() for name, weight in named if not name.startswith("q_net_target.")}


def epsilon(chosen: DQNSettings, episodes: EpisodeRecorder) -> float:
    """Table 4: exploration falls from 1 to the final value, linearly, from the start or the first goal on."""
    step = episodes.steps
    if chosen.epsilon_from == "first-goal":
        step -= next((episode.step for episode in episodes.rows if episode.succeeded), step)
    return float(linear_epsilon(step, chosen.epsilon_steps, chosen.epsilon_final))
