"""The fast DoorKey engine for training: exact to ``DoorKeyEnv``, which it is tested against step by step.

Drawing is 99 % of MiniGrid's cost. Here a step is a few table look-ups for all environments together, and an image is
64 tiles that were drawn once.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hypogoal.domains.base import Engine, Step
from hypogoal.domains.doorkey_env import MAX_STEPS, OBSERVATION_SHAPE, SIZE, TILE, layout_of
from hypogoal.domains.doorkey_states import N_ACTIONS, START, DoorKeyStates, tiles

_ROW_OF_TILE = np.dtype(f"V{TILE * 3}")  # a tile's pixel row moved as one item: twice as fast as 24 bytes


def _cells_of(images: NDArray[np.uint8]) -> NDArray[Any]:
    """A view of images (n, 64, 64, 3) as (n, cell row, pixel row, cell column): items are rows of a tile."""
    if images.dtype != np.uint8 or images.shape[1:] != OBSERVATION_SHAPE or not images.flags.c_contiguous:
        raise ValueError(f"images must be contiguous uint8 (n, {OBSERVATION_SHAPE}), not {images.dtype} {images.shape}")
    rows = images.reshape(len(images), SIZE, TILE, SIZE * TILE * 3)
    return rows.view(_ROW_OF_TILE)


def _tile_rows() -> NDArray[Any]:
    """The tiles as (N_CODES, 8) items of a pixel row."""
    return tiles().reshape(-1, TILE, TILE * 3).view(_ROW_OF_TILE)[..., 0]


def draw(codes: NDArray[np.uint8], out: NDArray[np.uint8] | None = None) -> NDArray[np.uint8]:
    """Images uint8 (n, 64, 64, 3) from cell codes uint8 (n, 64); into ``out`` where given."""
    if out is None:
        out = np.empty((len(codes), *OBSERVATION_SHAPE), np.uint8)
    drawn = _tile_rows()[codes].reshape(-1, SIZE, SIZE, TILE)
    _cells_of(out)[...] = drawn.transpose(0, 1, 3, 2)
    return out


class DoorKeyEngine(Engine):
    """Many environments of one layout, stepped together.

    Args:
        layout_seed: the layout, as ``DoorKeyEnv(layout_seed=...)``.
        count: environments (E).
        keyring, door_label: see ``DoorKeyEnv``.
        max_steps: steps after which an episode is truncated.
        states: share the states that another engine of the same layout has met.

    Attributes:
        ids: int64 (E,), the current state of each environment.
        elapsed: int64 (E,), steps since its episode began.
        states: the layout's states met so far, with their ids.
    """

    n_actions = N_ACTIONS
    observation_shape = OBSERVATION_SHAPE
    resumes = True

    def __init__(
        self,
        layout_seed: int,
        count: int,
        *,
        keyring: bool = True,
        max_steps: int = MAX_STEPS,
        door_label: str = "open",
        states: DoorKeyStates | None = None,
    ):
        self.count, self.max_steps = count, max_steps
        self.states = states or DoorKeyStates(layout_of(layout_seed), keyring, door_label)
        self.ids = np.full(count, START, np.int64)
        self.elapsed = np.zeros(count, np.int64)

    @property
    def n_states(self) -> int:
        """Ids known so far are 0 .. n_states - 1."""
        return self.states.n_states

    @property
    def tiles(self) -> NDArray[np.uint8]:
        """What each cell code looks like, uint8 (N_CODES, 8, 8, 3)."""
        return tiles()

    def reset(self) -> NDArray[np.int64]:
        """Every environment at the start of an episode; returns the ids, int64 (E,)."""
        self.ids = np.full(self.count, START, np.int64)
        self.elapsed = np.zeros(self.count, np.int64)
        return self.ids.copy()

    def step(self, actions: NDArray[np.int64]) -> Step:
        """Step every environment with actions int (E,); where an episode ends, the start follows."""
        next_ids = self.states.step(self.ids, actions)
        terminated = self.states.at_goal(next_ids)
        elapsed = self.elapsed + 1
        truncated = elapsed >= self.max_steps
        ended = terminated | truncated
        self.ids = np.where(ended, START, next_ids)
        self.elapsed = np.where(ended, 0, elapsed)
        return Step(next_ids, terminated.astype(np.float32), terminated, truncated)

    def images(self, ids: NDArray[np.int64], out: NDArray[np.uint8] | None = None) -> NDArray[np.uint8]:
        """Observations uint8 (n, 64, 64, 3) of any known states, into ``out`` where given."""
        return draw(self.states.codes(ids), out)

    def codes(self, ids: NDArray[np.int64]) -> NDArray[np.uint8]:
        """One byte a cell, uint8 (n, 64), that says the whole image; see ``doorkey_states``."""
        return self.states.codes(ids)

    def labels(self, ids: NDArray[np.int64]) -> NDArray[np.bool_]:
        """The true sub-goal predicates, bool (n, 5), in the order of ``SUB_GOALS``."""
        return self.states.labels(ids)

    def snapshot(self) -> dict[str, NDArray[Any]]:
        """What a resumed run needs to go on exactly: the ids given so far, and where each environment is."""
        return {"ids": self.ids.copy(), "elapsed": self.elapsed.copy(), **self.states.snapshot()}

    def restore(self, snapshot: Mapping[str, NDArray[Any]]) -> None:
        """Continue, on a fresh engine, from a ``snapshot`` of one of the same layout and count.

        Raises:
            ValueError: another count or layout, or not a fresh engine.
        """
        if snapshot["ids"].shape != (self.count,):
            raise ValueError(f"the snapshot is of {len(snapshot['ids'])} environments, not {self.count}")
        self.states.restore(snapshot)
        self.ids, self.elapsed = snapshot["ids"].copy(), snapshot["elapsed"].copy()

    def reachable(self, drop: bool = False) -> NDArray[np.int64]:
        """Ids of all states reachable from the start, one for each image; see ``DoorKeyStates.reachable``."""
        return self.states.reachable(drop)

    def shortest_path(self) -> int | None:
        """Primitive steps from the start to the goal, at least; None where a key must be dropped (no key ring)."""
        ids, steps = self.states.distances()
        at_goal = self.states.at_goal(ids)
        return int(steps[at_goal].min()) if at_goal.any() else None

    def random_success(self, episodes: int, rng: np.random.Generator) -> float:
        """Spec F5: share of ``episodes`` of uniformly random actions that reach the goal in ``max_steps``."""
        ids = np.full(episodes, START, np.int64)
        for _ in range(self.max_steps):
            ids = self.states.step(ids, rng.integers(N_ACTIONS, size=len(ids)))
            ids = ids[~self.states.at_goal(ids)]
        return 1.0 - len(ids) / episodes
