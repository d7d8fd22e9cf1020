"""The rules by which observations are read, and how pictures are resized.

Environments and imported arrays share the rules, which go by shape and type (see the table in docs/own-domain.md). An
ambiguous observation is refused.
"""

from itertools import pairwise
from math import prod
from typing import NamedTuple

import numpy as np
from PIL import Image

from hypogoal.core.arrays import Bytes
from hypogoal.observations import NUMBERS, PICTURE, DType, Shape

MOST_CHANNELS = 16  # the longest axis that may hold channels or frames; the sides of a picture are longer
CLEARLY = "Give pictures as uint8 (H, W, C), stacked frames among the channels, and numbers as one row of float32."


class Reading(NamedTuple):
    """How an observation is read.

    Attributes:
        dtype: PICTURE or NUMBERS.
        shape: the shape that the observation becomes, which is (H, W, C) for a picture.
        fault: why the observation is refused. Empty: it is not refused.
        axes: a picture's axes of height and width, then the axes that become channels, with colours last. Empty if the
            axes are unclear.
    """

    dtype: DType
    shape: Shape
    fault: str = ""
    axes: Shape = ()

    def arranged(self, values: Bytes) -> Bytes:
        """Return an observation as a picture (H, W, C). The reading must have ``axes``."""
        moved = values.transpose(self.axes)
        return moved.reshape(self.shape)


def reading_of(shape: Shape, dtype: DType) -> Reading:
    """Return how an observation of this shape and type is read."""
    if len(shape) < 2:
        return Reading(NUMBERS, shape or (1,))
    if dtype == PICTURE:
        axes, target = _arrangement(shape)
        return Reading(PICTURE, target, _byte_fault(shape), axes=axes)
    like_a_picture = any(min(pair) > MOST_CHANNELS for pair in pairwise(shape))
    return Reading(NUMBERS, shape, "could be pictures or numbers" if like_a_picture else "")


def _byte_fault(shape: Shape) -> str:
    """Return why uint8 of this shape is refused, or an empty text if it is a picture."""
    if len(shape) > 3:
        return "are stacks of pictures"
    if channels_first(shape):
        return "have their channels, or stacked frames, first"
    if len(shape) == 2 and min(shape) <= MOST_CHANNELS < max(shape):
        return "could be rows of numbers or low pictures"
    return ""


def channels_first(shape: Shape) -> bool:
    """Return whether a shape is (C, H, W) rather than (H, W, C).

    A shape is (C, H, W) if the first axis is short, and the other two are long. Small grids with many planes, such as
    (7, 7, 20), are (H, W, C).
    """
    if len(shape) != 3 or min(shape[1:]) <= MOST_CHANNELS:
        return False
    first, shorter = shape[0], min(shape[1:])
    return first <= MOST_CHANNELS or 2 * first <= shorter


def _arrangement(shape: Shape) -> tuple[Shape, Shape]:
    """Return the axes by which bytes of two axes or more become a picture, and the picture's shape.

    The axes are empty if the picture would be refused again.
    """
    if len(shape) == 3 and not channels_first(shape):
        return (0, 1, 2), shape
    # Height and width are the two neighbouring axes whose shorter axis is longest. Among equal pairs it is the second.
    shorter = [min(pair) for pair in pairwise(shape)]
    height = max(
        range(len(shorter)),
        key=lambda axis: (shorter[axis], axis == 1),
    )
    sides = (height, height + 1)
    others = [axis for axis in range(len(shape)) if axis not in sides]
    others.sort(key=lambda axis: shape[axis] in (1, 3))  # colours are the last axis
    channels = prod(shape[axis] for axis in others)
    target = (*shape[height : height + 2], channels)
    if channels_first(target):
        return (), shape
    return (*sides, *others), target


def shrunk_picture(picture: Bytes, longest: int) -> Bytes:
    """Return a picture, uint8 (H, W, C), scaled down until its longer side has at most ``longest`` pixels.

    If ``longest`` is 0, the picture keeps its size.
    """
    height, width = picture.shape[:2]
    longer = max(height, width)
    scale = min(1.0, (longest or longer) / longer)
    small_height = max(1, round(height * scale))
    small_width = max(1, round(width * scale))
    return resized_picture(picture, small_height, small_width)


def resized_picture(picture: Bytes, height: int, width: int) -> Bytes:
    """Return a picture, uint8 (H, W, C), resized to ``height`` x ``width`` pixels.

    Each new pixel is the mean of the area that it covers.
    """
    if picture.shape[:2] == (height, width):
        return picture
    channels = []
    for channel in np.moveaxis(picture, -1, 0):
        image = Image.fromarray(channel)
        small = image.resize((width, height), Image.Resampling.BOX)
        channels.append(np.asarray(small))
    return np.stack(channels, axis=-1)
