"""States as pictures: single states, attributions over a state, and many states laid over each other."""

import io
from typing import Any

import numpy as np
from matplotlib.colors import LinearSegmentedColormap
from PIL import Image

from hypogoal.core.arrays import Bytes, Doubles
from hypogoal.evaluation.plots import BLUE, VERMILLION
from hypogoal.observations import PICTURE, fields_of

MOST_SIDE = 128  # pixels of a picture on the page
SIGNED = LinearSegmentedColormap.from_list(
    "against-for",
    [BLUE, "white", VERMILLION],
    N=25,
)  # few colours, so that files are small
STRONGEST = 0.995  # the quantile of absolute attributions that has full colour
SHADE = 0.28  # how dark the brightest pixels of a state make the attributions over them
FEW = 200  # about how many states the median is taken of


def last_frame(
    values: Any,
    colours: int | None = None,
) -> Any:
    """Return the channels of the last frame of pictures (..., C), (..., ``colours``).

    By default, ``colours`` is 3 if C is 3, and 1 otherwise.
    """
    default = 3 if values.shape[-1] == 3 else 1
    return values[..., -(colours or default) :]


def coloured(
    observations: Bytes,
    colours: int | None = None,
) -> Bytes:
    """Return the last frame of observations (..., C) as it is shown, (..., 3)."""
    shown = last_frame(observations, colours)
    return shown if shown.shape[-1] == 3 else shown.repeat(3, axis=-1)


def picture_of(state: Any) -> Bytes | None:
    """Return a state's pictures side by side, uint8 (H, W, 3), or None if the state has none."""
    parts = []
    for key, (dtype, _) in fields_of(state.shape, state.dtype).items():
        if dtype == PICTURE:
            parts.append(coloured(state[key] if key else state))
    if not parts:
        return None
    height = max(map(len, parts))
    padded = []
    for part in parts:
        below = height - len(part)
        padded.append(np.pad(part, ((0, below), (0, 0), (0, 0)), constant_values=255))
    return np.concatenate(padded, axis=1)


def encoded(image: Bytes) -> bytes:
    """Return an observation (H, W, C) as a WebP file for the page.

    The file has no loss, except that the picture is reduced to a side of at most ``MOST_SIDE`` pixels.
    """
    picture = Image.fromarray(np.ascontiguousarray(coloured(image)))
    times = -(-max(picture.size) // MOST_SIDE)
    buffer = io.BytesIO()
    picture.reduce(times).save(buffer, "WEBP", lossless=True)
    return buffer.getvalue()


def attribution_image(
    values: Doubles,
    state: Bytes,
    colours: int | None = None,
) -> Bytes:
    """Draw Figures 2 and 9: attributions (H, W, C) to the last frame of a state (H, W, C), as uint8 (H, W, 3).

    Positive attributions are orange, negative ones blue, and 0 is white. The state shows through as a light shade.
    """
    summed = last_frame(values, colours).sum(axis=-1)
    size = float(np.quantile(np.abs(summed), STRONGEST)) or 1.0
    colour = SIGNED(0.5 + summed / (2 * size))[..., :3]
    brightness = last_frame(state, colours).mean(axis=-1, keepdims=True) / 255
    image = 255 * colour * (1 - SHADE * brightness)
    return image.round().astype(np.uint8)


def overlay(states: Bytes) -> Bytes:
    """Draw Figures 7 and 8: termination states, uint8 (n, H, W, C) with n at least 1, laid over each other.

    A pixel is usual if it is as in the median state. The state with the fewest unusual pixels is drawn whole. The
    unusual pixels of the others, such as agents in other cells, are drawn over it, half transparent.
    """
    few = states[:: max(1, len(states) // FEW)]
    middle = len(few) // 2
    usual = np.partition(few, middle, axis=0)[middle]
    unusual = states != usual
    if states.shape[-1] == 3:  # the channels of a colour count together; those of a stack are several frames
        red, green, blue = np.split(unusual, 3, axis=-1)
        unusual = red | green | blue
    whole = unusual.sum(axis=(1, 2, 3)).argmin()
    shown, count = states[whole], unusual.sum(axis=0)
    total = np.where(unusual, states, 0).sum(axis=0)
    others = np.where(count, total / np.maximum(count, 1), shown)
    laid_over = np.where(unusual[whole], shown, (shown + others) / 2)
    return laid_over.round().astype(np.uint8)
