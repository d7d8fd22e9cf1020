"""The states of one DoorKey layout and MiniGrid's rules on them, for many states at once.

A state is a *configuration* (the door and where the three keys are) and a *pose* (the agent's cell and
direction). Turning and walking change the pose only and are table look-ups in NumPy. Picking up, dropping and
toggling change the configuration: rare, so worked out in plain Python the first time and remembered. Every
state met gets an id.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import Any

import numpy as np
from minigrid.core.actions import Actions
from minigrid.core.grid import Grid
from minigrid.core.world_object import Door, Goal, Key, Wall
from numpy.typing import NDArray

from hypogoal.domains.doorkey_env import DOOR_COLOUR, KEY_COLOURS, SIZE, TILE, Layout, sub_goals_reached

N_ACTIONS = len(Actions)
LEFT, RIGHT, FORWARD, PICKUP, DROP, TOGGLE, DONE = (int(action) for action in Actions)
CELLS = SIZE * SIZE
POSES = CELLS * 4  # pose = cell * 4 + direction; a power of two
HELD = CELLS  # a key's place: its cell, or HELD + rank on the ring (rank 0 was picked up first)
OPEN, CLOSED, LOCKED = 0, 1, 2  # MiniGrid's numbers
START = 0  # the id of the start state
UNKNOWN = -1

# One byte says what is drawn in a cell.
EMPTY, WALL, GOAL = 0, 1, 2
KEY = 3  # plus 0, 1, 2: blue, green, red
DOOR = 6  # plus OPEN, CLOSED, LOCKED
AGENT = 9  # plus the direction; plus 0, 4, 8: on the floor, in the open door, on the goal
N_CODES = AGENT + 12
AGENT_ON = np.zeros(N_CODES, np.uint8)
AGENT_ON[[EMPTY, DOOR + OPEN, GOAL]] = AGENT, AGENT + 4, AGENT + 8  # plus the direction

# MiniGrid's rules as tables. They are read flat: one index into a table is several times faster than two.
_POSE = np.arange(POSES)
# AHEAD: the cell in front of each pose. MOVES: the pose after each action.
AHEAD = np.clip((_POSE >> 2) + np.array((1, SIZE, -1, -SIZE))[_POSE & 3], 0, CELLS - 1)
MOVES = np.tile(_POSE, (N_ACTIONS, 1))
MOVES[LEFT] = (_POSE & ~3) | ((_POSE - 1) & 3)
MOVES[RIGHT] = (_POSE & ~3) | ((_POSE + 1) & 3)
MOVES[FORWARD] = AHEAD * 4 + (_POSE & 3)
TURN_OR_WALK = MOVES - _POSE  # as what is added to the pose
# Given the action and the code ahead: which row of MOVES applies, and may the configuration change?
MOVE_AS = np.full((N_ACTIONS, N_CODES), DONE)
MOVE_AS[LEFT], MOVE_AS[RIGHT] = LEFT, RIGHT
MOVE_AS[FORWARD, [EMPTY, GOAL, DOOR + OPEN]] = FORWARD
MAY_CHANGE = np.zeros((N_ACTIONS, N_CODES), np.bool_)
MAY_CHANGE[PICKUP, KEY : KEY + 3] = MAY_CHANGE[DROP, EMPTY] = MAY_CHANGE[TOGGLE, DOOR : DOOR + 3] = True
_AHEAD, _AGENT_ON = AHEAD.tolist(), AGENT_ON.tolist()  # one look-up in a list is faster than in an array

Configuration = tuple[int, int, int, int]  # the door; the places of the blue, the green and the red key


@cache
def tiles() -> NDArray[np.uint8]:
    """MiniGrid's drawing of each cell code, uint8 (N_CODES, 8, 8, 3)."""
    things: list[Any] = [None, Wall(), Goal(), *(Key(colour) for colour in KEY_COLOURS)]
    things += [Door(DOOR_COLOUR, is_open=state == OPEN, is_locked=state == LOCKED) for state in (OPEN, CLOSED, LOCKED)]
    drawn = [Grid.render_tile(thing, tile_size=TILE) for thing in things]
    for under in (None, things[DOOR + OPEN], things[GOAL]):
        drawn += [Grid.render_tile(under, agent_dir=direction, tile_size=TILE) for direction in range(4)]
    table = np.stack(drawn).astype(np.uint8)  # render_tile returns float64
    table.flags.writeable = False
    return table


class DoorKeyStates:
    """The states of one layout met so far; ids are stable, and START is the id of the start state.

    Args:
        layout: walls, door, goal, keys and the agent's start.
        keyring: see ``DoorKeyGrid``.
        door_label: definition of ``open-red-door``, see ``sub_goals_reached``.

    Attributes:
        n_states: ids met so far are 0 .. n_states - 1.
        rows: what each configuration shows without the agent, as 64 cell codes.
    """

    def __init__(self, layout: Layout, keyring: bool = True, door_label: str = "open"):
        self.layout, self.keyring, self.door_label = layout, keyring, door_label
        self.n_states = 0
        self.rows: list[bytes] = []
        self._configurations: list[Configuration] = []
        self._index: dict[Configuration, int] = {}
        self._changes: dict[int, int] = {}
        self._bare_codes = np.zeros((16, CELLS), np.uint8)  # of each configuration, without the agent
        self._places = np.zeros((16, 4), np.uint8)
        self._id_at = np.full((16, POSES), UNKNOWN, np.int64)  # the id of (configuration, pose)
        # Of each id: configuration * POSES + pose; where in the bare codes the cell ahead is; and so on.
        self._site = np.zeros(256, np.int64)
        self._ahead = np.zeros(256, np.int64)
        self._codes = np.zeros((256, CELLS), np.uint8)
        self._code_bytes = self._codes.data.cast("B")  # writes a row several times faster than NumPy
        self._on_goal = np.zeros(256, np.bool_)
        start = layout.start * 4 + layout.direction
        self._new_id(self._index_of((LOCKED, *layout.keys)) * POSES + start)

    @property
    def n_changes(self) -> int:
        """How many changes of a configuration have been worked out and remembered."""
        return len(self._changes)

    def step(self, ids: NDArray[np.int64], actions: NDArray[np.int64]) -> NDArray[np.int64]:
        """MiniGrid's rules: the states that follow, int64 (n,), on actions int (n,) of 0 .. 6."""
        site = self._site.take(ids)
        case = np.asarray(actions, np.int64) * N_CODES + self._bare_codes.ravel().take(self._ahead.take(ids))
        following_site = site + TURN_OR_WALK.take(MOVE_AS.take(case) * POSES + (site & (POSES - 1)))
        for index in MAY_CHANGE.take(case).nonzero()[0].tolist():
            configuration, pose = divmod(site.item(index), POSES)
            changed = self.change(configuration, _AHEAD[pose], int(actions[index]))
            following_site[index] = changed * POSES + pose
        following = self._id_at.ravel().take(following_site)
        for index in (following < 0).nonzero()[0].tolist():
            following[index] = self._new_id(following_site.item(index))
        return following

    def change(self, configuration: int, front: int, action: int) -> int:
        """The configuration after ``pickup``, ``drop`` or ``toggle`` on cell ``front``; may be the same."""
        key = (configuration * CELLS + front) * N_ACTIONS + action
        known = self._changes.get(key)
        if known is None:
            known = self._changes[key] = self._index_of(self._after(self._configurations[configuration], front, action))
        return known

    def _after(self, configuration: Configuration, front: int, action: int) -> Configuration:
        door, *keys = configuration
        held = sum(place >= HELD for place in keys)
        if action == PICKUP and front in keys and (self.keyring or not held):
            keys[keys.index(front)] = HELD + held
        elif action == DROP and held and self.rows[self._index[configuration]][front] == EMPTY:
            keys[keys.index(max(keys))] = front
        elif action == TOGGLE and front == self.layout.door and (door != LOCKED or keys[-1] >= HELD):
            door = CLOSED if door == OPEN else OPEN  # once unlocked it never locks again
        return door, keys[0], keys[1], keys[2]

    def codes(self, ids: NDArray[np.int64]) -> NDArray[np.uint8]:
        """What each cell shows, uint8 (n, 64) row by row: with ``tiles()`` it says the whole image."""
        return self._codes.take(ids, axis=0)

    def at_goal(self, ids: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Whether the agent is on the goal, bool (n,)."""
        return self._on_goal.take(ids)

    def labels(self, ids: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Spec B2: true sub-goal predicates, bool (n, G) in the order of ``SUB_GOALS``."""
        configuration, pose = np.divmod(self._site.take(ids), POSES)
        door, keys = self._places[configuration, 0], self._places[configuration, 1:]
        facing = AHEAD[pose] == self.layout.door
        return sub_goals_reached(keys >= HELD, door == OPEN, facing, self.at_goal(ids), self.door_label)

    def origins(self, ids: NDArray[np.int64]) -> dict[str, NDArray[np.int64]]:
        """Where each state is: agent_x, agent_y, direction, door_state, keys_held; int64 (n,) each.

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

    def distances(self, drop: bool = False) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Breadth-first search: ids of all states reachable from the start, nearest first, and steps to each.

        States on the goal are included and not gone beyond. Without ``drop`` they are a few thousand; with it
        some ten million.
        """
        actions = np.array([action for action in range(N_ACTIONS) if drop or action != DROP])
        found, depth = [np.array([START])], 0
        seen = np.ones(1, np.bool_)
        steps = [np.zeros(1, np.int64)]
        while len(found[-1]):
            origin = found[-1][~self.at_goal(found[-1])]
            following = np.unique(self.step(np.repeat(origin, len(actions)), np.tile(actions, len(origin))))
            seen = np.concatenate([seen, np.zeros(self.n_states - len(seen), np.bool_)])
            new = following[~seen[following]]
            seen[new] = True
            depth += 1
            found.append(new)
            steps.append(np.full(len(new), depth))
        return np.concatenate(found), np.concatenate(steps)

    def reachable(self, drop: bool = False) -> NDArray[np.int64]:
        """Ids of all states reachable from the start, nearest first, one for each image.

        States that differ only in the order of the keys on the ring look the same; the first one found stands
        for them all.
        """
        ids, _ = self.distances(drop)
        images = self.codes(ids).view(f"V{CELLS}")[:, 0]
        _, first = np.unique(images, return_index=True)
        return ids[np.sort(first)]

    def snapshot(self) -> dict[str, NDArray[Any]]:
        """All ids given so far, as arrays: ``restore`` on fresh states of the layout gives the same ids."""
        return {
            "configurations": np.array(self._configurations, np.uint8),
            "sites": self._met().copy(),
        }

    def _met(self) -> NDArray[np.int64]:
        return self._site[: self.n_states]

    def restore(self, snapshot: Mapping[str, NDArray[Any]]) -> None:
        """Continue from a ``snapshot`` of the same layout, of states that were met in the order of these.

        Raises:
            ValueError: states were met that the snapshot does not begin with, or it is of another layout.
        """
        begun = [tuple(known) for known in snapshot["configurations"][: len(self._configurations)].tolist()]
        if begun != self._configurations or snapshot["sites"][: self.n_states].tolist() != self._met().tolist():
            raise ValueError("a snapshot is restored onto states of its own layout, met in the same order")
        for door, *keys in snapshot["configurations"].tolist():
            self._index_of((door, keys[0], keys[1], keys[2]))
        for site in snapshot["sites"].tolist():
            self._new_id(site)

    def _new_id(self, site: int) -> int:
        known = self._id_at.item(site)
        if known != UNKNOWN:  # met twice in one vector step
            return known
        new = self.n_states
        if new == len(self._site):
            self._site, self._ahead, self._codes, self._on_goal = (
                _doubled(table) for table in (self._site, self._ahead, self._codes, self._on_goal)
            )
            self._code_bytes = self._codes.data.cast("B")
        configuration, pose = divmod(site, POSES)
        cell = pose >> 2
        row = bytearray(self.rows[configuration])
        row[cell] = _AGENT_ON[row[cell]] + (pose & 3)
        self._code_bytes[new * CELLS : (new + 1) * CELLS] = row
        self._site[new], self._ahead[new] = site, configuration * CELLS + _AHEAD[pose]
        self._on_goal[new] = cell == self.layout.goal
        self._id_at[configuration, pose] = new
        self.n_states += 1
        return new

    def _index_of(self, configuration: Configuration) -> int:
        known = self._index.get(configuration)
        if known is not None:
            return known
        new = len(self._configurations)
        if new == len(self._bare_codes):
            self._bare_codes, self._places, self._id_at = (
                _doubled(self._bare_codes),
                _doubled(self._places),
                _doubled(self._id_at, UNKNOWN),
            )
        row = bytearray(CELLS)
        for cell in self.layout.walls:
            row[cell] = WALL
        row[self.layout.goal] = GOAL
        row[self.layout.door] = DOOR + configuration[0]
        for colour, place in enumerate(configuration[1:]):
            if place < HELD:
                row[place] = KEY + colour
        self._index[configuration] = new
        self._configurations.append(configuration)
        self.rows.append(bytes(row))
        self._bare_codes[new] = np.frombuffer(row, np.uint8)
        self._places[new] = configuration
        return new


def _doubled(table: NDArray[Any], filling: int = 0) -> NDArray[Any]:
    """The table with as many rows again, of ``filling``."""
    return np.concatenate([table, np.full_like(table, filling)])
