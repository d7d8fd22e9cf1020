"""An engine as a stable-baselines3 vectorised environment, and the list of episodes played in it."""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv

from hypogoal.core.checkpoints import Resumable
from hypogoal.dataset import PICTURE, Observations, standardised
from hypogoal.domains.base import Engine, Step, step_of
from hypogoal.learners.episodes import EpisodeRecorder


class Bonus(Resumable):
    """A bonus for what an ensemble knows: paid for a member's first positive prediction in an episode (ours).

    The state in which an episode begins is not judged, the one in which it ends is.

    Args:
        predictions: state ids (n,) -> whether the O members are positive, bool (n, O).
        members: O, of all sub-goals together.
        environments: E.
        size: reward for each of these predictions.
        memory: what the predictions rest on and a resumed run needs (Spec G1), where that changes.
    """

    CHANGING = ("_fired", "_memory")

    def __init__(
        self,
        predictions: Callable[[NDArray[np.int64]], NDArray[np.bool_]],
        members: int,
        environments: int,
        size: float,
        memory: Resumable | None = None,
    ):
        self.predictions, self.members, self.size, self._memory = predictions, members, size, memory
        self._fired = np.zeros((environments, members), dtype=np.bool_)  # in the running episodes

    def reset(self) -> None:
        """Every environment begins an episode."""
        self._fired[:] = False

    def of(self, step: Step) -> NDArray[np.float32]:
        """What one step of every environment earns: float32 (E,)."""
        positive = self.predictions(step.next_ids)
        first = (positive & ~self._fired).sum(axis=1)
        self._fired |= positive
        self._fired[step.terminated | step.truncated] = False
        return (self.size * first).astype(np.float32)


class EngineEnv(VecEnv):
    """All environments of an engine, with its primitive actions and images.

    Observations are the engine's images, uint8 (C, H, W), or its numbers, float32, by its ``standard`` if there is one;
    where images are made of tiles, the cells' tile codes, uint8 (cells,), which say the same in 1/192 of the bytes (see
    ``networks.CellNetwork``). An episode cut at its step limit is marked as truncated: its last state is not a terminal
    one. ``episodes`` are those that ended, with the engine's own rewards; the agent gets the ``bonus`` on top of them.
    """

    def __init__(self, engine: Engine, bonus: Bonus | None = None):
        self.engine, self.bonus = engine, bonus
        self.tiles = engine.tiles
        first = self._observe(engine.ids[:1])
        low, high = (0, 255) if first.dtype == PICTURE else (-math.inf, math.inf)
        space: Any = spaces.Box(low, high, first.shape[1:], first.dtype.type)
        super().__init__(engine.count, space, spaces.Discrete(engine.n_actions))
        self.episodes = EpisodeRecorder(engine.count)
        self._actions = np.zeros(engine.count, dtype=np.int64)

    def _observe(self, ids: NDArray[np.int64]) -> Observations:
        if self.tiles is not None:
            return self.engine.codes(ids)
        images = self.engine.images(ids)
        if images.dtype == PICTURE:
            return images.transpose(0, 3, 1, 2)
        return standardised(images, *self.engine.standard) if self.engine.standard else images

    def reset(self) -> Observations:
        """Put every environment at the start of an episode."""
        if self.bonus:
            self.bonus.reset()
        return self._observe(self.engine.reset())

    def step_async(self, actions: NDArray[Any]) -> None:
        """Take note of the actions (count,) of the next step."""
        self._actions = np.asarray(actions, dtype=np.int64)

    def step_wait(self) -> tuple[Observations, NDArray[np.float32], NDArray[np.bool_], list[dict[str, Any]]]:
        """Step every environment; where an episode ended, the observation is that of the next one's start."""
        step = step_of(self.engine, self._actions)
        self.episodes.see(step)
        rewards = step.rewards + self.bonus.of(step) if self.bonus else step.rewards
        done = step.terminated | step.truncated
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for index in np.flatnonzero(done):
            infos[index]["terminal_observation"] = self._observe(step.next_ids[index : index + 1])[0]
            infos[index]["TimeLimit.truncated"] = bool(not step.terminated[index])
        return self._observe(self.engine.ids), rewards, done, infos

    def snapshot(self) -> dict[str, Any]:
        """What a resumed run needs to go on exactly; of engines that have a ``snapshot``."""
        state = {"engine": self.engine.snapshot(), "episodes": self.episodes.snapshot()}
        return {**state, "bonus": self.bonus.snapshot()} if self.bonus else state

    def restore(self, snapshot: Mapping[str, Any]) -> None:
        """Continue from a ``snapshot`` of environments made with the same arguments."""
        self.engine.restore(snapshot["engine"])
        self.episodes.restore(snapshot["episodes"])
        if self.bonus:
            self.bonus.restore(snapshot["bonus"])

    def close(self) -> None:
        """Nothing to close."""

    def get_attr(self, attr_name: str, indices: None | int | Iterable[int] = None) -> list[Any]:
        """None: VecEnv asks for ``render_mode``, and an engine is never shown."""
        return [None] * len(list(self._get_indices(indices)))

    def set_attr(self, attr_name: str, value: Any, indices: None | int | Iterable[int] = None) -> None:
        """Not supported: an engine's attributes are fixed."""
        raise NotImplementedError("an engine's attributes are fixed")

    def env_method(
        self, method_name: str, *method_args: Any, indices: None | int | Iterable[int] = None, **method_kwargs: Any
    ) -> list[Any]:
        """Not supported: an engine has no per-environment methods."""
        raise NotImplementedError("an engine has no per-environment methods")

    def env_is_wrapped(self, wrapper_class: type, indices: None | int | Iterable[int] = None) -> Sequence[bool]:  # type: ignore[override]
        """An engine wears no Gymnasium wrappers."""
        return [False] * len(list(self._get_indices(indices)))
