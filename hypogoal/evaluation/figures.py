"""The report's figures: numbers in, a matplotlib figure out. Colours are Okabe and Ito's, told apart by all readers."""

from __future__ import annotations

import io
import re
import textwrap
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from hashlib import blake2b
from typing import Any

import matplotlib
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
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
Bounds = tuple[float | None, float | None]
SHARES: Bounds = (-0.02, 1.04)  # limits for what lies within 0 and 1, so that a line on either is seen
WIDTH = 5.6  # inches; readable on a phone where it is scaled to the screen
LABEL = 60  # characters of a legend's line, which fits the figure also in capitals
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


def styled(more: Mapping[str, Any] | None = None) -> AbstractContextManager[None]:
    """What all figures have in common, and ``more`` of matplotlib's settings, for the time of a ``with``."""
    settings: Any = {**STYLE, **(more or {})}
    return matplotlib.rc_context(settings)


def legend_below(figure: Figure, places: Sequence[Axes], most: int, **more: Any) -> None:
    """A legend under the plots, for which the figure becomes higher: each label once, whichever of the plots has it.

    Args:
        figure: as wide as it is to be.
        places: its plots.
        most: columns; fewer where labels are too long for so many, and very long labels are broken.
        more: matplotlib's settings of a legend.
    """
    handles: dict[str, Artist] = {}
    for place in places:
        for handle, label in zip(*place.get_legend_handles_labels(), strict=True):
            handles.setdefault(textwrap.fill(label, LABEL), handle)
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


@dataclass(frozen=True)
class Line:
    """One agent's curve: values float (R, G), a row per run, NaN where it has no value."""

    name: str
    values: NDArray[np.float64]
    colour: str
    dashed: bool = False


def reward_bounds(lines: Sequence[Line]) -> Bounds:
    """The reward axis: the same for all tasks whose rewards are shares of episodes; else what fits the values.

    Args:
        lines: those that are drawn.
    """
    values = np.concatenate([np.zeros(0), *(line.values.ravel() for line in lines)])
    known = values[np.isfinite(values)]
    return SHARES if bool(((known >= 0) & (known <= 1)).all()) else (None, None)


def learning_curves(
    grid: NDArray[np.int64],
    lines: Sequence[Line],
    quantity: str,
    references: Sequence[tuple[str, float]] = (),
    bounds: Bounds = (0.0, None),
) -> Figure:
    """Figure 6: a quantity of episodes against environment steps; mean over runs, bands of one standard error.

    Args:
        grid: int (G,), environment steps.
        lines: one per agent.
        quantity: the y axis's label, with its unit.
        references: horizontal lines with their names.
        bounds: of the y axis, None for what fits the values.
    """
    with styled():
        figure = Figure(figsize=(WIDTH, 3.1), layout="constrained")
        axes = figure.subplots()
        for line in lines:
            _draw_curve(axes, grid / 1000, line)
        for (name, value), style in zip(references, (":", (0, (1, 3)), "-."), strict=False):
            axes.axhline(value, color=GREY, linewidth=1.2, linestyle=style, label=name)
        axes.set_xlabel("environment steps, in thousands")
        axes.set_ylabel(quantity)
        axes.set_xlim(0, grid[-1] / 1000)
        axes.set_ylim(*bounds)
        legend_below(figure, [axes], 2, handlelength=2.4)
        return figure


def _draw_curve(axes: Axes, steps: NDArray[np.float64], line: Line) -> None:
    known = (~np.isnan(line.values)).sum(0)
    total = np.nansum(line.values, axis=0)
    shown = known > 0
    mean = np.where(shown, total / np.maximum(known, 1), np.nan)
    squares = np.nansum((line.values - mean) ** 2, axis=0)
    error = np.sqrt(squares / np.maximum(known - 1, 1) / np.maximum(known, 1))
    style = "--" if line.dashed else "-"
    axes.plot(steps, mean, color=line.colour, linestyle=style, linewidth=1.6, label=line.name)
    if len(line.values) > 1:
        low, high = (mean - error)[shown], (mean + error)[shown]
        axes.fill_between(steps[shown], low, high, color=line.colour, alpha=0.18, linewidth=0)


def best_mean_worst_members(sub_goals: Sequence[str], kinds: Sequence[tuple[str, NDArray[np.float64]]]) -> Figure:
    """Figure 3's quantity for one labelled layout: balanced accuracy on held-out layouts, by kind of ensemble.

    Args:
        sub_goals: G names.
        kinds: (name, float (G, 3)) with each sub-goal's best, mean and worst member, mean over seeds.
    """
    with styled():
        step = 0.8 / max(1, len(kinds))
        height = 1.2 + len(sub_goals) * max(0.42, 0.2 * len(kinds))
        figure = Figure(figsize=(WIDTH, height), layout="constrained")
        axes = figure.subplots()
        places = np.arange(len(sub_goals), dtype=np.float64)
        for index, (name, values) in enumerate(kinds):
            y = places + (index - (len(kinds) - 1) / 2) * step
            colour, marker = PALETTE[index % len(PALETTE)], MARKERS[index % len(MARKERS)]
            axes.hlines(y, values[:, 2], values[:, 0], color=colour, linewidth=1.6, alpha=0.6)
            axes.plot(values[:, 0], y, marker, color=colour, markersize=7, label=name)
            axes.plot(values[:, 1], y, "|", color=colour, markersize=10, markeredgewidth=1.8)
            axes.plot(values[:, 2], y, marker, color=colour, markersize=5, fillstyle="none")
        axes.axvline(0.5, color=GREY, linewidth=1.2, linestyle=":")
        axes.set_yticks(places, sub_goals)
        axes.invert_yaxis()
        axes.grid(visible=False, axis="y")
        axes.set_xlim(min(0.45, float(np.nanmin([values for _, values in kinds])) - 0.03), 1.02)
        axes.set_xlabel("balanced accuracy on held-out states (0.5: chance)")
        legend_below(figure, [axes], 3)
        return figure


def preference_against_match(
    sub_goals: Sequence[str],
    match: NDArray[np.float64],
    preference: NDArray[np.float64],
    control: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None,
) -> Figure:
    """Question 5 of the paper: is the member that is chosen more often the one that fits the true sub-goal?

    Args:
        sub_goals: G names.
        match: float (R, G, K), a member's balanced accuracy on the run's layout.
        preference: float (R, G, K), chosen / expected under uniform choice.
        control: the same two arrays, flat, of the random chooser.
    """
    with styled():
        figure = Figure(figsize=(WIDTH, 3.9), layout="constrained")
        axes = figure.subplots()
        if control is not None:
            x, y = control
            axes.plot(x, y, ".", color=GREY, markersize=5, alpha=0.6, label="random choice")
        for index, name in enumerate(sub_goals):
            colour, marker = PALETTE[index % len(PALETTE)], MARKERS[index % len(MARKERS)]
            x, y = match[:, index].ravel(), preference[:, index].ravel()
            axes.plot(x, y, marker, color=colour, markersize=6, alpha=0.85, linestyle="none", label=name)
        axes.axhline(1.0, color=GREY, linewidth=1.2, linestyle=":")
        axes.set_yscale("symlog", base=2, linthresh=0.25)
        top = max(2.0, float(np.nanmax(preference))) if np.isfinite(preference).any() else 2.0
        ticks = [0, 0.25, 0.5, *(2.0**power for power in range(int(np.ceil(np.log2(top))) + 1))]
        axes.set_yticks(ticks, [f"{tick:g}" for tick in ticks])
        axes.minorticks_off()
        axes.set_ylim(-0.04, ticks[-1] * 1.1)
        axes.set_xlabel("match: balanced accuracy on the run's layout")
        axes.set_ylabel("preference: chosen / expected")
        legend_below(figure, [axes], 3, handletextpad=0.3)
        return figure


def slug(text: str) -> str:
    """An id, or a file's name without its ending: of other signs than letters, digits, - and _ a digest is left."""
    plain = re.sub(r"[^\w-]+", "-", text)[:80]
    return text if plain == text else f"{plain}-{blake2b(text.encode(), digest_size=4).hexdigest()}"


def to_svg(figure: Figure, name: str) -> str:
    """The figure as an SVG document, the same bytes each time.

    Args:
        figure: any figure.
        name: its :func:`slug` makes the ids inside unique among several on one page.
    """
    name = slug(name)
    buffer = io.StringIO()
    with styled({"svg.hashsalt": name}):
        figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None})
    text = buffer.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(r' id="image[0-9a-f]+"', "", text)  # a hash of the picture: the same where it is drawn twice
    text = re.sub(r'\bid="', f'id="{name}-', text)
    text = re.sub(r'((?:xlink:)?href)="#', rf'\1="#{name}-', text)
    return re.sub(r"url\(#", f"url(#{name}-", text)


def to_png(figure: Figure) -> bytes:
    """The figure as a PNG on white, for READMEs and slides."""
    buffer = io.BytesIO()
    with styled():
        figure.savefig(buffer, format="png", dpi=160, facecolor="white", metadata={"Software": None})
    return buffer.getvalue()


def to_pdf(figure: Figure) -> bytes:
    """The figure as a PDF with its fonts in it as fonts, for papers; the same bytes each time."""
    buffer = io.BytesIO()
    with styled({"pdf.fonttype": 42}):
        figure.savefig(buffer, format="pdf", metadata={"CreationDate": None, "Producer": None, "Creator": None})
    return buffer.getvalue()


def to_file(figure: Figure, name: str, kind: str) -> bytes:
    """The figure as ``svg``, ``pdf`` or ``png``."""
    if kind == "svg":
        return to_svg(figure, name).encode()
    return to_pdf(figure) if kind == "pdf" else to_png(figure)
