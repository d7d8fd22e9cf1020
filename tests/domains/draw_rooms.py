"""The tiles of rooms by MiniGrid; ``python -m tests.domains.draw_rooms`` writes them where rooms reads them."""

from itertools import product
from pathlib import Path

import numpy as np
from minigrid.core.world_object import Ball, Box, Goal, Key, Wall

from hypogoal.core.arrays import Bytes
from hypogoal.domains.rooms import states
from hypogoal.domains.tiles import draw_tiles


def drawn() -> Bytes:
    """Every kind of tile, uint8 (kinds, 8, 8, 3): floor, wall, agents, objects, boxes, goal."""
    boxes = [Box(colour) for colour in states.BOX_COLOURS]
    objects = [
        Key("red"),
        Key("blue"),
        Ball("red"),
        Ball("blue"),
        *boxes,
        Goal(),
    ]
    agents = product([None], range(4))
    return draw_tiles([(None, None), (Wall(), None), *agents, *product(objects, [None])])


if __name__ == "__main__":
    np.save(Path(states.__file__).with_name("tiles.npy"), drawn())
