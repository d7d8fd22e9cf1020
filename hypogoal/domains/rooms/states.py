"""Scenes with planted factors, drawn with MiniGrid's tiles, and the truth of each factor."""

from collections.abc import Sequence
from functools import cache
from itertools import product
from typing import NamedTuple

import numpy as np
from minigrid.core.world_object import Ball, Box, Goal, Key, Wall
from numpy.random import Generator

from hypogoal.core.arrays import Bools, Bytes, Ints
from hypogoal.core.seeding import rng_for
from hypogoal.domains.tiles import TILE, draw_tiles

FACTORS = ("colour", "shape", "place", "count")
MEANINGS = {
    "colour": "the object is blue",
    "shape": "the object is a ball",
    "place": "the object is in the right half",
    "count": "there are three or four boxes",
}
INNER = 4  # free cells per side within the walls
SIDE = (INNER + 2) * TILE  # pixels of an image
CELLS = INNER * INNER
BOX_COLOURS = ("yellow", "purple", "grey")
MOST_BOXES = 4  # few: one or two; many: three or four
# Index of the first tile of each kind.
FLOOR = 0
WALL = 1
AGENT = 2  # plus the direction
OBJECT = 6  # red key, blue key, red ball, blue ball
BOX = 10  # plus the colour
GOAL = 13


class Scenes(NamedTuple):
    """Scenes and which factors hold in them, see ``MEANINGS``."""

    observations: Bytes  # (N, 48, 48, 3)
    factors: Bools  # (N, F), the requested ones; others are drawn evenly


def labelled_states(count: int, seed: int, names: Sequence[str]) -> Scenes:
    """The labelled context: every factor holds in half of the states, the positives, and none in the others."""
    rng = rng_for(seed, "which-feature", "labelled")  # what rooms was called: another name is other states
    every_other = np.arange(count) % 2 == 0
    positive = rng.permutation(every_other)
    factors = np.repeat(positive[:, None], len(names), axis=1)
    return draw_scenes(factors, names, rng)


def unlabelled_states(
    count: int,
    mix: float,
    seed: int,
    names: Sequence[str],
) -> Scenes:
    """States without labels.

    ``mix`` is the probability that a state's factors are drawn independently and evenly; else all are one even bit.
    """
    rng = rng_for(seed, "which-feature", "unlabelled")
    independent = rng.random((count, len(names))) < 0.5
    joint = rng.random((count, 1)) < 0.5
    mixed = rng.random((count, 1)) < mix
    factors = np.where(mixed, independent, joint)
    return draw_scenes(factors, names, rng)


def crossed_states(copies: int, seed: int, names: Sequence[str]) -> Scenes:
    """Every combination of factors ``copies`` times, in random order."""
    rng = rng_for(seed, "which-feature", "test")
    combinations = list(product((False, True), repeat=len(names)))
    factors = np.repeat(combinations, copies, axis=0)
    return draw_scenes(rng.permutation(factors), names, rng)


def draw_scenes(factors: Bools, names: Sequence[str], rng: Generator) -> Scenes:
    """Scenes with these factors, bool (N, F); everything else is random and independent of them."""
    count = len(factors)
    truth = dict(zip(names, factors.T, strict=True))
    for name in FACTORS:
        if name not in truth:
            truth[name] = rng.random(count) < 0.5
    every = np.array([truth[name] for name in FACTORS], int)
    colour, shape, right, many = every
    rows = np.arange(count)

    half = INNER // 2
    x = rng.integers(half, size=count) + right * half
    y = rng.integers(INNER, size=count)
    upwards = rng.random(count) < 0.5
    upwards[y == 0] = False
    upwards[y == INNER - 1] = True
    neighbour = np.where(upwards, y - 1, y + 1)
    # The cells in the order in which they get their contents: the object's first, one beside it last, so that it
    # stays free; the others at random.
    rank = rng.random((count, CELLS))
    cell = y * INNER + x
    beside = neighbour * INNER + x
    rank[rows, cell] = -1.0
    rank[rows, beside] = 2.0
    cells = rank.argsort(axis=1)

    contents = np.full((count, CELLS), FLOOR)
    contents[:, 0] = OBJECT + 2 * shape + colour
    direction = rng.integers(4, size=count)
    contents[:, 1] = AGENT + direction
    colours = rng.integers(len(BOX_COLOURS), size=(count, MOST_BOXES))
    one_more = rng.integers(2, size=count)
    number = 1 + one_more + 2 * many
    is_box = np.arange(MOST_BOXES) < number[:, None]
    end = 2 + MOST_BOXES
    contents[:, 2:end] = np.where(is_box, BOX + colours, FLOOR)
    has_goal = rng.random(count) < 0.5
    contents[:, end] = np.where(has_goal, GOAL, FLOOR)
    ids = np.empty_like(contents)
    np.put_along_axis(ids, cells, contents, axis=1)
    return Scenes(draw_pictures(ids), factors)


def draw_pictures(ids: Ints) -> Bytes:
    """Kinds of tiles (N, 16), row by row -> uint8 (N, 48, 48, 3) with walls around."""
    count = len(ids)
    grid = np.full((count, INNER + 2, INNER + 2), WALL)
    grid[:, 1:-1, 1:-1] = ids.reshape(count, INNER, INNER)
    cells = tiles()[grid]  # (N, row, column, y, x, 3)
    return cells.swapaxes(2, 3).reshape(count, SIDE, SIDE, 3)


@cache
def tiles() -> Bytes:
    """Every kind of tile, uint8 (kinds, 8, 8, 3)."""
    boxes = [Box(colour) for colour in BOX_COLOURS]
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
