"""States as pictures (Spec F2, F7): the frame that is shown, attributions over it, states laid over each other."""

import io
from typing import Any

import numpy as np
from matplotlib.colors import LinearSegmentedColormap
from numpy.typing import NDArray
from PIL import Image

from hypogoal.evaluation.plots import BLUE, VERMILLION

MOST_SIDE = 128  # pixels of a picture on the page
SIGNED = LinearSegmentedColormap.from_list("against-for", [BLUE, "white", VERMILLION], N=25)  # few: small files
STRONGEST = 0.995  # the quantile of absolute attributions that has full colour
SHADE = 0.28  # how dark the brightest pixels of a state make the attributions over them
STATES = "termination-states"  # in an evaluation's arrays: of how many states each option's overlay is
FEW = 200  # states whose median is taken for what is usual


def last_frame(values: NDArray[Any], colours: int | None = None) -> NDArray[Any]:
    """Of pictures (..., C) the last frame's channels, so many ``colours``: by default 3 where C is 3, else 1."""
    default = 3 if values.shape[-1] == 3 else 1
    return values[..., -(colours or default) :]


def coloured(observations: NDArray[np.uint8], colours: int | None = None) -> NDArray[np.uint8]:
    """Observations (..., C) as they are shown, (..., 3): of the last frame."""
    shown = last_frame(observations, colours)
    return shown if shown.shape[-1] == 3 else shown.repeat(3, axis=-1)


def encoded(image: NDArray[np.uint8]) -> bytes:
    """An observation (H, W, C) for the page: a WebP file without loss, reduced to at most ``MOST_SIDE`` pixels."""
    picture = Image.fromarray(np.ascontiguousarray(coloured(image)))
    times = -(-max(picture.size) // MOST_SIDE)
    buffer = io.BytesIO()
    picture.reduce(times).save(buffer, "WEBP", lossless=True)
    return buffer.getvalue()


def attribution_image(
    values: NDArray[np.floating],
    state: NDArray[np.uint8],
    colours: int | None = None,
) -> NDArray[np.uint8]:
    """Figures 2 and 9: attributions (H, W, C) to the last frame of a state (H, W, C), uint8 (H, W, 3).

    Orange where positive, blue where negative, white where none; the state shows through as a light shade.
    """
    summed = last_frame(values, colours).sum(axis=-1)
    size = float(np.quantile(np.abs(summed), STRONGEST)) or 1.0
    colour = SIGNED(0.5 + summed / (2 * size))[..., :3]
    brightness = last_frame(state, colours).mean(axis=-1, keepdims=True) / 255
    image = 255 * colour * (1 - SHADE * brightness)
    return np.asarray(image.round().astype(np.uint8))


def overlay(states: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Figures 7 and 8: termination states uint8 (n, H, W, C), n at least 1, laid over each other.

    The state with the fewest unusual pixels is drawn whole. Over it, half transparent, is what the others show that is
    unusual: agents in other cells, say. A pixel is usual that is as in the median state.
    """
    few = states[:: max(1, len(states) // FEW)]
    usual = np.partition(few, len(few) // 2, axis=0)[len(few) // 2]
    unusual = states != usual
    if states.shape[-1] == 3:  # a colour is one thing, a stack's frames are several
        unusual[:] = unusual.any(axis=-1, keepdims=True)
    whole = unusual.sum(axis=(1, 2, 3)).argmin()
    shown = states[whole]
    others = np.ma.array(states, mask=~unusual).mean(axis=0).filled(shown)
    laid_over = np.where(unusual[whole], shown, (shown + others) / 2)
    return np.asarray(laid_over.round().astype(np.uint8))
