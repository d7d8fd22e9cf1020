"""Pictures of the cells of a grid world, as MiniGrid draws them."""

from collections.abc import Iterable
from typing import Any

import numpy as np
from minigrid.core.grid import Grid

from hypogoal.core.arrays import Bytes

TILE = 8  # pixels a cell


def draw_tiles(cells: Iterable[tuple[Any, int | None]]) -> Bytes:
    """Cells, what is in each and the direction of an agent there, None without one, as uint8 (n, 8, 8, 3)."""
    pictures = [Grid.render_tile(content, direction, tile_size=TILE) for content, direction in cells]
    return np.stack(pictures).astype(np.uint8)  # MiniGrid draws in floats
