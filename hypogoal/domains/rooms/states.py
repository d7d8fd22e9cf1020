"""Spec H1: scenes with planted factors, drawn with MiniGrid's tiles, and the truth of each factor."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from itertools import product

import numpy as np
from minigrid.core.grid import Grid
from minigrid.core.world_object import Ball, Box, Goal, Key, Wall
from numpy.typing import NDArray

from hypogoal.core.seeding import rng_for

FACTORS = ("colour", "shape", "place", "count")
MEANINGS = {
    "colour": "the object is blue",
    "shape": "the object is a ball",
    "place": "the object is in the right half",
    "count": "there are three or four boxes",
}
INNER, TILE = 4, 8  # free cells per side within the walls; pixels per cell
SIDE = (INNER + 2) * TILE  # pixels of an image
CELLS = INNER * INNER
BOX_COLOURS = ("yellow", "purple", "grey")
MOST_BOXES = 4  # few: one or two; many: three or four
FLOOR, WALL, AGENT, OBJECT, BOX, GOAL = 0, 1, 2, 6, 10, 13  # index of the first tile of each kind


@dataclass(frozen=True)
class Scenes:
    """Scenes and which factors hold in them, see ``MEANINGS``."""

    observations: NDArray[np.uint8]  # (N, 48, 48, 3)
    factors: NDArray[np.bool_]  # (N, F), the requested ones; others are drawn evenly


def labelled_states(count: int, seed: int, names: Sequence[str]) -> Scenes:
    """The labelled context: every factor holds in half of the states, the positives, and none in the others."""
    rng = rng_for(seed, "which-feature", "labelled")
    holds = rng.permutation(np.arange(count) % 2 == 0)
    return drawn(np.repeat(holds[:, None], len(names), axis=1), names, rng)


def unlabelled_states(count: int, mix: float, seed: int, names: Sequence[str]) -> Scenes:
    """States without labels.

    ``mix`` is the probability that a state's factors are drawn independently and evenly; else all are one even bit.
    """
    rng = rng_for(seed, "which-feature", "unlabelled")
    independent, joint = rng.random((count, len(names))) < 0.5, rng.random((count, 1)) < 0.5
    return drawn(np.where(rng.random((count, 1)) < mix, independent, joint), names, rng)


def crossed_states(copies: int, seed: int, names: Sequence[str]) -> Scenes:
    """Every combination of factors ``copies`` times, in random order."""
    rng = rng_for(seed, "which-feature", "test")
    every = np.array(list(product((False, True), repeat=len(names))))
    return drawn(rng.permutation(np.repeat(every, copies, axis=0)), names, rng)


def drawn(factors: NDArray[np.bool_], names: Sequence[str], rng: np.random.Generator) -> Scenes:
    """Scenes with these factors, bool (N, F); everything else is random and independent of them."""
    count, truth = len(factors), dict(zip(names, factors.T, strict=True))
    for name in FACTORS:
        if name not in truth:
            truth[name] = rng.random(count) < 0.5
    colour, shape, place, many = (truth[name].astype(np.int64) for name in FACTORS)
    rows = np.arange(count)
    x, y = rng.integers(INNER // 2, size=count) + place * (INNER // 2), rng.integers(INNER, size=count)
    up = np.where(y == 0, False, (y == INNER - 1) | (rng.random(count) < 0.5))
    cell, beside = y * INNER + x, np.where(up, y - 1, y + 1) * INNER + x
    order = rng.random((count, CELLS))
    order[rows, cell], order[rows, beside] = -1.0, 2.0  # nothing else stands where the object is, nor on one side
    cells = order.argsort(axis=1)
    contents = np.full((count, CELLS), FLOOR)
    contents[:, 0] = OBJECT + 2 * shape + colour
    contents[:, 1] = AGENT + rng.integers(4, size=count)
    boxes = BOX + rng.integers(len(BOX_COLOURS), size=(count, MOST_BOXES))
    number = 1 + rng.integers(2, size=count) + 2 * many
    contents[:, 2 : 2 + MOST_BOXES] = np.where(np.arange(MOST_BOXES) < number[:, None], boxes, FLOOR)
    contents[:, 2 + MOST_BOXES] = np.where(rng.random(count) < 0.5, GOAL, FLOOR)
    ids = np.empty((count, CELLS), dtype=np.int64)
    np.put_along_axis(ids, cells, contents, axis=1)
    return Scenes(_image(ids), factors)


def _image(ids: NDArray[np.int64]) -> NDArray[np.uint8]:
    """Kinds of tiles (N, 16), row by row -> uint8 (N, 48, 48, 3) with walls around."""
    grid = np.full((len(ids), INNER + 2, INNER + 2), WALL)
    grid[:, 1:-1, 1:-1] = ids.reshape(-1, INNER, INNER)
    return tiles()[grid].swapaxes(2, 3).reshape(len(ids), SIDE, SIDE, 3)


@cache
def tiles() -> NDArray[np.uint8]:
    """Every kind of tile as MiniGrid draws it, uint8 (kinds, 8, 8, 3)."""
    objects = [shape(colour) for shape in (Key, Ball) for colour in ("red", "blue")]
    contents = [None, Wall(), None, None, None, None, *objects, *map(Box, BOX_COLOURS), Goal()]
    directions = {AGENT + direction: direction for direction in range(4)}
    images = [Grid.render_tile(content, directions.get(kind), tile_size=TILE) for kind, content in enumerate(contents)]
    return np.stack(images).astype(np.uint8)  # MiniGrid draws in floats, and truncates them when it fills a picture
