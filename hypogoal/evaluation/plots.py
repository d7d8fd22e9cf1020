"""The kit of figures: their look, and how they are written."""

import io
import re
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from hashlib import blake2b
from importlib import resources
from itertools import cycle
from typing import Any

import matplotlib
import matplotlib.style
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Colormap, Normalize
from matplotlib.figure import Figure
from numpy.typing import NDArray

INK = "#24272b"
BLUE, VERMILLION, GREEN = "#0072b2", "#d55e00", "#009e73"
PURPLE, ORANGE, SKY, GREY = "#cc79a7", "#e69f00", "#56b4e9", "#808890"
PALETTE = (BLUE, VERMILLION, GREEN, PURPLE, ORANGE, SKY)  # of methods; grey is for what is no method
MARKERS = "osD^vPX*<>p"  # 11, so that a colour has the same one again late
STYLES = ("-", "--", "-.", (0, (5, 1)), (0, (3, 1, 1, 1, 1, 1)))  # of lines; dotted is what is no method
WIDTH = 5.6  # inches; readable on a phone, where it is scaled to the screen
KINDS = ("svg", "pdf", "png")
DOTTED: dict[str, Any] = {"color": GREY, "linestyle": ":", "linewidth": 1.2}  # a line of what is no method


@contextmanager
def styled() -> Iterator[None]:
    """What all figures have in common, whatever a notebook has set."""
    look = resources.files("hypogoal.evaluation").joinpath("hypogoal.mplstyle")
    with resources.as_file(look) as path, matplotlib.style.context(["default", str(path)]):
        yield


def plot(height: float, width: float = WIDTH) -> tuple[Figure, Axes]:
    """A figure with one plot."""
    figure = Figure(figsize=(width, height))
    return figure, figure.subplots()


def looks(methods: Iterable[str]) -> dict[str, dict[str, Any]]:
    """Each method's colour and line."""
    distinct = dict.fromkeys(methods)
    kinds = zip(distinct, cycle(PALETTE), cycle(STYLES))
    return {method: {"color": colour, "linestyle": style} for method, colour, style in kinds}


def banded(axes: Axes, middle: pd.Series, wide: pd.Series, **look: Any) -> None:
    """A line against its index with a band around it."""
    axes.plot(middle.index, middle, linewidth=1.6, **look)
    axes.fill_between(middle.index, middle - wide, middle + wide, color=look["color"], alpha=0.18, linewidth=0)


def whiskers(axes: Axes, table: pd.DataFrame, **look: Any) -> None:
    """The means of a table of :func:`house.over` against its index, with their standard deviations."""
    wide = table["standard_deviation"].fillna(0)
    axes.errorbar(table.index, table["mean"], yerr=wide, marker="o", markersize=4, capsize=3, alpha=0.8, **look)


def legend_below(figure: Figure, axes: Sequence[Axes], columns: int) -> None:
    """A legend under the plots, each label once; the figure becomes higher by its lines."""
    handles: dict[str, Any] = {}
    for place in axes:
        for handle, label in zip(*place.get_legend_handles_labels(), strict=True):
            handles.setdefault(label, handle)
    if not handles:
        return
    if max(map(len, handles)) > 80 // columns:
        columns = 1
    lines = -(-len(handles) // columns)
    figure.set_figheight(figure.get_figheight() + 0.2 * lines + 0.1)
    figure.legend(handles.values(), handles.keys(), loc="outside lower left", ncols=columns)


def pictures(rows: int, columns: int, titles: float = 0.34) -> tuple[Figure, list[Axes]]:
    """Places for pictures without axes, row by row; ``titles``: inches above each."""
    side = WIDTH / max(columns, 3)
    figure = Figure(figsize=(side * columns, rows * (side + titles)))
    places = list(figure.subplots(rows, columns, squeeze=False).flat)
    for place in places:
        place.set_axis_off()
    return figure, places


def show_picture(place: Axes, image: NDArray[np.uint8], title: str) -> None:
    """A picture; of a stack of grey frames the last."""
    if image.ndim == 3 and image.shape[2] != 3:
        image = image[..., -1]
    place.imshow(image, cmap="gray", vmin=0, vmax=255, interpolation="nearest")
    place.set_title(title, fontsize=9, loc="center")


def panels(
    shown: Sequence[tuple[NDArray[np.uint8], str]],
    columns: int,
    signed: Colormap,
) -> Figure:
    """Pictures with titles, row by row; below them what the colours of attributions mean.

    Each picture has a scale of its own, so the key has no numbers.
    """
    with styled():
        figure, places = pictures(-(-len(shown) // columns), columns, titles=0.5)
        for place, (image, title) in zip(places, shown, strict=False):
            show_picture(place, image, title)
        key = ScalarMappable(Normalize(-1, 1), signed)
        bar = figure.colorbar(key, ax=places, location="bottom", fraction=0.05, shrink=0.6, aspect=40)
        bar.set_ticks([-1, 0, 1], labels=["against", "0", "for 'reached'"])
        bar.set_label("attribution in log-odds, each picture on its own scale")
    return figure


def slug(text: str) -> str:
    """An id, or a file's name without its ending: of other signs than letters, digits, - and _ a digest is left."""
    plain = re.sub(r"[^\w-]+", "-", text)[:80]
    return text if plain == text else f"{plain}-{blake2b(text.encode(), digest_size=4).hexdigest()}"


def to_file(figure: Figure, kind: str) -> bytes:
    """The figure as ``svg``, ``png`` (on white) or ``pdf``; the same bytes each time."""
    undated: dict[str, Any] = {
        "svg": {"Date": None, "Creator": None},
        "pdf": {"CreationDate": None, "Producer": None, "Creator": None},
        "png": {"Software": None},
    }
    buffer = io.BytesIO()
    with styled():
        figure.savefig(buffer, format=kind, dpi=160, facecolor="white", metadata=undated[kind])
    return buffer.getvalue()
