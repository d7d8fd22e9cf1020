"""All that a training of stable-baselines3 is between two rollouts, and back again (Spec G1).

The library saves its agents as pickles, without their environments and random numbers. Here what it knows between two
rollouts is written down field by field; within a rollout it cannot be interrupted.
"""

from __future__ import annotations

import random
from collections.abc import Mapping
from typing import Any

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm

from hypogoal.core.checkpoints import optimiser_snapshot, restore_optimiser
from hypogoal.core.seeding import global_state, restore_global
from hypogoal.learners.baselines.engine_env import EngineEnv

COUNTS = ("num_timesteps", "_n_updates", "_n_calls", "_episode_num", "_current_progress_remaining", "exploration_rate")
COLUMNS = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")  # of a replay buffer


def snapshot(agent: BaseAlgorithm, env: EngineEnv) -> dict[str, Any]:
    """An agent between two rollouts, its environments, and the global generators that it draws from."""
    assert agent._last_obs is not None
    return {
        "policy": agent.policy.state_dict(),
        "optimiser": optimiser_snapshot(agent.policy.optimizer),
        "counts": {name: getattr(agent, name) for name in COUNTS if hasattr(agent, name)},
        "logged": {key: float(value) for key, value in _logged(agent).items()},
        "last_observations": agent._last_obs,
        "last_starts": agent._last_episode_starts,
        "replay": _replay_snapshot(getattr(agent, "replay_buffer", None)),
        "env": env.snapshot(),
        "generators": _generators(agent),
    }


def restore(agent: BaseAlgorithm, env: EngineEnv, snapshot: Mapping[str, Any]) -> None:
    """Continue from a ``snapshot`` of an agent made with the same arguments."""
    agent.policy.load_state_dict(snapshot["policy"])
    restore_optimiser(agent.policy.optimizer, snapshot["optimiser"])
    for name, value in snapshot["counts"].items():
        setattr(agent, name, value)
    agent.logger.name_to_value.update(snapshot["logged"])
    agent._last_obs = snapshot["last_observations"]
    agent._last_episode_starts = snapshot["last_starts"]
    _restore_replay(getattr(agent, "replay_buffer", None), snapshot["replay"])
    env.restore(snapshot["env"])
    _restore_generators(agent, snapshot["generators"])


def _logged(agent: BaseAlgorithm) -> dict[str, Any]:
    return {key: value for key, value in agent.logger.name_to_value.items() if key.startswith("train/")}


def _replay_snapshot(buffer: Any) -> dict[str, Any]:
    if buffer is None:
        return {}
    kept = buffer.buffer_size if buffer.full else buffer.pos
    columns = {name: getattr(buffer, name)[:kept].copy() for name in COLUMNS}
    return {"pos": buffer.pos, "full": buffer.full, "columns": columns}


def _restore_replay(buffer: Any, snapshot: Mapping[str, Any]) -> None:
    if buffer is None:
        return
    buffer.pos, buffer.full = snapshot["pos"], snapshot["full"]
    for name, values in snapshot["columns"].items():
        getattr(buffer, name)[: len(values)] = values


def _generators(agent: BaseAlgorithm) -> dict[str, Any]:
    own = getattr(agent, "explore_rng", None)
    return {
        "torch": global_state(agent.device),
        "numpy": np.random.get_state(legacy=False),  # noqa: NPY002
        "python": random.getstate(),
        "actions": agent.action_space.np_random.bit_generator.state,
        "own": own.bit_generator.state if own is not None else None,
    }


def _restore_generators(agent: BaseAlgorithm, snapshot: Mapping[str, Any]) -> None:
    restore_global(snapshot["torch"], agent.device)
    np.random.set_state(snapshot["numpy"])  # noqa: NPY002
    version, numbers, gauss = snapshot["python"]
    random.setstate((version, tuple(numbers), gauss))
    agent.action_space.np_random.bit_generator.state = snapshot["actions"]
    if snapshot["own"] is not None:
        agent.explore_rng.bit_generator.state = snapshot["own"]  # type: ignore[attr-defined]
