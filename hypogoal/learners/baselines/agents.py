"""PPO and DQN of stable-baselines3, made from the table of settings and trained on an engine."""

import contextlib
import random
import warnings
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3 import DQN, PPO
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger
from torch import Tensor

from hypogoal.core.checkpoints import Checkpoints, restored, snapshot_of
from hypogoal.core.errors import NumericalError, UserError
from hypogoal.core.progress import MetricsLog, Progress
from hypogoal.core.seeding import global_state, restore_global, rng_for, seed_for
from hypogoal.learners.baselines.engine_env import EngineEnv
from hypogoal.learners.baselines.networks import CELL, FEATURES, NETWORKS
from hypogoal.learners.baselines.settings import DQNSettings, PPOSettings
from hypogoal.observations import PICTURE

LOG_INTERVAL = 5_000  # environment steps
COUNTS = ("num_timesteps", "_n_updates", "_episode_num", "_current_progress_remaining")
REPLAY_COLUMNS = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")


class ExploringDQN(DQN):
    """DQN whose every environment explores on its own, with an epsilon that may wait for the first goal.

    stable-baselines3 tosses one coin for all environments at once and counts epsilon's fall from step 0.
    """

    explore_rng: np.random.Generator
    chosen: DQNSettings

    def predict(
        self,
        observation: Any,
        state: tuple[NDArray[Any], ...] | None = None,
        episode_start: NDArray[Any] | None = None,
        deterministic: bool = False,
    ) -> tuple[NDArray[Any], tuple[NDArray[Any], ...] | None]:
        """Epsilon-greedy actions (N,) for observations (N, C, H, W); greedy where ``deterministic``."""
        actions, state = self.policy.predict(observation, state, episode_start, deterministic=True)
        if not deterministic:
            explore = self.explore_rng.random(len(actions)) < self.exploration_rate
            anything = self.explore_rng.integers(self.action_space.n, size=len(actions))  # type: ignore[attr-defined]
            actions = np.where(explore, anything, actions)
        return actions, state


class _Watch(BaseCallback):
    """Logs every ``LOG_INTERVAL`` steps, stops at NaN, and tells DQN's epsilon when the first goal was seen.

    Before each rollout the state of all is offered as a checkpoint.
    """

    def __init__(self, env: EngineEnv, checkpoints: Checkpoints, log: MetricsLog | None, progress: Progress | None):
        super().__init__()
        self.env, self.checkpoints, self.log, self.progress = env, checkpoints, log, progress
        self.first_goal: int | None = None
        self._next = LOG_INTERVAL

    def _on_rollout_start(self) -> None:
        self.checkpoints.offer(lambda: self.snapshot(self.model))

    def snapshot(self, agent: BaseAlgorithm) -> dict[str, Any]:
        """Where this is, where the agent is, and how much is logged."""
        log = self.log.snapshot() if self.log else 0
        return {"agent": agent_snapshot(agent, self.env), "watch": [self.first_goal, self._next], "log": log}

    def restore(self, agent: BaseAlgorithm, snapshot: Mapping[str, Any]) -> None:
        """Continue with ``agent`` from a ``snapshot`` of the same training."""
        restore_agent(agent, self.env, snapshot["agent"])
        self.first_goal, self._next = snapshot["watch"]
        if self.progress:
            self.progress.resume(min(self.env.episodes.steps, self.progress.total))

    def _on_step(self) -> bool:
        episodes = self.env.episodes
        if self.first_goal is None:  # those that ended before did not succeed
            self.first_goal = next((row[0] for row in episodes[-self.env.num_envs :] if row[4]), None)
        if episodes.steps >= self._next:
            self._next += LOG_INTERVAL
            check_finite(self.model, episodes.steps)
            numbers = {"success": episodes.recent()["success"] if episodes else 0.0, **_logged(self.model)}
            if isinstance(self.model, DQN):
                numbers["epsilon"] = float(self.model.exploration_rate)
            if self.log:
                self.log.write(step=episodes.steps, episodes=len(episodes), **numbers)
            if self.progress:
                self.progress.update(min(episodes.steps, self.progress.total), success=numbers["success"])
        elif self.progress:
            self.progress.update(episodes.steps)
        return True


def check_finite(model: BaseAlgorithm, step: int) -> None:
    """Spec G3: a ``NumericalError`` where a weight of the agent is NaN or infinite."""
    for name, weight in model.policy.named_parameters():
        if not torch.isfinite(weight).all():
            raise NumericalError(f"NaN or Inf in {type(model).__name__}'s {name} at step {step}")


def make_agent(env: EngineEnv, chosen: PPOSettings | DQNSettings, seed: int, device: str = "cpu") -> BaseAlgorithm:
    """A fresh agent; a ``UserError`` where PPO has more environments than steps between two updates."""
    if isinstance(chosen, PPOSettings) and env.num_envs > chosen.rollout:
        fault = f"PPO updates every {chosen.rollout} steps, fewer than there are environments"
        raise UserError(fault, f"environments={env.num_envs}", f"Give --set environments={chosen.rollout} or fewer.")
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
    if isinstance(chosen, PPOSettings):
        with warnings.catch_warnings():
            # Table 5's 100 decisions do not divide into batches of 64: the second one has 36.
            warnings.filterwarnings("ignore", message="You have specified a mini-batch size")
            # Advice to use the CPU, which is for who chose the device.
            warnings.filterwarnings("ignore", message="You are trying to run PPO on the GPU")
            agent = PPO(
                **common,
                n_steps=chosen.rollout // env.num_envs,
                n_epochs=chosen.epochs,
                gae_lambda=chosen.gae_lambda,
                clip_range=chosen.clip,
                ent_coef=chosen.entropy,
            )
    else:
        agent = ExploringDQN(
            **common,
            buffer_size=chosen.replay,
            learning_starts=chosen.warm_up,
            tau=chosen.target_tau,
            train_freq=1,
            target_update_interval=chosen.target_interval * env.num_envs,  # it counts environment steps
        )
        agent.explore_rng = rng_for(seed, "explore")
        agent.chosen = chosen
    agent.set_logger(Logger(folder=None, output_formats=[]))
    return agent


def train(
    env: EngineEnv,
    chosen: PPOSettings | DQNSettings,
    steps: int,
    seed: int,
    log: MetricsLog | None = None,
    progress: Progress | None = None,
    checkpoints: Checkpoints | None = None,
    device: str = "cpu",
) -> BaseAlgorithm:
    """Spec E7: train a fresh agent for ``steps`` environment steps of all environments, rounded up to whole rollouts.

    ``env.episodes`` is filled; ``log`` and ``progress`` are told of every ``LOG_INTERVAL`` steps. Checkpoints (spec G1)
    are of no use where the engine cannot be resumed. NaN or Inf in a weight is a ``NumericalError``.
    """
    if checkpoints is None or not env.engine.resumes:
        checkpoints = Checkpoints(None)
    with own_randomness():
        agent = make_agent(env, chosen, seed, device)
        watch = _Watch(env, checkpoints, log, progress)
        if isinstance(agent, ExploringDQN):
            agent.exploration_schedule = lambda _: epsilon(agent.chosen, env.episodes.steps, watch.first_goal)
            agent.exploration_rate = 1.0
        saved = checkpoints.load()
        if saved is not None:
            watch.restore(agent, saved)
        if log:
            log.restore(saved["log"] if saved else 0)
        with checkpoints:
            agent.learn(
                steps - agent.num_timesteps,
                callback=watch,
                log_interval=None,  # type: ignore[arg-type]
                reset_num_timesteps=not saved,
            )
    check_finite(agent, env.episodes.steps)
    return agent


def agent_snapshot(agent: BaseAlgorithm, env: EngineEnv) -> dict[str, Any]:
    """An agent between two rollouts, its environments, and the global generators that it draws from (Spec G1).

    The library saves its agents as pickles, without their environments and random numbers. Here what it knows between
    two rollouts is written down field by field; within a rollout (under a second) it cannot be interrupted.
    """
    dqn: dict[str, Any] = {}
    if isinstance(agent, ExploringDQN):
        buffer = agent.replay_buffer
        assert buffer is not None
        kept = buffer.buffer_size if buffer.full else buffer.pos
        dqn = {
            "pos": buffer.pos,
            "full": buffer.full,
            "columns": {name: getattr(buffer, name)[:kept].copy() for name in REPLAY_COLUMNS},
            "explore": agent.explore_rng.bit_generator.state,
            "counts": [agent._n_calls, agent.exploration_rate],
        }
    shape = (env.num_envs, *env.observation_space.shape)  # type: ignore[misc]
    fresh = np.zeros(shape, env.observation_space.dtype), np.ones(env.num_envs, np.bool_)
    return {
        "policy": agent.policy.state_dict(),
        "optimiser": snapshot_of(agent.policy.optimizer),
        "counts": {name: getattr(agent, name) for name in COUNTS},
        "logged": _logged(agent, prefix="train/"),
        "last_observations": fresh[0] if agent._last_obs is None else agent._last_obs,
        "last_starts": fresh[1] if agent._last_episode_starts is None else agent._last_episode_starts,
        "dqn": dqn,
        "env": env.snapshot(),
        "torch": global_state(agent.device),
        "numpy": np.random.get_state(legacy=False),  # noqa: NPY002
        "python": random.getstate(),
        "actions": agent.action_space.np_random.bit_generator.state,
    }


def restore_agent(agent: BaseAlgorithm, env: EngineEnv, snapshot: Mapping[str, Any]) -> None:
    """Continue from an ``agent_snapshot`` of such an agent."""
    agent.policy.load_state_dict(snapshot["policy"])
    restored(agent.policy.optimizer, snapshot["optimiser"])
    for name, value in snapshot["counts"].items():
        setattr(agent, name, value)
    agent.logger.name_to_value.update(snapshot["logged"])
    agent._last_obs = snapshot["last_observations"]
    agent._last_episode_starts = snapshot["last_starts"]
    if isinstance(agent, ExploringDQN):
        dqn, buffer = snapshot["dqn"], agent.replay_buffer
        assert buffer is not None
        buffer.pos, buffer.full = dqn["pos"], dqn["full"]
        kept = buffer.buffer_size if buffer.full else buffer.pos
        for name, values in dqn["columns"].items():
            getattr(buffer, name)[:kept] = values
        agent.explore_rng.bit_generator.state = dqn["explore"]
        agent._n_calls, agent.exploration_rate = dqn["counts"]
    env.restore(snapshot["env"])
    restore_global(snapshot["torch"], agent.device)
    np.random.set_state(snapshot["numpy"])  # noqa: NPY002
    version, numbers, gauss = snapshot["python"]
    random.setstate((version, tuple(numbers), gauss))
    agent.action_space.np_random.bit_generator.state = snapshot["actions"]


def _logged(agent: BaseAlgorithm, prefix: str = "") -> dict[str, float]:
    """The library's numbers of the last update, their names with a ``prefix``."""
    logged = agent.logger.name_to_value
    return {prefix + key[6:]: float(value) for key, value in logged.items() if key.startswith("train/")}


def weights(agent: BaseAlgorithm) -> dict[str, Tensor]:
    """The agent's weights by name, shared ones once, without the target network's."""
    named = agent.policy.named_parameters()
    return {name: weight.detach() for name, weight in named if not name.startswith("q_net_target.")}


def epsilon(chosen: DQNSettings, step: int, first_goal: int | None) -> float:
    """Table 4: exploration at ``step``: from 1 to the final value, linearly, from the start or the first goal on."""
    if chosen.epsilon_from == "first-goal":
        if first_goal is None:
            return 1.0
        step -= first_goal
    share = min(1.0, step / chosen.epsilon_steps)
    return 1.0 + share * (chosen.epsilon_final - 1.0)


@contextlib.contextmanager
def own_randomness() -> Iterator[None]:
    """Lend stable-baselines3 the global generators it insists on, and put them back afterwards."""
    python, numpy_state = random.getstate(), np.random.get_state()  # noqa: NPY002
    with torch.random.fork_rng(devices=[]):
        try:
            yield
        finally:
            random.setstate(python)
            np.random.set_state(numpy_state)  # noqa: NPY002
