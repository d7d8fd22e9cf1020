"""The kit of figures: their look, and how they are written. Colours are Okabe and Ito's, told apart by all readers."""

import io
import re
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from hashlib import blake2b
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

INK, RULE = "#24272b", "#d4d7dc"
BLUE, VERMILLION, GREEN = "#0072b2", "#d55e00", "#009e73"
PURPLE, ORANGE, SKY, GREY = "#cc79a7", "#e69f00", "#56b4e9", "#808890"
COLOURS = {
    INK: "ink", RULE: "rule", BLUE: "blue", VERMILLION: "vermillion", GREEN: "green", PURPLE: "purple",
    ORANGE: "orange", SKY: "sky", GREY: "soft",
}  # fmt: skip
PALETTE = (BLUE, VERMILLION, GREEN, PURPLE, ORANGE, SKY, GREY)
MARKERS = "osD^vPX*<>p"  # 11, so that a colour has the same one again late
STYLES = ("-", "--", "-.", (0, (5, 1)), (0, (3, 1, 1, 1, 1, 1)))  # of lines; dotted is what is no method
METHOD_COLOURS = PALETTE[:-1]  # of methods in Figures 3 and 4; grey is for what is no method
WIDTH, NARROW = 5.6, 4.6  # inches; readable on a phone where it is scaled to the screen, and where two are in a row
UNNAMED = re.compile(r"_(child|container)\d+|_nolegend_|")  # labels that matplotlib gives of itself
BESIDE, BESIDE_LINES = 19, 12  # of names beside lines: characters of one of theirs, and how many lines
APART = 0.085  # from one to the next, of the axes' height
LABEL = 60  # characters of a legend's line, which fits a figure of WIDTH also in capitals
STYLE: dict[str, Any] = {
    "font.family": "sans-serif",
    "font.size": 10.5,
    "text.parse_math": False,  # names are shown as they are, dollars too
    "axes.edgecolor": INK,
    "axes.labelcolor": INK,
    "axes.titlesize": 10,
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": RULE,
    "grid.linewidth": 0.6,
    "text.color": INK,
    "xtick.color": INK,
    "ytick.color": INK,
    "legend.frameon": False,
    "legend.fontsize": 9,
    "legend.columnspacing": 1.4,
    "figure.facecolor": "none",
    "axes.facecolor": "none",
    "savefig.facecolor": "none",
    "svg.fonttype": "none",
}
# matplotlib's own, whatever a notebook or a ``matplotlibrc`` has set; which windows it opens is not ours to say.
DEFAULTS = {name: value for name, value in matplotlib.rcParamsDefault.items() if name != "backend"}
PICTURE_TITLE = 0.34  # inches above a picture


def styled(more: Mapping[str, Any] | None = None) -> AbstractContextManager[None]:
    """What all figures have in common, and ``more`` of matplotlib's settings, for the time of a ``with``."""
    settings: Any = {**DEFAULTS, **STYLE, **(more or {})}
    return matplotlib.rc_context(settings)


@contextmanager
def drawing(
    height: float, columns: int, width: float = WIDTH, *, beside: bool = False, **more: Any
) -> Iterator[tuple[Figure, Axes]]:
    """One plot, ``height`` inches high; at the end its :func:`legend_below` of at most ``columns``.

    ``beside``: its :func:`label_lines` in place of that.
    """
    with styled():
        figure = Figure(figsize=(width, height), layout="constrained")
        axes = figure.subplots()
        yield figure, axes
        if beside:
            label_lines(figure, axes, columns, **more)
        else:
            legend_below(figure, [axes], columns, **more)


def legend_below(figure: Figure, places: Sequence[Axes], most: int, **more: Any) -> None:
    """A legend under the plots, for which the figure becomes higher: each label once, whichever of the plots has it.

    The figure is as wide as it is to be. There are ``most`` columns, fewer where labels are too long for so many, and
    very long labels are broken; ``more`` are matplotlib's settings of a legend.
    """
    handles: dict[str, Any] = {}
    longest = int(LABEL * figure.get_figwidth() / WIDTH)
    drawn: list[Any] = [artist for place in places for artist in (*place.lines, *place.containers)]
    for handle in drawn:
        label = str(handle.get_label())
        if not UNNAMED.fullmatch(label):  # before a name's own "_" a space, else matplotlib leaves it out
            handles.setdefault(textwrap.fill(f" {label}" if label[0] == "_" else label, longest), handle)
    if not handles:
        return
    renderer = FigureCanvasAgg(figure).get_renderer()
    for columns in range(most, 0, -1):
        legend = figure.legend(handles.values(), handles.keys(), loc="outside lower left", ncols=columns, **more)
        box = legend.get_window_extent(renderer)
        if box.width <= figure.bbox.width or columns == 1:
            figure.set_figheight(figure.get_figheight() + box.height / figure.dpi)
            return
        legend.remove()


def label_lines(figure: Figure, axes: Axes, columns: int, **more: Any) -> None:
    """Each line's name at its right end, a short piece of the line before it; :func:`legend_below` where too many.

    Names stand in the order of the lines' last values, as near to them as their room lets them.
    """
    lines = [line for line in axes.lines if not UNNAMED.fullmatch(str(line.get_label()))]
    names = [textwrap.fill(str(line.get_label()), BESIDE, break_long_words=False) for line in lines]
    rows = [name.count("\n") + 1 for name in names]
    if sum(rows) > BESIDE_LINES or any(len(row) > LABEL // 2 for name in names for row in name.split("\n")):
        legend_below(figure, [axes], columns, **more)
        return
    low, high = axes.get_ylim()
    ends = []
    for line in lines:
        values = np.asarray(line.get_ydata(), dtype=np.float64)
        values = values[np.isfinite(values)]
        ends.append((values[-1] - low) / (high - low) if len(values) else 0.0)
    order, free, places = np.argsort(ends, kind="stable").tolist(), 0.0, np.zeros(len(lines))
    for index in order:  # from below, each pushed up as far as it must be; then down again what is above the plot
        half = APART * rows[index] / 2
        places[index] = max(ends[index], free + half)
        free = places[index] + half
    free = 1 + APART
    for index in reversed(order):
        half = APART * rows[index] / 2
        places[index] = min(places[index], free - half)
        free = places[index] - half
    for line, name, place in zip(lines, names, places.tolist(), strict=True):
        piece = Line2D([1.02, 1.1], [place, place])
        piece.update_from(line)
        piece.set(transform=axes.transAxes, clip_on=False)
        axes.add_artist(piece)
        axes.annotate(name, (1.115, place), xycoords=axes.transAxes, annotation_clip=False, va="center", fontsize=9)


def grid_of_pictures(rows: int, columns: int, below: float = 0.0) -> tuple[Figure, list[Axes]]:
    """Places for pictures without axes, row by row; ``below``: inches of room under all of them."""
    with styled({"axes.titlelocation": "center"}):
        side = WIDTH / max(columns, 3)
        size = (side * columns, rows * (side + PICTURE_TITLE) + below)
        figure = Figure(figsize=size, layout="constrained")
        places = list(figure.subplots(rows, columns, squeeze=False).flat)
    for place in places:
        place.set_axis_off()
    return figure, places


def show_picture(place: Axes, image: NDArray[np.uint8], title: str) -> None:
    """A picture; of a stack of frames the last, in grey."""
    if image.ndim == 3 and image.shape[2] != 3:
        image = image[..., -1]
    if image.ndim == 2:
        image = np.repeat(image[..., None], 3, axis=2)
    place.imshow(image, interpolation="nearest")
    place.set_title(title, fontsize=9)


def slug(text: str) -> str:
    """An id, or a file's name without its ending: of other signs than letters, digits, - and _ a digest is left."""
    plain = re.sub(r"[^\w-]+", "-", text)[:80]
    return text if plain == text else f"{plain}-{blake2b(text.encode(), digest_size=4).hexdigest()}"


def _saved(figure: Figure, settings: Mapping[str, Any], **how: Any) -> bytes:
    buffer = io.BytesIO()
    with styled(settings):
        figure.savefig(buffer, **how)
    return buffer.getvalue()


def to_svg(figure: Figure, name: str) -> str:
    """The figure as SVG, the same bytes each time, its ids unique on a page by the :func:`slug` of ``name``."""
    name = slug(name)
    text = _saved(figure, {"svg.hashsalt": name}, format="svg", metadata={"Date": None, "Creator": None}).decode()
    text = text[text.index("<svg") :]
    text = re.sub(r' id="image[0-9a-f]+"', "", text)  # a hash of the picture: the same where it is drawn twice
    text = re.sub(r'\bid="', f'id="{name}-', text)
    text = re.sub(r'((?:xlink:)?href)="#', rf'\1="#{name}-', text)
    return re.sub(r"url\(#", f"url(#{name}-", text)


def to_png(figure: Figure) -> bytes:
    """The figure as a PNG on white, for READMEs and slides."""
    return _saved(figure, {}, format="png", dpi=160, facecolor="white", metadata={"Software": None})


def to_file(figure: Figure, name: str, kind: str) -> bytes:
    """The figure as ``svg``, ``png``, or ``pdf`` with its fonts in it as fonts; the same bytes each time."""
    if kind != "pdf":
        return to_svg(figure, name).encode() if kind == "svg" else to_png(figure)
    undated = {"CreationDate": None, "Producer": None, "Creator": None}
    return _saved(figure, {"pdf.fonttype": 42}, format="pdf", metadata=undated)
