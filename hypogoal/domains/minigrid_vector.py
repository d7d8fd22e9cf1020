"""RGB of any MiniGrid environment, many at once, drawing only the cells that changed: ``hypogoal.make_vec``.

The rules stay MiniGrid's own: each environment's ``step`` and ``reset`` are called as they are. Left out is what
``RGBImgObsWrapper`` throws away, the encoded partial view. What the agents see is worked out for all environments
together, and a cell that looks otherwise than a step before gets a tile that MiniGrid drew once.
"""

from collections.abc import Sequence
from functools import cache
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from minigrid.core.constants import DIR_TO_VEC
from minigrid.core.grid import Grid
from minigrid.core.world_object import Floor, Goal, Lava, Wall, WorldObj
from minigrid.minigrid_env import MiniGridEnv
from minigrid.wrappers import RGBImgObsWrapper
from numpy.typing import NDArray

from hypogoal.core.errors import UserError

LOOKS = 10  # of a thing: without the agent or with it in one of four directions, each in the dark or lit
STILL = {Wall, Floor, Goal, Lava}  # nothing changes in them, only another thing may come in their place
DRAWING = ("gen_obs", "gen_obs_grid", "get_frame", "get_full_render", "get_view_exts", "dir_vec", "right_vec")
WIDEST = 9  # cells of a view's row: up to here the table of rows is kept, 4**9 entries


def make_vec(
    env_id: str,
    num_envs: int = 1,
    *,
    tile_size: int = 8,
    copy: bool = True,
    autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
    **arguments: Any,
) -> "MiniGridVector":
    """``SyncVectorEnv`` of ``RGBImgObsWrapper(gymnasium.make(env_id), tile_size)``, to the pixel, but faster.

    Args:
        env_id: a MiniGrid environment, from the package or elsewhere.
        num_envs: number of environments (N).
        tile_size: pixels along a cell.
        copy: give each step's images an array of their own; otherwise the next step draws over the same array.
        autoreset_mode: Gymnasium's ``NextStep``, ``SameStep`` or ``Disabled``.
        arguments: passed to ``gymnasium.make``.

    Returns:
        A ``gymnasium.vector.VectorEnv``. Observations are ``image`` uint8 (N, height, width, 3), ``direction``
        int64 (N,) and ``mission``, a tuple of N strings.

    Raises:
        UserError: it is not a MiniGrid environment, or draws in its own way.
    """

    def make() -> gymnasium.Env:
        env = gymnasium.make(env_id, disable_env_checker=True, **arguments)
        inner, do = env.unwrapped, "Use gymnasium.make_vec."
        if not isinstance(inner, MiniGridEnv):
            raise UserError("make_vec draws MiniGrid's environments only", env_id, do)
        if own := [name for name in DRAWING if getattr(type(inner), name) is not getattr(MiniGridEnv, name)]:
            raise UserError(f"make_vec draws as MiniGrid does, but this has its own {', '.join(own)}", env_id, do)
        return RGBImgObsWrapper(env, tile_size)

    return MiniGridVector([make] * num_envs, copy=copy, autoreset_mode=autoreset_mode)


def row_seen(lit: NDArray[np.int64], clear: NDArray[np.int64], size: int) -> NDArray[np.int64]:
    """One row of MiniGrid's ``Grid.process_vis``, cells as bits: which are seen, plus those of the row ahead << size.

    Light spreads along the row through cells that can be seen through, and from these to the three ahead of each.
    """
    for _ in range(size - 1):
        passing = lit & clear
        lit = lit | passing << 1 | passing >> 1
    passing, row = lit & clear, (1 << size) - 1
    return (lit & row) | ((passing | passing << 1 | passing >> 1) & row) << size


@cache
def rows_seen(size: int) -> NDArray[np.int64]:
    """``row_seen`` of every ``lit << size | clear``, int64 (4**size,)."""
    return row_seen(*np.divmod(np.arange(4**size), 2**size), size)


class MiniGridVector(SyncVectorEnv):
    """N MiniGrid environments of one kind, each behind ``RGBImgObsWrapper``; made by :func:`make_vec`.

    Inside it, their own ``gen_obs`` returns an empty dictionary.
    """

    def __init__(self, env_fns: Sequence[Any], **arguments: Any):
        super().__init__(env_fns, **arguments)
        self._inner: list[Any] = [env.unwrapped for env in self.envs]
        self._plays: list[Any] = [env.env for env in self.envs]  # type: ignore[attr-defined]
        for inner in self._inner:
            inner.gen_obs = dict  # empty: to encode the partial view takes far longer than a step
        n, first = self.num_envs, self._inner[0]
        width, height, size = first.width, first.height, first.agent_view_size
        self._size, self._width, cells = size, width, width * height
        # Beyond the grid all is wall. Here it has so wide a margin that no view reaches out of it.
        stride, rows = width + 2 * size, height + 2 * size
        self._inside = np.arange(rows * stride).reshape(rows, stride)[size:-size, size:-size].ravel()
        # From the agent's cell to those of its view, row by row, farthest first: (4 directions, size * size).
        ahead, across = np.divmod(np.arange(size * size), size)
        x, y = np.transpose(DIR_TO_VEC).reshape(2, 4, 1)
        ahead, across = size - 1 - ahead, across - size // 2
        self._view = (y * ahead + x * across) * stride + x * ahead - y * across
        self._clear, self._lit = np.zeros((2, n, rows * stride), np.uint8)
        self._bits = 1 << np.arange(size)
        # Of each cell what is in it and what is drawn there: a thing's number * LOOKS, plus which of its looks.
        self._base, self._shown = np.zeros((n, cells), np.int32), np.full((n, cells), -1, np.int32)
        self._cells: list[list[Any]] = [[False] * cells for _ in range(n)]  # things as last looked at, none yet
        self._moving: list[dict[int, Any]] = [{} for _ in range(n)]  # by place, how those that may change were encoded
        space: Any = self.observation_space
        self._images = np.zeros(space["image"].shape, np.uint8)
        self._tile = self._images.shape[1] // height
        self._pixels = np.dtype(f"V{self._tile * 3}")  # a tile's pixel row, moved as one item
        self._tiles = np.zeros((0, self._tile), self._pixels)
        self._numbers: dict[tuple[type, Any] | None, int] = {}  # of things: class, and colour or MiniGrid's encoding
        self._clears = np.zeros(0, np.bool_)

    def _number(self, thing: WorldObj | None, kind: Any) -> int:
        """The number of a kind of thing; a new one is drawn."""
        if kind not in self._numbers:
            agents, lights = (None, 0, 1, 2, 3), (False, True)
            looks = [Grid.render_tile(thing, agent, lit, self._tile) for agent in agents for lit in lights]
            drawn = np.array(looks).astype(np.uint8).reshape(-1, self._tile * 3).view(self._pixels)
            self._tiles = np.concatenate([self._tiles, drawn.reshape(LOOKS, self._tile)])
            self._clears = np.append(self._clears, not thing or thing.see_behind())
            self._numbers[kind] = len(self._numbers)
        return self._numbers[kind]

    def _look(self, env: int, things: list[Any]) -> None:
        """Take in an environment's cells, where another thing is in one, or one changed."""
        changed = [place for place, (it, was) in enumerate(zip(things, self._cells[env], strict=True)) if it is not was]
        changed += self._moving[env]
        found = [things[place] for place in changed]
        kinds = [it and (type(it), it.color if type(it) in STILL else it.encode()) for it in found]
        try:
            known = [self._numbers[kind] for kind in kinds]
        except KeyError:
            known = [self._number(it, kind) for it, kind in zip(found, kinds, strict=True)]
        places, numbers = np.array(changed), np.array(known)
        self._base[env][places] = numbers * LOOKS
        self._clear[env][self._inside[places]] = self._clears[numbers]
        self._cells[env] = things[:]
        changing = [(place, *kind) for place, kind in zip(changed, kinds, strict=True) if kind]
        self._moving[env] = {place: encoded for place, its, encoded in changing if its not in STILL}

    def _draw(self) -> None:
        """Bring the images up to what the environments show now."""
        places, directions = [], []
        for env, inner in enumerate(self._inner):
            things = inner.grid.grid
            moving = self._moving[env]
            if things != self._cells[env] or [things[place].encode() for place in moving] != [*moving.values()]:
                self._look(env, things)
            x, y = inner.agent_pos
            places.append(y * self._width + x)
            directions.append(inner.agent_dir)
        self._directions, place = np.array(directions, np.int64), np.array(places)
        codes = self._base.copy()
        codes[np.arange(self.num_envs), place] += 2 + 2 * self._directions.astype(np.int32)
        if self._inner[0].highlight:
            codes += self._seen(self._inside[place])
        env, cell = (codes != self._shown).nonzero()
        y, x = np.divmod(cell, self._width)
        rows = self._images.reshape(self.num_envs, -1, self._tile, self._width * self._tile * 3).view(self._pixels)
        rows[env, y, :, x] = self._tiles[codes[env, cell]]
        self._shown = codes

    def _seen(self, place: NDArray[np.int64]) -> NDArray[np.uint8]:
        """Whether an agent at ``place`` sees each cell, uint8 (N, cells) of 0 and 1."""
        size, n = self._size, self.num_envs
        view = (np.arange(n) * self._clear.shape[1] + place)[:, None] + self._view[self._directions]
        seen: Any = 1
        if not self._inner[0].see_through_walls:
            clear = self._clear.ravel().take(view).reshape(n, size, size) @ self._bits
            rows, lit = np.empty_like(clear), np.full(n, 1 << size // 2)
            for row in reversed(range(size)):
                here = clear[:, row]
                both = rows_seen(size).take(lit << size | here) if size <= WIDEST else row_seen(lit, here, size)
                rows[:, row], lit = both, both >> size
            seen = ((rows[:, :, None] & self._bits) != 0).reshape(n, -1)
        self._lit[:] = 0
        self._lit.ravel()[view] = seen
        return self._lit[:, self._inside]

    def _observation(self) -> dict[str, Any]:
        image = self._images.copy() if self.copy else self._images
        return {"image": image, "direction": self._directions, "mission": tuple(it.mission for it in self._inner)}

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Like ``SyncVectorEnv``: environment i begins with ``seed + i`` or ``seed[i]``; ``reset_mask`` bool (N,)."""
        each, infos, options = range(self.num_envs), dict[str, Any](), dict(options or {})
        seeds = seed if isinstance(seed, Sequence) else [None if seed is None else seed + env for env in each]
        begins = np.asarray(options.pop("reset_mask", np.ones(self.num_envs, np.bool_)))
        if not len(seeds) == len(begins) == self.num_envs:
            raise ValueError(f"seed and reset_mask need one entry for each of {self.num_envs} environments")
        for env in begins.nonzero()[0].tolist():
            _, info = self._plays[env].reset(seed=seeds[env], options=options or None)
            infos = self._add_info(infos, info, env)
        self._autoreset_envs = self._autoreset_envs & ~begins
        self._draw()
        return self._observation(), infos

    def step(
        self, actions: Any
    ) -> tuple[dict[str, Any], NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]:
        """Like ``SyncVectorEnv``: observations, rewards (N,), terminated (N,), truncated (N,), infos."""
        rewards, (terminated, truncated) = np.zeros(self.num_envs), np.zeros((2, self.num_envs), np.bool_)
        waiting, given, infos = self._autoreset_envs.tolist(), [], dict[str, Any]()
        if self.autoreset_mode == AutoresetMode.DISABLED and any(waiting):
            raise ValueError("an episode has ended: reset with the option reset_mask before the next step")
        for env, (play, action) in enumerate(zip(self._plays, np.asarray(actions).tolist(), strict=True)):
            if waiting[env]:
                _, info = play.reset()
            else:
                _, rewards[env], terminated[env], truncated[env], info = play.step(action)
            given.append(info)
        over = self._autoreset_envs = terminated | truncated
        self._draw()
        if self.autoreset_mode == AutoresetMode.SAME_STEP and over.any():
            for env in over.nonzero()[0].tolist():
                inner = self._inner[env]
                last = {"image": self._images[env].copy(), "direction": inner.agent_dir, "mission": inner.mission}
                infos = self._add_info(infos, {"final_obs": last, "final_info": given[env]}, env)
                _, given[env] = self._plays[env].reset()
            self._autoreset_envs = np.zeros_like(over)
            self._draw()
        for env, info in enumerate(given):
            if info:
                infos = self._add_info(infos, info, env)
        return self._observation(), rewards, terminated, truncated, infos
