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
UPDATED = "train/"  # the prefix of stable-baselines3's names for the numbers of an update
# The attributes that change while an agent learns. An agent need not have all. The last two say what each environment
# showed last.
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
    """A DQN in which each environment explores on its own, with an epsilon that may wait for the first goal.

    stable-baselines3 tosses one coin for all environments at once, and counts epsilon's fall from step 0.
    """

    explore_rng: np.random.Generator

    def predict(
        self,
        observation: Any,
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = False,
    ) -> Any:
        """Return actions (N,) for observations (N, ...), epsilon-greedy, or greedy if ``deterministic``."""
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
    """A callback that logs every ``LOG_INTERVAL`` steps, stops at NaN, and offers a checkpoint before each rollout."""

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
        """Return the state of the agent and of its environments, and how much is logged."""
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
    """Raise ``NumericalError`` if a weight of the agent is NaN or infinite."""
    for name, weight in model.policy.named_parameters():
        if not torch.isfinite(weight).all():
            raise NumericalError(f"NaN or Inf in {type(model).__name__}'s {name} at step {step}")


def make_agent(
    env: EngineEnv,
    chosen: PPOSettings | DQNSettings,
    seed: int,
    device: str = "cpu",
) -> BaseAlgorithm:
    """Return a new agent. Raises ``UserError`` if PPO has more environments than steps between two updates."""
    seen: dict[str, Any] = {"net_arch": [FEATURES, FEATURES]}  # for observations that are numbers
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
            target_update_interval=chosen.target_interval * env.num_envs,  # the interval is in environment steps
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
            # PPO warns that the 100 decisions of Table 5 do not divide into batches of 64. It also gives advice on the
            # device, but the user chose the device.
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
    """Train a new agent, and return it.

    Training takes ``steps`` environment steps, all environments together, rounded up to whole rollouts. It fills
    ``env.episodes`` and writes to ``log`` every ``LOG_INTERVAL`` steps. Without an engine that can be resumed,
    ``checkpoints`` are not used. Raises ``NumericalError`` if a weight becomes NaN or infinite.
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
    """Return the state of an agent before a rollout, of its environments and of the global random generators.

    stable-baselines3 saves agents as pickles, without their environments and random generators. So this function takes
    the state field by field. Within a rollout, which takes under a second, no state can be taken.
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
    """Continue from an ``agent_snapshot`` of an agent made with the same arguments."""
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
    """Return the networks, the optimiser, the random generators and the environments of an agent."""
    parts = [agent.policy, agent.policy.optimizer, agent.action_space.np_random, env, GlobalRandomness()]
    return [*parts, agent.explore_rng] if isinstance(agent, ExploringDQN) else parts


def _updated(agent: BaseAlgorithm) -> dict[str, float]:
    """Return stable-baselines3's numbers of the last update, by name."""
    logged = agent.logger.name_to_value
    return {name: float(value) for name, value in logged.items() if name.startswith(UPDATED)}


class GlobalRandomness(Resumable):
    """The global random generators from which stable-baselines3 draws."""

    def snapshot(self) -> State:
        return {"torch": torch.get_rng_state(), "numpy": np.random.get_state(legacy=False)}  # noqa: NPY002

    def restore(self, snapshot: Mapping[str, Any]) -> None:
        torch.set_rng_state(snapshot["torch"])
        np.random.set_state(snapshot["numpy"])  # noqa: NPY002


@contextlib.contextmanager
def own_randomness() -> Iterator[None]:
    """Lend stable-baselines3 the global random generators, which it seeds, and restore them when the context ends."""
    lent, python = GlobalRandomness(), random.getstate()
    before = lent.snapshot()
    try:
        yield
    finally:
        lent.restore(before)
        random.setstate(python)


def weights(agent: BaseAlgorithm) -> dict[str, Tensor]:
    """Return the agent's weights by name. Shared weights are there once, and those of the target network are not."""
    named = agent.policy.named_parameters()
    return {name: weight.detach() for name, weight in named if not name.startswith("q_net_target.")}


def epsilon(chosen: DQNSettings, episodes: EpisodeRecorder) -> float:
    """Return the share of random actions, which falls linearly from 1 to its final value (Table 4).

    It begins to fall at the start, or at the first goal.
    """
    step = episodes.steps
    if chosen.epsilon_from == "first-goal":
        step -= next((episode.step for episode in episodes.rows if episode.succeeded), step)
    return float(linear_epsilon(step, chosen.epsilon_steps, chosen.epsilon_final))
