"""Figures 2, 7, 8 and 9: attributions beside the state, and the states in which options stopped."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure
from numpy.typing import NDArray

from hypogoal.evaluation.figures import BLUE, GREY, VERMILLION, WIDTH, styled
from hypogoal.evaluation.pictures import attribution_image, brightness, flat

SIGNED = LinearSegmentedColormap.from_list("against-for", [BLUE, "white", VERMILLION])
TITLE, KEY = 0.34, 0.75  # inches above a picture, and below all of them


@dataclass(frozen=True)
class Explained:
    """A state and each member's attributions.

    Attributes:
        observation: uint8 (H, W, C).
        seen: uint8 (h, w, C), what members see of it.
        values: float (K, h, w, C), log-odds.
        probabilities: float (K,).
        verdicts: bool (K,).
        truth: the sub-goal is reached.
    """

    observation: NDArray[np.uint8]
    seen: NDArray[np.uint8]
    values: NDArray[np.floating]
    probabilities: NDArray[np.floating]
    verdicts: NDArray[np.bool_]
    truth: bool

    def said(self, member: int) -> str:
        """A member's verdict and probability."""
        verdict = "yes" if self.verdicts[member] else "no"
        return f"member {member}: {verdict} {self.probabilities[member]:.2f}"


def attributions_of_members(state: Explained, columns: int = 4) -> Figure:
    """Figure 2: what each member goes by in one state; of a stack of frames the last.

    Args:
        state: of K members.
        columns: pictures in a row, the state itself being the first.
    """
    members = len(state.values)
    columns = min(columns, members + 1)
    figure, places = _grid(-(-(members + 1) // columns), columns, KEY)
    _show(places[0], state.observation, f"truth: {'yes' if state.truth else 'no'}")
    grey = brightness(state.seen) / 255
    for member in range(members):
        image = attribution_image(flat(state.values[member]), grey)
        _show(places[member + 1], image, state.said(member))
    _key(figure, places)
    return figure


def attributions_of_every_frame(state: Explained) -> Figure:
    """Figure 9: a row per member, a column per frame, oldest first, above them the frames; of colours one of each."""
    channels, members = state.seen.shape[-1], len(state.values)
    figure, places = _grid(members + 1, channels, KEY)
    for channel, name in enumerate(_channels(channels)):
        frame = state.seen[..., channel]
        _show(places[channel], frame, name)
        for member in range(members):
            image = attribution_image(state.values[member, ..., channel], frame / 255)
            _show(places[(member + 1) * channels + channel], image, state.said(member) if channel == 0 else "")
    _key(figure, places)
    return figure


def _channels(count: int) -> list[str]:
    if count == 3:
        return ["red", "green", "blue"]
    ages = range(count - 1, -1, -1)
    return ["newest frame" if age == 0 else f"{age} step{'s' if age > 1 else ''} before" for age in ages]


def termination_states(sides: Sequence[tuple[str, NDArray[np.uint8] | None]]) -> Figure:
    """Figures 7 and 8: overlaid termination states of some members, the most preferred first.

    Args:
        sides: title and overlay uint8 (H, W, C), None where its classifier never ended an execution.
    """
    figure, places = _grid(1, max(2, len(sides)), TITLE)
    for place, (title, picture) in zip(places, sides, strict=False):
        if picture is None:
            place.set_title(title, fontsize=9)
            place.text(0.5, 0.5, "never ended\nby its classifier", ha="center", va="center", color=GREY)
        else:
            _show(place, picture, title)
    return figure


def _grid(rows: int, columns: int, below: float = 0.0) -> tuple[Figure, list[Axes]]:
    with styled({"axes.titlelocation": "center"}):
        side = WIDTH / max(columns, 3)
        figure = Figure(figsize=(side * columns, rows * (side + TITLE) + below), layout="constrained")
        places = list(figure.subplots(rows, columns, squeeze=False).flat)
    for place in places:
        place.set_axis_off()
    return figure, places


def _show(place: Axes, image: NDArray[np.uint8], title: str) -> None:
    """A picture; of a stack of frames the last, in grey."""
    if image.ndim == 3 and image.shape[2] != 3:
        image = image[..., -1]
    if image.ndim == 2:
        image = np.repeat(image[..., None], 3, axis=2)
    place.imshow(image, interpolation="nearest")
    place.set_title(title, fontsize=9)


def _key(figure: Figure, places: Sequence[Axes]) -> None:
    """What the colours mean; each picture has a scale of its own, so it has no numbers."""
    with styled():
        bar = figure.colorbar(
            ScalarMappable(Normalize(-1, 1), SIGNED),
            ax=list(places),
            location="bottom",
            fraction=0.05,
            shrink=0.6,
            aspect=40,
        )
        bar.set_ticks([-1, 0, 1], labels=["against", "0", "for 'reached'"])
        bar.set_label("attribution in log-odds, each picture on its own scale")
