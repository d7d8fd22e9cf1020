"""Spec H1: the same features, but objects of any size at any pixel, over textures: no picture is made of tiles."""

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from hypogoal.which_feature.states import (
    AGENT,
    BOX,
    BOX_COLOURS,
    FLOOR,
    GOAL,
    MOST_BOXES,
    OBJECT,
    SIDE,
    Scenes,
    completed,
    tiles,
)

SMALLEST, LARGEST = 10, 12  # pixels of an item
LAYERS = ((3, 25.0), (8, 20.0), (SIDE, 8.0))  # of a texture: points per side, deviation of their shades
SHADE, DARKEST = 70.0, 0.7  # mean of a texture; least light on an item
TRIES = 64  # places tried for an item that overlaps no other


def textured(factors: NDArray[np.bool_], names: Sequence[str], rng: np.random.Generator) -> Scenes:
    """Scenes of one frame with these factors, bool (N, F), of the items of :func:`.states.drawn`; all else is random.

    The object lies within its half of the picture, on top where items overlap.
    """
    count = len(factors)
    colour, shape, place, many = completed(factors, names, rng)
    boxes = BOX + rng.integers(len(BOX_COLOURS), size=(count, MOST_BOXES))
    number = 1 + rng.integers(2, size=count) + 2 * many
    items = np.full((count, MOST_BOXES + 3), FLOOR)
    items[:, 0] = OBJECT + 2 * shape + colour
    items[:, 1 : 1 + MOST_BOXES] = np.where(np.arange(MOST_BOXES) < number[:, None], boxes, FLOOR)
    items[:, -2] = AGENT + rng.integers(4, size=count)
    items[:, -1] = np.where(rng.random(count) < 0.5, GOAL, FLOOR)
    sizes = rng.integers(SMALLEST, LARGEST + 1, size=items.shape)
    corners, light = _corners(sizes, place, rng), rng.uniform(DARKEST, 1.0, size=items.shape)
    pictures = _textures(count, rng)
    for row, item in np.argwhere(items[:, ::-1] != FLOOR):
        item = items.shape[1] - 1 - item  # the object last
        (y, x), size, kind = corners[row, item], sizes[row, item], items[row, item]
        inside, sprite = pictures[row, y : y + size, x : x + size], tiles(int(size))[kind]
        shown = _outlines(int(size))[kind]
        inside[shown] = sprite[shown] * light[row, item]
    return Scenes(pictures, factors)


@lru_cache(maxsize=LARGEST)
def _outlines(size: int) -> NDArray[np.bool_]:
    """Which pixels of each kind of tile are not floor, bool (kinds, size, size)."""
    return (tiles(size) != tiles(size)[FLOOR]).any(-1)


def _corners(sizes: NDArray[np.int64], place: NDArray[np.int64], rng: np.random.Generator) -> NDArray[np.int64]:
    """Top left corners (N, items, 2), row and column; the first items lie in the left (0) or right half (1)."""
    count, half = len(sizes), SIDE // 2
    corners = np.zeros((*sizes.shape, 2), np.int64)
    for item, size in enumerate(sizes.T[:, :, None, None]):  # (N, 1, 1)
        room = np.array([SIDE, SIDE if item else half]) - size + 1
        tries = (rng.random((count, TRIES, 2)) * room).astype(np.int64)
        if item == 0:
            tries[..., 1] += half * place[:, None]
        earlier, extent = corners[:, None, :item], sizes[:, None, :item, None]
        places = tries[:, :, None]
        apart = ((places >= earlier + extent) | (earlier >= places + size[..., None])).any(-1).all(-1)
        corners[:, item] = tries[np.arange(count), apart.argmax(1)]
    return corners


def _textures(count: int, rng: np.random.Generator) -> NDArray[np.uint8]:
    """Pictures (N, 48, 48, 3) of coloured noise on several scales, each interpolated between its points."""
    pictures = np.full((count, SIDE, SIDE, 3), SHADE)
    for points, deviation in LAYERS:
        noise = rng.normal(0.0, deviation, (count, points, points, 3))
        places = np.arange(SIDE)[:, None] * (points - 1) / (SIDE - 1)
        weights = np.maximum(0.0, 1.0 - np.abs(places - np.arange(points)))  # (48, points)
        pictures += np.einsum("yi,xj,nijc->nyxc", weights, weights, noise, optimize=True)
    return pictures.clip(0, 255).astype(np.uint8)
