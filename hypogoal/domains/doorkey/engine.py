"""The fast DoorKey engine for training; tests compare it with ``DoorKeyEnv`` step by step.

Drawing is 99 % of MiniGrid's cost. Here a step is a few table look-ups for all environments together, and an image is
eight strips, rows of cells, of which few differ: each is drawn once.

A state is a *configuration* (the layout, its door and where its three keys are) and a *pose* (the agent's cell and
direction). Turning and walking change the pose only and are table look-ups in NumPy. Picking up, dropping and
toggling change the configuration; they are rare, so plain Python computes each change once and remembers it. Every
state reached gets an id.
"""

from collections.abc import Mapping
from functools import cache
from typing import Any

import numpy as np
from minigrid.core.actions import Actions
from minigrid.core.grid import Grid
from minigrid.core.world_object import Door, Goal, Key, Wall
from numpy.typing import NDArray

from hypogoal.domains.base import Engine, Layouts, Plan, Step
from hypogoal.domains.doorkey.env import (
    DOOR_COLOUR,
    KEY_COLOURS,
    MAX_STEPS,
    OBSERVATION_SHAPE,
    SIZE,
    TILE,
    Layout,
    layout_of,
    sub_goals_reached,
)

N_ACTIONS = len(Actions)
LEFT, RIGHT, FORWARD, PICKUP, DROP, TOGGLE, DONE = (int(action) for action in Actions)
SEARCHED = np.delete(np.arange(N_ACTIONS), DROP)  # in the search for reachable states
CELLS = SIZE * SIZE
POSES = CELLS * 4  # pose = cell * 4 + direction; a power of two
HELD = CELLS  # a key's place: its cell, or HELD + rank on the ring (rank 0 was picked up first)
OPEN, CLOSED, LOCKED = 0, 1, 2  # MiniGrid's numbers
START = 0  # the id of the start state; with several layouts, of the first one played
UNKNOWN = -1

# One byte per cell encodes its picture.
EMPTY, WALL, GOAL = 0, 1, 2
KEY = 3  # plus 0, 1, 2: blue, green, red
DOOR = 6  # plus OPEN, CLOSED, LOCKED
AGENT = 9  # plus the direction; plus 0, 4, 8: on the floor, in the open door, on the goal
N_CODES = AGENT + 12
AGENT_ON = np.zeros(N_CODES, np.uint8)
AGENT_ON[[EMPTY, DOOR + OPEN, GOAL]] = AGENT, AGENT + 4, AGENT + 8  # plus the direction

# MiniGrid's rules as tables, read flat: one index into a table is several times faster than two.
_POSE = np.arange(POSES)
# AHEAD: the cell in front of each pose. MOVES: the pose after each action.
AHEAD = np.clip((_POSE >> 2) + np.array((1, SIZE, -1, -SIZE))[_POSE & 3], 0, CELLS - 1)
MOVES = np.tile(_POSE, (N_ACTIONS, 1))
MOVES[LEFT] = (_POSE & ~3) | ((_POSE - 1) & 3)
MOVES[RIGHT] = (_POSE & ~3) | ((_POSE + 1) & 3)
MOVES[FORWARD] = AHEAD * 4 + (_POSE & 3)
TURN_OR_WALK = MOVES - _POSE  # what to add to the pose
# For each action and code ahead: which row of MOVES applies, and may the configuration change?
MOVE_AS = np.full((N_ACTIONS, N_CODES), DONE)
MOVE_AS[LEFT], MOVE_AS[RIGHT] = LEFT, RIGHT
MOVE_AS[FORWARD, [EMPTY, GOAL, DOOR + OPEN]] = FORWARD
MAY_CHANGE = np.zeros((N_ACTIONS, N_CODES), np.bool_)
MAY_CHANGE[PICKUP, KEY : KEY + 3] = MAY_CHANGE[DROP, EMPTY] = MAY_CHANGE[TOGGLE, DOOR : DOOR + 3] = True
STRIP = SIZE * TILE * TILE * 3  # bytes of a row of cells in an image, one after another
_AHEAD, _AGENT_ON = AHEAD.tolist(), AGENT_ON.tolist()  # one look-up in a list is faster than in an array

Configuration = tuple[int, ...]  # the layout's seed; the door; the places of the blue, the green and the red key


@cache
def tiles() -> NDArray[np.uint8]:
    """MiniGrid's picture of each cell code, uint8 (N_CODES, 8, 8, 3)."""
    objects: list[Any] = [None, Wall(), Goal(), *(Key(colour) for colour in KEY_COLOURS)]
    objects += [Door(DOOR_COLOUR, is_open=state == OPEN, is_locked=state == LOCKED) for state in (OPEN, CLOSED, LOCKED)]
    drawn = [Grid.render_tile(item, tile_size=TILE) for item in objects]
    for under in (None, objects[DOOR + OPEN], objects[GOAL]):
        drawn += [Grid.render_tile(under, agent_dir=direction, tile_size=TILE) for direction in range(4)]
    table = np.stack(drawn).astype(np.uint8)  # render_tile returns float64
    table.flags.writeable = False
    return table


class DoorKeyEngine(Engine):
    """Many environments of one layout or several, stepped together; ids are stable, the start state has START.

    Arguments as for ``DoorKeyEnv``, except ``layout``, a layout, a seed or several, and ``count``, the number of
    environments.
    """

    n_actions = N_ACTIONS
    observation_shape = OBSERVATION_SHAPE
    restarts = resumes = True
    n_states = 0

    def __init__(
        self,
        layout: int | Layout | Layouts,
        count: int = 1,
        *,
        max_steps: int = MAX_STEPS,
        door_label: str = "open",
        wrong_key: str = "harmless",
    ):
        self.harsh = wrong_key == "ends"
        self.known: dict[int, Layout] = {0: layout} if isinstance(layout, Layout) else {}  # layouts played, by seed
        seed = 0 if isinstance(layout, Layout) else layout
        self.layouts: Layouts = seed if isinstance(seed, Layouts) else Layouts((seed,))
        self.count, self.max_steps, self.door_label = count, max_steps, door_label
        self.changes: dict[int, int] = {}  # computed next configurations, by configuration, cell, action
        self._numbers: dict[Configuration, int] = {}
        # For each configuration: its layout's seed and door cell; its door and keys; its cell codes without the agent,
        # twice; ids by pose.
        self._seeds: list[int] = []
        self._doors = np.zeros(16, np.int64)
        self._places = np.zeros((16, 4), np.uint8)
        self._bare_codes = np.zeros((16, CELLS), np.uint8)
        self._rows: list[bytes] = []
        self._id_at = np.full((16, POSES), UNKNOWN, np.int64)
        # For each id: configuration * POSES + pose; the index of the cell ahead in the bare codes; and so on.
        self._site = np.zeros(256, np.int64)
        self._ahead = np.zeros(256, np.int64)
        self._codes = np.zeros((256, CELLS), np.uint8)
        self._code_bytes = self._codes.data.cast("B")  # writes a row several times faster than NumPy
        self._strips = np.full((256, SIZE), UNKNOWN)  # the strips of each id's image, once it was asked for
        self._on_goal = np.zeros(256, np.bool_)
        self._final = np.zeros(256, np.bool_)
        self._drawn = np.zeros((256, STRIP), np.uint8)
        self._strip_of: dict[int, int] = {}  # by the row's codes as one number
        self.reset()

    @property
    def tiles(self) -> NDArray[np.uint8]:
        return tiles()

    def restart(self, where: NDArray[np.bool_]) -> None:
        self.ids, self.elapsed = self.ids.copy(), np.where(where, 0, self.elapsed)
        for number in where.nonzero()[0].tolist():
            self.ids[number] = self._start(self.layouts.begin(number))

    def _start(self, seed: int) -> int:
        """The start state of a layout."""
        layout = self._layout(seed)
        start = layout.start * 4 + layout.direction
        return self._new_id(self._number_of((seed, LOCKED, *layout.keys)) * POSES + start)

    def _layout(self, seed: int) -> Layout:
        if seed not in self.known:
            self.known[seed] = layout_of(seed)
        return self.known[seed]

    def step(self, actions: NDArray[np.int64]) -> Step:
        next_ids = self.follow(self.ids, actions)
        terminated = self._final.take(next_ids)
        self.ids, self.elapsed = next_ids, self.elapsed + 1
        truncated = self.elapsed >= self.max_steps
        self.restart(terminated | truncated)
        return Step(next_ids, self.at_goal(next_ids).astype(np.float32), terminated, truncated)

    def follow(self, ids: NDArray[np.int64], actions: NDArray[np.int64]) -> NDArray[np.int64]:
        """MiniGrid's rules: the next states, int64 (n,), after actions int (n,) of 0 .. 6."""
        site = self._site.take(ids)
        case = np.asarray(actions, np.int64) * N_CODES + self._bare_codes.ravel().take(self._ahead.take(ids))
        following_site = site + TURN_OR_WALK.take(MOVE_AS.take(case) * POSES + (site & (POSES - 1)))
        for index in MAY_CHANGE.take(case).nonzero()[0].tolist():
            configuration, pose = divmod(site.item(index), POSES)
            changed = self._changed(configuration, _AHEAD[pose], int(actions[index]))
            following_site[index] = changed * POSES + pose
        following = self._id_at.ravel().take(following_site)
        for index in (following < 0).nonzero()[0].tolist():
            following[index] = self._new_id(following_site.item(index))
        return following

    def _changed(self, configuration: int, front: int, action: int) -> int:
        """The configuration after ``pickup``, ``drop`` or ``toggle`` on cell ``front``, possibly unchanged."""
        key = (configuration * CELLS + front) * N_ACTIONS + action
        if (changed := self.changes.get(key)) is not None:
            return changed
        (door, *keys), seed = self._places[configuration].tolist(), self._seeds[configuration]
        held = sum(place >= HELD for place in keys)
        if action == PICKUP and front in keys:
            keys[keys.index(front)] = HELD + held
        elif action == DROP and held and self._rows[configuration][front] == EMPTY:
            keys[keys.index(max(keys))] = front
        elif action == TOGGLE and front == self.known[seed].door and (door != LOCKED or keys[-1] >= HELD):
            door = CLOSED if door == OPEN else OPEN  # once unlocked it never locks again
        self.changes[key] = self._number_of((seed, door, *keys))
        return self.changes[key]

    def images(self, ids: NDArray[np.int64], out: NDArray[np.uint8] | None = None) -> NDArray[np.uint8]:
        out = self.room_for(len(ids), out)
        strips = self._strips.take(ids, axis=0)
        if (strips[:, 0] == UNKNOWN).any():
            self._draw(np.unique(ids[strips[:, 0] == UNKNOWN]))
            strips = self._strips.take(ids, axis=0)
        self._drawn.take(strips, axis=0, out=out.reshape(len(out), SIZE, STRIP), mode="clip")  # unbuffered
        return out

    def _draw(self, ids: NDArray[np.int64]) -> None:
        """Find these states' strips among those that were drawn, and draw the others."""
        codes = self.codes(ids).reshape(-1, SIZE)
        for row, key in enumerate(codes.view(np.uint64)[:, 0].tolist()):
            if key not in self._strip_of:
                new = self._strip_of[key] = len(self._strip_of)
                if new == len(self._drawn):
                    self._drawn = _doubled(self._drawn)
                self._drawn[new] = tiles()[codes[row]].transpose(1, 0, 2, 3).ravel()
            self._strips[ids[row // SIZE], row % SIZE] = self._strip_of[key]

    def codes(self, ids: NDArray[np.int64]) -> NDArray[np.uint8]:
        """Each state's cell codes, uint8 (n, 64) row by row; with ``tiles()`` they give the whole image."""
        return self._codes.take(ids, axis=0)

    def at_goal(self, ids: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Whether the agent is on the goal, bool (n,)."""
        return self._on_goal.take(ids)

    def labels(self, ids: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Spec B2: true sub-goal predicates, bool (n, G) in the order of ``SUB_GOALS``."""
        configuration, pose = np.divmod(self._site.take(ids), POSES)
        door, keys = self._places[configuration, 0], self._places[configuration, 1:]
        facing = AHEAD[pose] == self._doors[configuration]
        return sub_goals_reached(keys >= HELD, door == OPEN, facing, self.at_goal(ids), self.door_label)

    def origins(self, ids: NDArray[np.int64]) -> dict[str, NDArray[np.int64]]:
        """The states' origins: agent_x, agent_y, direction, door_state, keys_held; int64 (n,) each.

        ``door_state`` is MiniGrid's (0 open, 1 closed, 2 locked); ``keys_held`` has bit 0 for the blue, 1 for
        the green, 2 for the red key.
        """
        configuration, pose = np.divmod(self._site.take(ids), POSES)
        held = self._places[configuration, 1:] >= HELD
        return {
            "agent_x": (pose >> 2) % SIZE,
            "agent_y": (pose >> 2) // SIZE,
            "direction": pose & 3,
            "door_state": self._places[configuration, 0].astype(np.int64),
            "keys_held": held @ np.array([1, 2, 4]),
        }

    def distances(self, starts: NDArray[np.int64] | None = None) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Breadth-first search: ids of all states reachable from the starts, nearest first, and the steps to each.

        ``starts`` are ids (n,), by default those of all layouts.

        The search stops at states in which the episode ends. It never drops a key: that leaves a few thousand states
        per layout instead of some ten million.
        """
        if starts is None:
            starts = np.array([self._start(seed) for seed in self.layouts.seeds])
        rings, depth = [starts], 0
        seen, steps = np.zeros(self.n_states, np.bool_), [np.zeros(len(rings[0]), np.int64)]
        seen[rings[0]] = True
        while len(rings[-1]):
            origin = rings[-1][~self._final[rings[-1]]]
            following = np.unique(self.follow(np.repeat(origin, len(SEARCHED)), np.tile(SEARCHED, len(origin))))
            seen = np.concatenate([seen, np.zeros(self.n_states - len(seen), np.bool_)])
            new = following[~seen[following]]
            seen[new] = True
            depth += 1
            rings.append(new)
            steps.append(np.full(len(new), depth))
        return np.concatenate(rings), np.concatenate(steps)

    def reachable(self) -> NDArray[np.int64]:
        """Ids of all states reachable from the start, nearest first, one for each image.

        States that differ only in the order of the keys on the ring look the same; the first represents them all.
        """
        ids, _ = self.distances()
        images = self.codes(ids).view(f"V{CELLS}")[:, 0]
        _, first = np.unique(images, return_index=True)
        return ids[np.sort(first)]

    def plan(self, starts: NDArray[np.int64] | None = None) -> Plan:
        """The transitions between all states, except some ten million that only dropping a key leads to."""
        ids, actions = self.distances(starts)[0], SEARCHED
        final = self._final[ids]
        following = np.repeat(ids[:, None], len(actions), axis=1)
        each = np.broadcast_to(actions, following.shape)[~final]
        following[~final] = self.follow(following[~final].ravel(), each.ravel()).reshape(each.shape)
        return Plan(ids, actions, following, final, self.at_goal(ids))

    def shortest_path(self) -> int | None:
        """The fewest primitive steps to the goal; None with several layouts, or if only a wrong key clears the way."""
        if self.layouts.many:
            return None
        ids, steps = self.distances()
        at_goal = self.at_goal(ids)
        return int(steps[at_goal].min()) if at_goal.any() else None

    def random_success(self, episodes: int, rng: np.random.Generator) -> float:
        """Spec F5: the share of ``episodes`` of uniform-random actions that reach the goal within ``max_steps``."""
        seeds = list(self.layouts.seeds) * episodes
        if self.layouts.many:
            seeds = rng.choice(self.layouts.seeds, episodes).tolist()
        ids, solved = np.array([self._start(seed) for seed in seeds], np.int64), 0
        for _ in range(self.max_steps):
            ids = self.follow(ids, rng.integers(N_ACTIONS, size=len(ids)))
            solved += int(self.at_goal(ids).sum())
            ids = ids[~self._final[ids]]
        return solved / episodes

    def snapshot(self) -> dict[str, Any]:
        """All that a resumed run needs: each environment's state, and the ids assigned so far."""
        return {
            **super().snapshot(),
            "configurations": self._places[: len(self._rows)].copy(),
            "sites": self._site[: self.n_states].copy(),
            **({"seeds": np.array(self._seeds)} if self.layouts.many else {}),
        }

    def restore(self, snapshot: Mapping[str, Any]) -> None:
        """Continue from a ``snapshot`` of an engine made with the same arguments; call it before the first step."""
        configurations = snapshot["configurations"].tolist()
        seeds = snapshot["seeds"].tolist() if self.layouts.many else self.layouts.seeds * len(configurations)
        for seed, configuration in zip(seeds, configurations, strict=True):
            self._number_of((seed, *configuration))
        for site in snapshot["sites"].tolist():
            self._new_id(site)
        super().restore(snapshot)

    def _new_id(self, site: int) -> int:
        state = self._id_at.item(site)
        if state != UNKNOWN:  # reached twice in one vector step
            return state
        new = self.n_states
        if new == len(self._site):
            self._site, self._ahead, self._codes, self._on_goal, self._final = (
                _doubled(table) for table in (self._site, self._ahead, self._codes, self._on_goal, self._final)
            )
            self._code_bytes = self._codes.data.cast("B")
            self._strips = _doubled(self._strips, UNKNOWN)
        configuration, pose = divmod(site, POSES)
        cell = pose >> 2
        row = bytearray(self._rows[configuration])
        row[cell] = _AGENT_ON[row[cell]] + (pose & 3)
        self._code_bytes[new * CELLS : (new + 1) * CELLS] = row
        self._site[new], self._ahead[new] = site, configuration * CELLS + _AHEAD[pose]
        self._on_goal[new] = cell == self.known[self._seeds[configuration]].goal
        wrong = self.harsh and bool((self._places[configuration, 1:3] >= HELD).any())
        self._final[new] = self._on_goal[new] or wrong
        self._id_at[configuration, pose] = new
        self.n_states += 1
        return new

    def _number_of(self, configuration: Configuration) -> int:
        if (number := self._numbers.get(configuration)) is not None:
            return number
        new = self._numbers[configuration] = len(self._rows)
        if new == len(self._places):
            self._places, self._bare_codes = _doubled(self._places), _doubled(self._bare_codes)
            self._doors = _doubled(self._doors)
            self._id_at = _doubled(self._id_at, UNKNOWN)
        seed, door, *keys = configuration
        row, layout = bytearray(CELLS), self._layout(seed)
        for cell in layout.walls:
            row[cell] = WALL
        row[layout.goal] = GOAL
        row[layout.door] = DOOR + door
        for colour, place in enumerate(keys):
            if place < HELD:
                row[place] = KEY + colour
        self._rows.append(bytes(row))
        self._bare_codes[new] = np.frombuffer(row, np.uint8)
        self._seeds.append(seed)
        self._doors[new], self._places[new] = layout.door, configuration[1:]
        return new


def _doubled(table: NDArray[Any], filling: int = 0) -> NDArray[Any]:
    """The table with twice as many rows, the new ones of ``filling``."""
    return np.concatenate([table, np.full_like(table, filling)])
