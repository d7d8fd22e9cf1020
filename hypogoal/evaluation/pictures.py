"""States and attributions as small pictures (Spec F2, F7): arrays in, PNG of the array's own size out."""

from __future__ import annotations

import io
from typing import Any

import numpy as np
from numpy.typing import NDArray

FULL = 127  # what the strongest attribution of a picture is stored as
MOST_SIDE = 128  # pixels of a picture on the page
COLOURS = 256  # that a PNG's palette holds
LEVELS, SHADES = 12, 6  # steps of an attribution's strength and of the state behind it, so that a palette holds all
AGAINST, FOR = (0, 114, 178), (213, 94, 0)  # Okabe and Ito's blue and vermillion: a pair that all readers tell apart


def image_png(image: NDArray[np.uint8]) -> bytes:
    """An observation uint8 (H, W, 3) or (H, W), pixel for pixel; with a palette where its colours fit in one."""
    from PIL import Image

    picture = Image.fromarray(np.ascontiguousarray(image))
    if image.ndim == 3:
        colours, index = np.unique(image.reshape(-1, 3), axis=0, return_inverse=True)
        if len(colours) <= COLOURS:
            picture = Image.fromarray(index.reshape(image.shape[:2]).astype(np.uint8))
            picture.putpalette(colours.astype(np.uint8).tobytes())
    buffer = io.BytesIO()
    picture.save(buffer, format="PNG", optimize=True)
    return buffer.getvalue()


def reduced(values: NDArray[Any]) -> NDArray[Any]:
    """A picture (H, W) or (H, W, C) of at most ``MOST_SIDE`` pixels a side: means of squares, for the page's sake.

    One that is no larger is as it was; what no whole square fills at the right and below is cut.
    """
    step = -(-max(values.shape[:2]) // MOST_SIDE)
    if step == 1:
        return values
    height, width = (size // step for size in values.shape[:2])
    squares = values[: height * step, : width * step].reshape(height, step, width, step, *values.shape[2:])
    return np.asarray(squares.mean((1, 3)).astype(values.dtype))


def attribution_png(values: NDArray[np.floating], grey: NDArray[np.floating]) -> bytes:
    """Figures 2 and 9: signed attributions as a PNG, see :func:`attribution_image`."""
    return image_png(attribution_image(values, grey))


def attribution_image(values: NDArray[np.floating], grey: NDArray[np.floating]) -> NDArray[np.uint8]:
    """Figures 2 and 9: signed attributions as a picture, uint8 (H, W, 3).

    Orange where positive, blue where negative, white where none; full colour at the 99.5th percentile of the absolute
    values. The state shows through as a light shade. In steps, which keeps the file small.

    Args:
        values: float (H, W).
        grey: the state's brightness, float (H, W) in 0..1.
    """
    size = float(np.quantile(np.abs(values), 0.995)) or 1.0
    strength = (LEVELS * np.clip(np.abs(values) / size, 0, 1)).round()[..., None] / LEVELS
    shade = (SHADES * grey[..., None]).round() / SHADES
    ends = np.array([AGAINST, FOR]) / 255
    paper = np.repeat(1 - 0.28 * shade, 3, axis=-1)
    image = (1 - strength) * paper + strength * ends[(values > 0).astype(np.int64)]
    return np.asarray((255 * image).round().astype(np.uint8))


def flat(values: NDArray[np.floating]) -> NDArray[np.floating]:
    """Attributions (..., C) to be drawn, (...): of colours their sum, of a stack of frames the last."""
    return values.sum(-1) if values.shape[-1] == 3 else values[..., -1]


def brightness(observations: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Observations (..., C) in grey, (...): of a stack of frames the last."""
    return observations.mean(-1).astype(np.uint8) if observations.shape[-1] == 3 else observations[..., -1]


def to_bytes(values: NDArray[np.floating]) -> NDArray[np.int8]:
    """Signed attributions (..., H, W) of pictures as int8, each picture's strongest at 127.

    Strongest: the 99.5th percentile of the absolute values; what is beyond is cut.
    """
    size = np.quantile(np.abs(values), 0.995, axis=(-2, -1), keepdims=True)
    scaled = np.divide(values, size, out=np.zeros_like(values, dtype=np.float64), where=size > 0)
    return np.asarray((FULL * np.clip(scaled, -1, 1)).round().astype(np.int8))
