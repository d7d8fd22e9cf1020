"""Scenes with planted factors, drawn with MiniGrid's tiles, and whether each factor holds in them."""

from collections.abc import Sequence
from functools import cache
from itertools import product
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.random import Generator

from hypogoal.core.arrays import Bools, Bytes, Ints
from hypogoal.core.seeding import rng_for
from hypogoal.domains.tiles import TILE

FACTORS = ("colour", "shape", "place", "count")
MEANINGS = {
    "colour": "the object is blue",
    "shape": "the object is a ball",
    "place": "the object is in the right half",
    "count": "there are three or four boxes",
}
INNER = 4  # free cells on a side within the walls
SIDE = (INNER + 2) * TILE  # pixels on a side of an image
CELLS = INNER * INNER
BOX_COLOURS = ("yellow", "purple", "grey")
MOST_BOXES = 4  # few boxes are one or two, and many boxes are three or four
# The index of the first tile of each kind, as tests/domains/draw_rooms.py draws them.
FLOOR = 0
WALL = 1
AGENT = 2  # plus the direction
OBJECT = 6  # red key, blue key, red ball, blue ball
BOX = 10  # plus the colour
GOAL = 13


class Scenes(NamedTuple):
    """N scenes, and which of F factors hold in them. ``MEANINGS`` says what factors mean."""

    observations: Bytes  # (N, 48, 48, 3)
    factors: Bools  # (N, F), the factors that were asked for; the other factors are drawn evenly


def labelled_states(count: int, seed: int, names: Sequence[str]) -> Scenes:
    """Draw states of the labelled context. In half of them, the positives, every factor holds, in the others none."""
    rng = rng_for(seed, "which-feature", "labelled")  # rooms' earlier name, because a new name would change the states
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
    """Draw unlabelled states.

    ``mix`` is the probability that a state's factors are drawn independently and evenly. In the other states either all
    factors hold or none, with equal probability.
    """
    rng = rng_for(seed, "which-feature", "unlabelled")
    independent = rng.random((count, len(names))) < 0.5
    joint = rng.random((count, 1)) < 0.5
    mixed = rng.random((count, 1)) < mix
    factors = np.where(mixed, independent, joint)
    return draw_scenes(factors, names, rng)


def crossed_states(copies: int, seed: int, names: Sequence[str]) -> Scenes:
    """Draw states with every combination of factors ``copies`` times, in random order."""
    rng = rng_for(seed, "which-feature", "test")
    combinations = list(product((False, True), repeat=len(names)))
    factors = np.repeat(combinations, copies, axis=0)
    return draw_scenes(rng.permutation(factors), names, rng)


def draw_scenes(factors: Bools, names: Sequence[str], rng: Generator) -> Scenes:
    """Draw scenes with ``factors``, bool (N, F). All else is random, and independent of the factors."""
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
    # The order in which cells get their contents. The object's cell is first. A cell beside the object is last, so that
    # this cell stays free. The other cells are in random order.
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
    """Draw pictures, uint8 (N, 48, 48, 3), of kinds of tiles (N, 16), row by row, with walls around."""
    count = len(ids)
    grid = np.full((count, INNER + 2, INNER + 2), WALL)
    grid[:, 1:-1, 1:-1] = ids.reshape(count, INNER, INNER)
    cells = tiles()[grid]  # (N, row, column, y, x, 3)
    return cells.swapaxes(2, 3).reshape(count, SIDE, SIDE, 3)


@cache
def tiles() -> Bytes:
    """Read every kind of tile, uint8 (kinds, 8, 8, 3).

    MiniGrid drew them into this file, because importing MiniGrid takes a tenth of a second, and rooms need nothing else
    of it.
    """
    return np.asarray(np.load(Path(__file__).with_name("tiles.npy")))
