"""Three-key DoorKey on minigrid's own classes, with its layouts and its five sub-goals.

This environment is the reference. Tests compare the fast engine (``engine.py``) with it pixel by pixel and step by
step.
"""

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.utils import seeding
from minigrid.core.grid import Grid
from minigrid.core.mission import MissionSpace
from minigrid.core.world_object import Door, Goal, Key, Wall
from minigrid.minigrid_env import MiniGridEnv

from hypogoal.core.arrays import Bools, Bytes
from hypogoal.domains.tiles import TILE

SIZE = 8  # cells a side
OBSERVATION_SHAPE = (SIZE * TILE, SIZE * TILE, 3)
MAX_STEPS = 500
DOOR_COLOUR = "red"
KEY_COLOURS = ("blue", "green", "red")  # in the order of the first three sub-goals
PLACING_ORDER = ("red", "green", "blue")  # the matching key first, as in the authors' fork
SUB_GOALS = ("collect-blue-key", "collect-green-key", "collect-red-key", "open-red-door", "go-to-goal")
DOOR_LABELS = ("open", "in-front")
WRONG_KEYS = ("harmless", "ends")
MISSION = "use the red key to open the door and then get to the goal"


def judge_sub_goals(
    held: Bools,
    door_open: Bools | bool,
    facing_door: Bools | bool,
    on_goal: Bools | bool,
    door_label: str,
) -> Bools:
    """Return whether each of the five sub-goals truly holds, bool (..., 5), in the order of ``SUB_GOALS``.

    ``held`` (..., 3) is for the blue, the green and the red key. The other arrays are (...,). With ``door_label`` open,
    ``open-red-door`` holds whenever the door is open. With in-front, the agent must also face the door.

    Source: the paper's text (``in-front``), its authors' check (``open``).
    """
    opened = door_open if door_label == "open" else door_open & facing_door
    return np.concatenate([held, np.stack([opened, on_goal], axis=-1)], axis=-1)


@dataclass(frozen=True)
class GridLayout:
    """A layout of 8 x 8 cells. Cells are numbered row by row, so cell = y * 8 + x."""

    walls: frozenset[int]  # cells, without the door's
    door: int
    goal: int
    start: int  # where the agent begins
    direction: int  # 0 right, 1 down, 2 left, 3 up
    keys: tuple[int, int, int]  # the cells of the blue, the green and the red key


def number_cell(place: Any) -> int:
    """Return the number of the cell at a place x, y."""
    x, y = place
    return int(y) * SIZE + int(x)


class _RingDoor(Door):
    """MiniGrid's door, but any held key of its colour opens it, not only the key in the hand."""

    def toggle(self, env: Any, pos: tuple[int, int]) -> bool:
        """Unlock and open the door with a held key. An unlocked door opens and closes, and never locks again."""
        if self.is_locked:
            if self.color not in env.held:
                return False
            self.is_locked = False
        self.is_open = not self.is_open
        return True


class DoorKeyGrid(MiniGridEnv):
    """Three-key DoorKey with MiniGrid's dictionary observations. ``DoorKeyEnv`` returns the image instead.

    Pickup puts a key onto a ring, and drop takes the last key off the ring, as in the authors' fork.

    Args:
        max_steps: the number of steps after which an episode is truncated.
        layout_seed: the layout of every episode. None: the layout follows from ``reset(seed)``. ``layout_seed=s`` is
            the layout of ``reset(seed=s)``.
        door_label: the definition of ``open-red-door`` in ``info["labels"]``, see ``judge_sub_goals``.
        wrong_key: whether an episode ``ends`` (terminated, reward 0) once the blue or the green key is held.
    """

    def __init__(
        self,
        max_steps: int = MAX_STEPS,
        layout_seed: int | None = None,
        door_label: str = "open",
        wrong_key: str = "harmless",
        render_mode: str | None = None,
    ):
        self.layout_seed = layout_seed
        self.door_label, self.wrong_key = door_label, wrong_key
        self.ring: list[Key] = []
        super().__init__(
            mission_space=MissionSpace(mission_func=lambda: MISSION),
            grid_size=SIZE,
            max_steps=max_steps,
            render_mode=render_mode,
            highlight=False,
        )

    @property
    def held(self) -> tuple[str, ...]:
        """The colours of the keys held, in the order in which they were picked up."""
        return tuple(key.color for key in self.ring)

    def _gen_grid(self, width: int, height: int) -> None:
        episode_rng = self._np_random
        if self.layout_seed is not None:
            self._np_random, _ = seeding.np_random(self.layout_seed)
        self.ring = []
        self.grid = Grid(width, height)
        self.grid.wall_rect(0, 0, width, height)
        goal = (width - 2, height - 2)
        self.put_obj(Goal(), *goal)
        split = self._rand_int(2, width - 2)
        self.grid.vert_wall(split, 0)
        self.place_agent(size=(split, height))
        self.door = _RingDoor(DOOR_COLOUR, is_locked=True)
        door = (split, self._rand_int(1, width - 2))
        self.put_obj(self.door, *door)
        keys = {}
        for colour in PLACING_ORDER:
            keys[colour] = number_cell(self.place_obj(Key(colour), top=(0, 0), size=(split, height)))
        self.layout = GridLayout(
            walls=frozenset(cell for cell, content in enumerate(self.grid.grid) if isinstance(content, Wall)),
            door=number_cell(door),
            goal=number_cell(goal),
            start=number_cell(self.agent_pos),
            direction=int(self.agent_dir),
            keys=(keys["blue"], keys["green"], keys["red"]),
        )
        self.mission = MISSION
        self._np_random = episode_rng

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin a new episode. ``info["labels"]`` says which sub-goals truly hold."""
        observation, info = super().reset(seed=seed, options=options)
        return observation, info | {"labels": self._named_labels()}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Step as MiniGrid does, but with a key ring. The reward is 1 at the goal, and 0 elsewhere."""
        played = action
        if action in (self.actions.pickup, self.actions.drop):
            self._use_ring(pick_up=action == self.actions.pickup)
            played = self.actions.done  # an action at which MiniGrid only counts the step and observes
        observation, reward, terminated, truncated, info = super().step(played)
        wrong = self.wrong_key == "ends" and not {*self.held} <= {DOOR_COLOUR}
        return observation, float(reward), terminated or wrong, truncated, info | {"labels": self._named_labels()}

    def _use_ring(self, pick_up: bool) -> None:
        ring = self.ring
        x, y = self.front_pos
        cell = self.grid.get(x, y)
        if pick_up and isinstance(cell, Key):
            ring.append(cell)
            self.grid.set(x, y, None)
        elif not pick_up and cell is None and ring:
            self.grid.set(x, y, ring.pop())
        hand: Any = ring[-1] if ring else None
        self.carrying = hand  # which MiniGrid's own view shows

    def _reward(self) -> float:
        return 1.0

    def labels(self) -> Bools:
        """Return whether each sub-goal truly holds in the current state, bool (5,), in the order of ``SUB_GOALS``."""
        held = np.array([colour in self.held for colour in KEY_COLOURS])
        return judge_sub_goals(
            held,
            door_open=self.door.is_open,
            facing_door=self.grid.get(*self.front_pos) is self.door,
            on_goal=isinstance(self.grid.get(*self.agent_pos), Goal),
            door_label=self.door_label,
        )

    def _named_labels(self) -> dict[str, bool]:
        return dict(zip(SUB_GOALS, self.labels().tolist(), strict=True))


class DoorKeyEnv(DoorKeyGrid):
    """Three-key DoorKey, observed as the full RGB image, uint8 (64, 64, 3), without a view cone.

    The Gymnasium id is ``hypogoal/DoorKey-8x8-v0``. The seven actions are left, right, forward, pickup, drop, toggle
    and done. The arguments are those of ``DoorKeyGrid``.
    """

    def __init__(self, *args: Any, **kwargs: Any):
        super().__init__(*args, **kwargs)
        self.observation_space = spaces.Box(0, 255, OBSERVATION_SHAPE, np.uint8)

    def gen_obs(self) -> Bytes:
        """Draw what MiniGrid's ``RGBImgObsWrapper(tile_size=8)`` draws if the view cone is not tinted."""
        x, y = self.agent_pos
        return self.grid.render(TILE, (x, y), self.agent_dir)


@cache
def make_layout(layout_seed: int) -> GridLayout:
    """Return the layout of ``DoorKeyEnv(layout_seed=layout_seed)``."""
    env = DoorKeyGrid(layout_seed=layout_seed)
    env.reset()
    return env.layout
