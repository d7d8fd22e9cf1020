"""States as pictures: single ones, attributions over them, many over each other."""

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
)  # few: small files
STRONGEST = 0.995  # the quantile of absolute attributions that has full colour
SHADE = 0.28  # how dark the brightest pixels of a state make the attributions over them
FEW = 200  # states whose median is taken for what is usual


def last_frame(
    values: Any,
    colours: int | None = None,
) -> Any:
    """Of pictures (..., C) the last frame's channels, so many ``colours``: by default 3 where C is 3, else 1."""
    default = 3 if values.shape[-1] == 3 else 1
    return values[..., -(colours or default) :]


def coloured(
    observations: Bytes,
    colours: int | None = None,
) -> Bytes:
    """Observations (..., C) as they are shown, (..., 3): of the last frame."""
    shown = last_frame(observations, colours)
    return shown if shown.shape[-1] == 3 else shown.repeat(3, axis=-1)


def picture_of(state: Any) -> Bytes | None:
    """A state's pictures side by side, uint8 (H, W, 3); None without any."""
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
    """An observation (H, W, C) for the page: a WebP file without loss, reduced to at most ``MOST_SIDE`` pixels."""
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
    """Figures 2 and 9: attributions (H, W, C) to the last frame of a state (H, W, C), uint8 (H, W, 3).

    Orange where positive, blue where negative, white where none; the state shows through as a light shade.
    """
    summed = last_frame(values, colours).sum(axis=-1)
    size = float(np.quantile(np.abs(summed), STRONGEST)) or 1.0
    colour = SIGNED(0.5 + summed / (2 * size))[..., :3]
    brightness = last_frame(state, colours).mean(axis=-1, keepdims=True) / 255
    image = 255 * colour * (1 - SHADE * brightness)
    return image.round().astype(np.uint8)


def overlay(states: Bytes) -> Bytes:
    """Figures 7 and 8: termination states uint8 (n, H, W, C), n at least 1, laid over each other.

    The state with the fewest unusual pixels is drawn whole. Over it, half transparent, is what the others show that is
    unusual: agents in other cells, say. A pixel is usual that is as in the median state.
    """
    few = states[:: max(1, len(states) // FEW)]
    middle = len(few) // 2
    usual = np.partition(few, middle, axis=0)[middle]
    unusual = states != usual
    if states.shape[-1] == 3:  # a colour is one thing, a stack's frames are several
        red, green, blue = np.split(unusual, 3, axis=-1)
        unusual = red | green | blue
    whole = unusual.sum(axis=(1, 2, 3)).argmin()
    shown, count = states[whole], unusual.sum(axis=0)
    total = np.where(unusual, states, 0).sum(axis=0)
    others = np.where(count, total / np.maximum(count, 1), shown)
    laid_over = np.where(unusual[whole], shown, (shown + others) / 2)
    return laid_over.round().astype(np.uint8)
