"""Random changes of training states: their shades, and the agent's surroundings (beyond the paper)."""

import numpy as np
from numpy.typing import NDArray

# augment=grey-context: the share of states that change, the share of those that get a pattern, and the pixels kept
# above, below, left and right of the agent.
CONTEXT_SHARE, PATTERN_SHARE, BRIGHTEST = 0.7, 0.8, 200
NEAREST, FARTHEST = (4, 7, 4, 4), (14, 14, 15, 15)
GREY_KNOTS = 8  # segments of a piecewise linear map of shades
GREY_DARKEST, GREY_BRIGHTEST = (0.0, 0.2), (0.7, 1.0)  # ranges of the new black and white


def grey_maps(count: int, rng: np.random.Generator) -> NDArray[np.float32]:
    """Random increasing maps of the shades 0..255 to 0..1, float32 (count, 256)."""
    rises = rng.random((count, GREY_KNOTS)) ** 2 + 0.02  # squared: steep in places, nearly level in others
    risen = np.concatenate([np.zeros((count, 1)), rises.cumsum(1)], axis=1) / rises.sum(1, keepdims=True)
    darkest, brightest = rng.uniform(*GREY_DARKEST, (count, 1)), rng.uniform(*GREY_BRIGHTEST, (count, 1))
    at = np.linspace(0, GREY_KNOTS, 256)
    knot = np.minimum(at.astype(np.int64), GREY_KNOTS - 1)
    between = at - knot
    shades = risen[:, knot] * (1 - between) + risen[:, knot + 1] * between
    return (darkest + (brightest - darkest) * shades).astype(np.float32)


def other_context(images: NDArray[np.uint8], rng: np.random.Generator) -> NDArray[np.uint8]:
    """Images uint8 (B, H, W, C), most with other surroundings: a pattern, or one shade, the same in all frames.

    A box around the agent in the middle stays, with its feet and the floor under them. All of the outside changes, or
    its left, right or lower half. So a member cannot rely on the surroundings of a sub-goal in the labelled rooms.
    """
    images = images.copy()
    height, width = images.shape[1:3]
    row, column = height // 2, width // 2
    for place in np.flatnonzero(rng.random(len(images)) < CONTEXT_SHARE):
        up, down, left, right = rng.integers(NEAREST, FARTHEST, endpoint=True)
        outside = np.ones((height, width), dtype=np.bool_)
        outside[max(row - up, 0) : row + down, max(column - left, 0) : column + right] = False
        kept = (np.s_[:0], np.s_[:, :column], np.s_[:, column:], np.s_[:row])[rng.integers(4)]
        outside[kept] = False
        shades = pattern(height, width, rng) if rng.random() < PATTERN_SHARE else rng.integers(BRIGHTEST)
        images[place][outside] = np.broadcast_to(shades, (height, width, 1))[outside].astype(np.uint8)
    return images


def pattern(height: int, width: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """A pattern (height, width, 1) in 0..255 of two or more shades: repeated bricks, or blocks."""
    dark, bright = np.sort(rng.uniform(0, 255, size=2))
    bricks = rng.random() < 0.6
    cell = np.array((1, 1)) if bricks else rng.integers(1, (5, 8))
    shape = rng.integers(2, 8, size=2) if bricks else -(-np.array((height, width)) // cell)
    shades = rng.random(shape)
    if rng.random() < 0.6:
        shades = (shades < (0.5 if bricks else rng.uniform(0.1, 0.9))).astype(np.float64)
    blocks = shades.repeat(cell[0], axis=0).repeat(cell[1], axis=1)
    pattern = np.tile(blocks, -(-np.array((height, width)) // blocks.shape))[:height, :width]
    return (dark + (bright - dark) * pattern)[:, :, None]
