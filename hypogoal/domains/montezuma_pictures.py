"""Montezuma's Revenge: a room's picture without the agent, and where in it the agent would be (Spec F4)."""

from __future__ import annotations

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from hypogoal.domains.montezuma_emulator import (
    EDGE_Y,
    LEFT_EDGE,
    NOOP,
    OBSERVATION_SHAPE,
    RIGHT_EDGE,
    SCREEN,
    Emulator,
)
from hypogoal.domains.montezuma_ladders import SHAFT_ENTRY, SHAFT_EXIT

# The agent is drawn in columns x - 1 .. x + 6 and rows 308 - y .. 327 - y, where x and y are the RAM's: read off the
# differences of screens that have the agent at two places; a test does it again.
SPRITE_WIDTH, SPRITE_HEIGHT = 8, 20
SPRITE_LEFT, SPRITE_TOP = -1, 308
THREE_PLACES = (20, 75, 130)  # so far apart that neither the agent nor what is left of it there is drawn at two of them
BLACK_SHARE = 0.95  # of the agent's box, where it stands in the open; its feet are all in the open
FEET = 4  # rows
SNAP = 3  # of the row in which one enters, the floor is drawn so much lower in some rooms
LAVA_ROOMS = (10, 18, 20, 22)
LAVA_BELOW = 220  # y; nobody stands on lava, unless put there


def pixel(positions: NDArray[np.int64]) -> NDArray[np.float64]:
    """The middle of the agent in the console's picture: column, row (n, 2) for positions (n, 3) of room, x, y."""
    columns = positions[:, 1] + SPRITE_LEFT + (SPRITE_WIDTH - 1) / 2
    rows = SPRITE_TOP - positions[:, 2] + (SPRITE_HEIGHT - 1) / 2
    return np.stack([columns, rows], axis=1)


def observed_pixel(positions: NDArray[np.int64]) -> NDArray[np.float64]:
    """The same in an 84x84 observation, which is that picture made smaller: row, column (n, 2).

    Where the agent is in an observation, a test reads off the emulator.
    """
    return (pixel(positions)[:, ::-1] + 0.5) * (np.array(OBSERVATION_SHAPE[:2]) / SCREEN) - 0.5


def picture(emulator: Emulator, room: int) -> NDArray[np.uint8]:
    """A room as the console shows it, enemies and all, but for the agent: uint8 (210, 160, 3).

    Of three pictures with the agent at three places, two agree on every pixel.
    """
    shots = []
    for x in THREE_PLACES:
        emulator.place(room, x, EDGE_Y, settle=0)
        emulator.frames(NOOP, 1)  # the screen shows what was written from the next frame on
        shots.append(emulator.screen_rgb())
    return np.median(shots, axis=0).astype(np.uint8)


def standing_places(emulator: Emulator, room: int) -> NDArray[np.int64]:
    """Places x, y (n, 2) of a room where an agent that is put there stands on something, in the open.

    Of all places many are inside walls, where the game never looks, and where the agent can climb about. So the
    agent's box has to be black, with something under its feet. Room 15 is black nowhere: of it the row in which one
    enters is taken.
    """
    black = (picture(emulator, room) == 0).all(2)
    x = np.arange(LEFT_EDGE, RIGHT_EDGE + 1)
    y = np.arange(SHAFT_EXIT, SHAFT_ENTRY + 1)
    boxes = sliding_window_view(black, (SPRITE_HEIGHT + 1, SPRITE_WIDTH))  # the last row is the one under the feet
    boxes = boxes[np.ix_(SPRITE_TOP - y, x + SPRITE_LEFT)]
    stands = (boxes[:, :, :-1].mean((2, 3)) >= BLACK_SHARE) & boxes[:, :, -1 - FEET : -1].all((2, 3))
    stands &= boxes[:, :, -1].mean(2) <= 0.5
    if room in LAVA_ROOMS:
        stands[y < LAVA_BELOW] = False
    rows, columns = np.nonzero(stands)
    if not len(rows):
        return np.stack([x, np.full_like(x, EDGE_Y)], axis=1)
    level = np.where(np.abs(y - EDGE_Y) <= SNAP, EDGE_Y, y)
    return np.unique(np.stack([x[columns], level[rows]], axis=1), axis=0)
