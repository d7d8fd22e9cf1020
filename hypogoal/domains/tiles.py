"""Pictures of the cells of a grid world, as MiniGrid draws them."""

from collections.abc import Iterable
from typing import Any

import numpy as np

from hypogoal.core.arrays import Bytes

TILE = 8  # pixels on the side of a cell


def draw_tiles(cells: Iterable[tuple[Any, int | None]]) -> Bytes:
    """Draw the pictures of n cells, uint8 (n, 8, 8, 3).

    A cell is what is in it, and the direction of the agent in it, or None if there is no agent.
    """
    from minigrid.core.grid import Grid  # here, because rooms need only TILE, and this import takes long

    pictures = [Grid.render_tile(content, direction, tile_size=TILE) for content, direction in cells]
    return np.stack(pictures).astype(np.uint8)  # MiniGrid draws in floats
