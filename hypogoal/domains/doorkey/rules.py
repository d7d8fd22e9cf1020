"""MiniGrid's rules as tables, and one byte for what is drawn in a cell."""

from functools import cache
from itertools import product

import numpy as np
from minigrid.core.actions import Actions
from minigrid.core.world_object import Door, Goal, Key, Wall

from hypogoal.core.arrays import Bytes
from hypogoal.domains.doorkey.env import DOOR_COLOUR, KEY_COLOURS, SIZE
from hypogoal.domains.tiles import draw_tiles

N_ACTIONS = len(Actions)
LEFT, RIGHT, FORWARD, PICKUP, DROP, TOGGLE, DONE = map(int, Actions)
SEARCHED = np.delete(np.arange(N_ACTIONS), DROP)  # the actions tried in the search for reachable states
CELLS = SIZE * SIZE
POSES = CELLS * 4  # pose = cell * 4 + direction; a power of two
HELD = CELLS  # a key's place is its cell, or HELD + its rank on the ring, where rank 0 was picked up first
KEY_BITS = np.array([1, 2, 4])  # of the blue, the green and the red key
OPEN, CLOSED, LOCKED = 0, 1, 2  # MiniGrid's numbers for a door

# One byte per cell encodes its picture.
EMPTY, WALL, GOAL = 0, 1, 2
KEY = 3  # plus 0, 1, 2: blue, green, red
DOOR = 6  # plus OPEN, CLOSED, LOCKED
AGENT = 9  # plus the direction; plus 0, 4, 8: on the floor, in the open door, on the goal
N_CODES = AGENT + 12
AGENT_ON = np.zeros(N_CODES, np.uint8)
AGENT_ON[EMPTY] = AGENT  # plus the direction
AGENT_ON[DOOR + OPEN] = AGENT + 4
AGENT_ON[GOAL] = AGENT + 8

# MiniGrid's rules as tables. They are read flat, because one index into a table is several times faster than two.
_POSE = np.arange(POSES)
_CELL, _DIRECTION = np.divmod(_POSE, 4)
_ONE_ON = np.array((1, SIZE, -1, -SIZE))  # what to add to a cell to get the next cell, by direction
AHEAD = np.clip(_CELL + _ONE_ON[_DIRECTION], 0, CELLS - 1)  # the cell in front of each pose
# MOVES is what to add to the pose, by action, code ahead and pose. MAY_CHANGE is whether the configuration may change.
MOVES = np.zeros((N_ACTIONS, N_CODES, POSES), int)
MOVES[LEFT] = (_DIRECTION - 1) % 4 - _DIRECTION
MOVES[RIGHT] = (_DIRECTION + 1) % 4 - _DIRECTION
MOVES[FORWARD, [EMPTY, GOAL, DOOR + OPEN]] = (AHEAD - _CELL) * 4
MAY_CHANGE = np.zeros((N_ACTIONS, N_CODES), bool)
MAY_CHANGE[PICKUP, KEY : KEY + 3] = True
MAY_CHANGE[DROP, EMPTY] = True
MAY_CHANGE[TOGGLE, DOOR : DOOR + 3] = True


@cache
def tiles() -> Bytes:
    """Draw MiniGrid's picture of each cell code, uint8 (N_CODES, 8, 8, 3)."""
    goal, open_door = Goal(), Door(DOOR_COLOUR, is_open=True)
    keys = [Key(colour) for colour in KEY_COLOURS]
    doors = [open_door, Door(DOOR_COLOUR), Door(DOOR_COLOUR, is_locked=True)]
    objects = [None, Wall(), goal, *keys, *doors]
    with_agent = product((None, open_door, goal), range(4))
    table = draw_tiles([*product(objects, [None]), *with_agent])
    table.flags.writeable = False
    return table
