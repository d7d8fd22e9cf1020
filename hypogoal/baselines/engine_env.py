"""An engine as a stable-baselines3 vectorised environment, and the list of episodes played in it."""

import math
from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecEnv

from hypogoal.core.arrays import Array, Bools, Floats, Ints
from hypogoal.core.checkpoints import Resumable
from hypogoal.domains.base import Engine
from hypogoal.domains.episodes import EpisodeRecorder
from hypogoal.observations import PICTURE, Observations, standardised


class EngineEnv(VecEnv, Resumable):
    """All environments of an engine, with its primitive actions and images.

    Observations are the engine's images, uint8 (C, H, W), or its numbers, float32, by its ``standard`` if there is one;
    where images are made of tiles, the cells' tile codes, uint8 (cells,), which say the same in 1/192 of the bytes (see
    ``networks.CellNetwork``). An episode cut at its step limit is marked as truncated: its last state is not a terminal
    one. ``episodes`` are those that ended.
    """

    CHANGING = ("engine", "episodes")

    def __init__(self, engine: Engine):
        self.engine = engine
        self.tiles = engine.tiles
        first = self._observe(engine.ids[:1])
        low, high = -math.inf, math.inf
        if first.dtype == PICTURE:
            low, high = 0, 255
        space = spaces.Box(
            low,
            high,
            first.shape[1:],
            first.dtype.type,
        )
        actions = spaces.Discrete(engine.n_actions)
        super().__init__(
            engine.count,
            space,
            actions,
        )
        self.episodes = EpisodeRecorder(engine.count)
        self._actions = np.zeros(engine.count, int)

    def _observe(self, ids: Ints) -> Observations:
        if self.tiles is not None:
            return self.engine.codes(ids)
        images = self.engine.images(ids)
        if images.dtype == PICTURE:
            return images.transpose(0, 3, 1, 2)
        if self.engine.standard is None:
            return images
        return standardised(images, *self.engine.standard)

    def reset(self) -> Observations:
        """Put every environment at the start of an episode."""
        return self._observe(self.engine.reset())

    def step_async(self, actions: Array) -> None:
        """Take note of the actions (count,) of the next step."""
        self._actions = np.asarray(actions, int)

    def step_wait(self) -> tuple[Observations, Floats, Bools, list[dict[str, Any]]]:
        """Step every environment; where an episode ended, the observation is that of the next one's start."""
        step = self.engine.step(self._actions)
        self.episodes.see(step)
        done = step.terminated | step.truncated
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for index in np.flatnonzero(done):
            [last] = self._observe(step.next_ids[index : index + 1])
            infos[index]["terminal_observation"] = last
            infos[index]["TimeLimit.truncated"] = bool(not step.terminated[index])
        observations = self._observe(self.engine.ids)
        return observations, step.rewards, done, infos

    def close(self) -> None:
        """Nothing to close."""

    def get_attr(self, *_: Any, **__: Any) -> list[Any]:
        """None: VecEnv asks for ``render_mode``, and an engine is never shown."""
        return [None] * self.num_envs

    def set_attr(self, *_: Any, **__: Any) -> None:
        """Not supported: an engine's attributes are fixed."""
        raise NotImplementedError

    def env_method(self, *_: Any, **__: Any) -> list[Any]:
        """Not supported: an engine has no per-environment methods."""
        raise NotImplementedError

    def env_is_wrapped(self, *_: Any, **__: Any) -> list[bool]:
        """An engine wears no Gymnasium wrappers."""
        return [False] * self.num_envs
