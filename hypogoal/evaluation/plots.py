"""The look of figures, and how figures are written."""

import io
import re
from collections.abc import Collection
from contextlib import AbstractContextManager
from hashlib import blake2b
from typing import Any

import matplotlib.style
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from hypogoal.core.arrays import Bytes

INK = "#24272b"
BLUE, VERMILLION, GREEN = "#0072b2", "#d55e00", "#009e73"
PURPLE, ORANGE, SKY, GREY = "#cc79a7", "#e69f00", "#56b4e9", "#808890"
PALETTE = (BLUE, VERMILLION, GREEN, PURPLE, ORANGE, SKY)  # colours of methods; what is no method is grey
WIDTH = 5.6  # inches; readable on a phone, where it is scaled to the screen
# Formats of files, and their fields that would say when and by what a file was written.
UNDATED = {
    "svg": ("Date", "Creator"),
    "pdf": ("CreationDate", "Producer", "Creator"),
    "png": ("Software",),
}
DOTTED: dict[str, Any] = {
    "color": GREY,
    "linestyle": ":",
    "linewidth": 1.2,
}  # for a line that is no method's


def styled() -> AbstractContextManager[None]:
    """Give all figures our style within the block, whatever a notebook has set."""
    return matplotlib.style.context(["default", "hypogoal.evaluation.hypogoal"])


def plot(height: float, width: float = WIDTH) -> tuple[Figure, Axes]:
    """Return a new figure with one plot, and the plot."""
    figure = Figure(figsize=(width, height))
    return figure, figure.subplots()


def bars(
    kind: Any,
    means: Any,
    height: float,
    **errors: Any,
) -> tuple[Figure, Axes]:
    """Draw bars of each method (a column) side by side at each place (a row). Return the figure and its plot.

    ``kind`` is ``bar`` or ``barh``; ``errors`` are the lengths of error bars.
    """
    figure, axes = plot(height)
    means.plot(kind=kind, ax=axes, alpha=0.8, rot=0, legend=False, **errors)
    legend_below(figure, 2)
    return figure, axes


def legend_below(figure: Figure, columns: int) -> None:
    """Add a legend under the plots, with each label once. The figure grows by the height of the legend."""
    by_label: dict[str, Any] = {}
    for place in figure.axes:
        handles, labels = place.get_legend_handles_labels()
        by_label |= zip(labels, handles, strict=True)
    if max(map(len, by_label), default=0) > 80 // columns:
        columns = 1
    lines = -(-len(by_label) // columns)
    figure.set_figheight(figure.get_figheight() + 0.2 * lines + 0.1)
    figure.legend(by_label.values(), by_label.keys(), loc="outside lower left", ncols=columns)


def panels(
    shown: Collection[tuple[str, Bytes]],
    columns: int,
    titles: float = 0.34,
) -> tuple[Figure, list[Axes]]:
    """Draw pictures with their titles, row by row. Return the figure and its plots.

    ``titles`` is the space above each picture in inches. Of a stack of grey frames, the last is drawn.
    """
    side = WIDTH / max(columns, 3)
    rows = -(-len(shown) // columns)
    figure = Figure(figsize=(side * columns, rows * (side + titles)))
    places = list(figure.subplots(rows, columns, squeeze=False).flat)
    for place in places:
        place.set_axis_off()
    for place, (title, image) in zip(places, shown, strict=False):
        place.imshow(image if image.shape[2] == 3 else image[..., -1], vmin=0, vmax=255)
        place.set_title(title, fontsize=9, loc="center")
    return figure, places


def slug(text: str) -> str:
    """Return ``text`` as an id, or as the name of a file without its ending.

    If the text has other signs than letters, digits, - and _, or is longer than 80, a digest is added.
    """
    plain = re.sub(r"[^\w-]+", "-", text)[:80]
    return text if plain == text else f"{plain}-{blake2b(text.encode(), digest_size=4).hexdigest()}"


def to_file(figure: Figure, kind: str) -> bytes:
    """Return the figure as a ``svg``, ``png`` (on white) or ``pdf`` file, with the same bytes each time."""
    buffer = io.BytesIO()
    with styled():
        figure.savefig(buffer, format=kind, metadata=dict.fromkeys(UNDATED[kind]))
    return buffer.getvalue()
