"""The fast DoorKey engines for training: exact to ``DoorKeyEnv``, which they are tested against step by step.

Drawing is 99 % of MiniGrid's cost. Here a step is a few table look-ups for all environments together, and an
image is brought up to date by redrawing the cells that changed (two at most, but for a new episode).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hypogoal.domains.base import Step
from hypogoal.domains.doorkey_env import MAX_STEPS, OBSERVATION_SHAPE, SIZE, TILE, layout_of
from hypogoal.domains.doorkey_states import (
    AGENT_ON,
    AHEAD,
    CELLS,
    FORWARD,
    MAY_CHANGE,
    MOVE_AS,
    MOVES,
    N_ACTIONS,
    START,
    DoorKeyStates,
    tiles,
)

# Plain lists: one look-up in them is several times faster than in an array.
_AHEAD, _MOVES, _MOVE_AS = AHEAD.tolist(), MOVES.tolist(), MOVE_AS.tolist()
_MAY_CHANGE, _AGENT_ON = MAY_CHANGE.tolist(), AGENT_ON.tolist()
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


class DoorKeyEngine:
    """Many environments of one layout, stepped together; see ``hypogoal.domains.base.Engine``.

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
    observation_shape: tuple[int, ...] = OBSERVATION_SHAPE

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
        self._tiles = _tile_rows()
        self._canvas = draw(np.repeat(self.states.codes(np.array([START])), count, axis=0))
        self._canvas_rows = _cells_of(self._canvas).reshape(-1)
        cell = np.arange(count * CELLS)  # and where in the canvas each one's first pixel row is
        self._first_rows = cell // SIZE * (SIZE * TILE) + cell % SIZE
        self._drawn = self.states.codes(np.full(count, START))  # the codes that the canvas shows
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

    def observe(self, out: NDArray[np.uint8] | None = None, copy: bool = True) -> NDArray[np.uint8]:
        """The image of every environment's current state, uint8 (E, 64, 64, 3).

        Only the cells that changed since the last call are drawn. After ``step`` has ended an episode this is
        the next one's first image; the last one's is ``images(step.next_ids)``.

        Args:
            out: where to copy the images to; None, a new array.
            copy: False, no copy: the engine's own buffer, read-only, drawn over at the next call.
        """
        codes = self.states.codes(self.ids)
        changed = (codes != self._drawn).ravel().nonzero()[0]
        where = self._first_rows.take(changed)[:, None] + np.arange(TILE) * SIZE
        self._canvas_rows[where] = self._tiles.take(codes.ravel().take(changed), axis=0)
        self._drawn = codes
        if not copy:
            shown = self._canvas.view()
            shown.flags.writeable = False
            return shown
        if out is None:
            return self._canvas.copy()
        np.copyto(out, self._canvas)
        return out

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

    def shortest_path(self) -> int:
        """Primitive steps from the start to the goal, at least.

        Raises:
            ValueError: the goal cannot be reached without ``drop`` (only without the key ring).
        """
        ids, steps = self.states.distances()
        at_goal = self.states.at_goal(ids)
        if not at_goal.any():
            raise ValueError("the goal cannot be reached without dropping a key")
        return int(steps[at_goal].min())

    def random_success(self, episodes: int, rng: np.random.Generator) -> float:
        """Spec F5: share of ``episodes`` of uniformly random actions that reach the goal in ``max_steps``."""
        ids = np.full(episodes, START, np.int64)
        for _ in range(self.max_steps):
            ids = self.states.step(ids, rng.integers(N_ACTIONS, size=len(ids)))
            ids = ids[~self.states.at_goal(ids)]
        return 1.0 - len(ids) / episodes


class SingleDoorKey:
    """One environment with its image, in plain Python: for one, this is faster than NumPy's vectors.

    Args: as ``DoorKeyEngine``, without ``count``. After an episode's end call ``reset``.
    """

    def __init__(self, layout_seed: int, *, keyring: bool = True, max_steps: int = MAX_STEPS, door_label: str = "open"):
        self.states = DoorKeyStates(layout_of(layout_seed), keyring, door_label)
        self.max_steps = max_steps
        layout = self.states.layout
        self._goal = layout.goal
        self._start = layout.start * 4 + layout.direction
        self._first_image = draw(self.states.codes(np.array([START])))[0]
        self._canvas = self._first_image.copy()
        cells = _cells_of(self._canvas[None])[0]
        self._cells = [cells[cell // SIZE, :, cell % SIZE] for cell in range(CELLS)]
        self._tiles = list(_tile_rows())
        self._rewind()

    def _rewind(self) -> None:
        self.elapsed = 0
        self._pose = self._start
        self._configuration = 0  # the start's
        self._row = self.states.rows[0]

    def reset(self) -> NDArray[np.uint8]:
        """A new episode; returns the image, uint8 (64, 64, 3), the caller's to keep."""
        self._rewind()
        np.copyto(self._canvas, self._first_image)
        return self._canvas.copy()

    def step(self, action: int) -> tuple[NDArray[np.uint8], float, bool, bool]:
        """Play ``action`` (0 .. 6): (image uint8 (64, 64, 3) to keep, reward, terminated, truncated)."""
        pose, row = self._pose, self._row
        front = _AHEAD[pose]
        at_goal = False
        if action <= FORWARD:
            moved = _MOVES[_MOVE_AS[action][row[front]]][pose]
            if moved != pose:
                before, cell = pose >> 2, moved >> 2
                if before != cell:
                    self._cells[before][...] = self._tiles[row[before]]
                    at_goal = cell == self._goal
                self._cells[cell][...] = self._tiles[_AGENT_ON[row[cell]] + (moved & 3)]
                self._pose = moved
        elif _MAY_CHANGE[action][row[front]]:
            self._configuration = self.states.change(self._configuration, front, action)
            self._row = self.states.rows[self._configuration]
            self._cells[front][...] = self._tiles[self._row[front]]
        self.elapsed += 1
        return self._canvas.copy(), float(at_goal), at_goal, self.elapsed >= self.max_steps
