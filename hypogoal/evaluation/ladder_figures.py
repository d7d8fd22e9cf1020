"""Figures 3, 4 and 5: scores over labelled ladders, distances as bars, and stops drawn over the rooms."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from hypogoal.evaluation.distance import BEGAN_INSIDE, HIT, MISS
from hypogoal.evaluation.figures import (
    BLUE,
    GREEN,
    GREY,
    INK,
    MARKERS,
    ORANGE,
    PURPLE,
    SKY,
    VERMILLION,
    WIDTH,
    legend_below,
    styled,
)

GAP, TITLE = 0.08, 0.24  # inches, between pictures and above each
METHOD_COLOURS = (BLUE, VERMILLION, GREEN, PURPLE, ORANGE, SKY)
STYLES = ("-", "--", "-.", ":", (0, (5, 1)))  # 5 beside 6 colours: both come again together after 30
HATCHES = ("", "//", r"\\", "xx")  # of bars, from one round of colours to the next
BESIDE, MOST_BESIDE = 0.06, 0.6  # units of N between methods with one N, and at most from the first to the last
STOPS = {
    HIT: ("at a true base", "o", SKY),
    MISS: ("elsewhere", "x", ORANGE),
    BEGAN_INSIDE: ("began inside: counts 300", "s", PURPLE),
}


@dataclass(frozen=True)
class Series:
    """One method over N: arrays (n,), the mean and the standard deviation over seeds; NaN where there is none."""

    name: str
    groups: NDArray[np.int64]
    mean: NDArray[np.float64]
    deviation: NDArray[np.float64]


@dataclass(frozen=True)
class Panel:
    """One small plot: its title, by N what it takes no seeing to score (dotted), and a series per method."""

    title: str
    blind: Mapping[int, float]
    series: Sequence[Series]


def scores_over_groups(panels: Sequence[Panel], names: Sequence[str]) -> Figure:
    """Figure 3: scores against the number of labelled ladder groups; bands of one standard deviation.

    A method with one N has an error bar instead of a band, a little beside the other methods'.

    Args:
        panels: two in a row.
        names: all methods, in the order of their colours.
    """
    with styled():
        rows = -(-len(panels) // 2)
        figure = Figure(figsize=(WIDTH, 2.25 * rows + 0.05), layout="constrained")
        axes = figure.subplots(rows, 2, sharex=True, sharey=True, squeeze=False)
        values = [series.mean - np.nan_to_num(series.deviation) for panel in panels for series in panel.series]
        known = np.concatenate([*values, [0.5]])
        ticks = sorted({int(group) for panel in panels for series in panel.series for group in series.groups})
        for place, panel in zip(axes.flat, panels, strict=False):
            for series in panel.series:
                _draw_series(place, series, names.index(series.name), len(names))
            if len(panel.blind) == 1:  # of one N a line is a point, which a method's marker may hide
                place.axhline(*panel.blind.values(), color=GREY, linewidth=1.2, linestyle=":", zorder=0)
            else:
                place.plot(list(panel.blind), list(panel.blind.values()), ".:", color=GREY, linewidth=1.2, markersize=3)
            place.set_title(panel.title, fontsize=9.5)
            place.set_ylim(max(0.0, float(np.nanmin(known)) - 0.03), 1.03)
            place.set_xticks(ticks)
            place.set_xlim(min(ticks, default=0) - 0.4, max(ticks, default=1) + 0.4)
        for place in axes[-1]:
            place.set_xlabel("labelled ladder groups, N")
        for place in axes[:, 0]:
            place.set_ylabel("fraction")
        for place in axes.flat[len(panels) :]:
            place.set_visible(False)
        legend_below(figure, list(axes.flat), 3, handlelength=2.6)
        return figure


def _draw_series(axes: Axes, series: Series, index: int, count: int) -> None:
    """The series of method ``index`` of ``count``."""
    colour, line = METHOD_COLOURS[index % len(METHOD_COLOURS)], STYLES[index % len(STYLES)]
    marker = MARKERS[index % len(MARKERS)]
    groups = series.groups.astype(np.float64)
    if len(groups) == 1:  # the others with one N lie at the same place
        groups += (index - (count - 1) / 2) * min(BESIDE, MOST_BESIDE / count)
    axes.plot(groups, series.mean, marker, linestyle=line, color=colour, linewidth=1.6, markersize=5, label=series.name)
    shown = ~(np.isnan(series.mean) | np.isnan(series.deviation))
    mean, deviation = series.mean[shown], series.deviation[shown]
    if len(mean) == 1:  # a band would have no width
        axes.errorbar(groups[shown], mean, deviation, color=colour, capsize=3, linewidth=1.2)
    else:
        axes.fill_between(groups[shown], mean - deviation, mean + deviation, color=colour, alpha=0.15, linewidth=0)


@dataclass(frozen=True)
class Bar:
    """One bar of Figure 4: mean and standard deviation over seeds (NaN for one), and the seeds' own values."""

    name: str
    group: str
    mean: float
    deviation: float
    seeds: Sequence[float]


def distance_bars(bars: Sequence[Bar], names: Sequence[str], inside: float) -> Figure:
    """Figure 4: the best member's distance; lower is better.

    Args:
        bars: their groups are put side by side in the order in which they come.
        names: all methods, in the order of their colours; any other name is drawn grey.
        inside: what an execution counts that begins inside its own termination set, drawn as a line if it is near.
    """
    with styled():
        figure = Figure(figsize=(WIDTH, 3.1), layout="constrained")
        axes = figure.subplots()
        groups = list(dict.fromkeys(bar.group for bar in bars))
        highest = max((bar.mean + np.nan_to_num(bar.deviation) for bar in bars), default=1.0)
        for place, group in enumerate(groups):
            own = [bar for bar in bars if bar.group == group]
            width = min(0.26, 0.84 / len(own))
            for index, bar in enumerate(own):
                x = place + (index - (len(own) - 1) / 2) * width
                turn, method = divmod(names.index(bar.name), len(METHOD_COLOURS)) if bar.name in names else (0, -1)
                colour = METHOD_COLOURS[method] if method >= 0 else GREY
                hatch = HATCHES[turn % len(HATCHES)]
                look: dict[str, Any] = {"color": colour, "edgecolor": INK, "linewidth": 0, "alpha": 0.8, "hatch": hatch}
                axes.bar(x, bar.mean, width * 0.92, label=bar.name, **look)
                if np.isfinite(bar.deviation):
                    axes.errorbar(x, bar.mean, bar.deviation, color=INK, capsize=3, linewidth=1.2)
                spots = np.full(len(bar.seeds), x)
                axes.plot(spots, bar.seeds, ".", color=INK, markersize=5, alpha=0.7)
        if highest > inside / 2:
            axes.axhline(inside, color=GREY, linewidth=1.2, linestyle=":", label="began inside its own termination set")
        axes.set_xticks(range(len(groups)), groups)
        axes.set_xlim(-0.6, len(groups) - 0.4)
        axes.grid(visible=False, axis="x")
        axes.set_ylim(0, None)
        axes.set_ylabel("distance to the nearest true base\n(units of position)")
        legend_below(figure, [axes], 2, handlelength=2.6)
        return figure


@dataclass(frozen=True)
class Stops:
    """Where one option stopped: rooms (n,), pixels (n, 2) in their pictures, fates (n,) (see ``distance.fates``)."""

    title: str
    rooms: NDArray[np.int64]
    pixels: NDArray[np.int64]
    fates: NDArray[np.int64]


def stops_over_rooms(pictures: Sequence[tuple[int, NDArray[np.uint8]]], options: Sequence[Stops]) -> Figure:
    """Figure 5: a row per option, its rooms side by side; with one room two options in a row.

    What became of an execution is told by shape and by colour.

    Args:
        pictures: (room, uint8 (H, W, 3)).
        options: whose stops.
    """
    with styled():
        columns = max(2, len(pictures))
        panels = [(stops, room, picture) for stops in options for room, picture in pictures]
        rows = -(-len(panels) // columns)
        height, width = pictures[0][1].shape[:2]
        wide = (WIDTH - (columns - 1) * GAP) / columns  # inches
        high = wide * height / width
        size = (WIDTH, rows * (high + TITLE) + TITLE)
        figure = Figure(figsize=size)
        for index, (stops, room, picture) in enumerate(panels):
            row, column = divmod(index, columns)
            left, bottom = column * (wide + GAP), size[1] - (row + 1) * (high + TITLE)
            place = figure.add_axes((left / size[0], bottom / size[1], wide / size[0], high / size[1]))
            place.set_axis_off()
            place.imshow(picture, interpolation="none", aspect="auto")
            _draw_stops(place, stops, room)
            first = room == pictures[0][0]
            title = f"{stops.title}, room {room}" if first else f"room {room}"
            place.set_title(title, pad=3, fontsize=9.5 if columns == 2 else 8)
        handles = [Line2D([], [], marker=marker, color=colour, **_mark(marker)) for _, marker, colour in STOPS.values()]
        labels = [name for name, _, _ in STOPS.values()]
        figure.legend(handles, labels, loc="lower left", ncols=3, handletextpad=0.2, columnspacing=1.2, borderpad=0)
        return figure


def _mark(marker: str) -> dict[str, Any]:
    more: dict[str, dict[str, Any]] = {
        "o": {"markeredgewidth": 0.6, "markeredgecolor": INK},
        "s": {"fillstyle": "none"},
    }
    return {"linestyle": "none", "markersize": 6, "markeredgewidth": 1.5, **more.get(marker, {})}


def _draw_stops(axes: Axes, stops: Stops, room: int) -> None:
    for fate, (_, marker, colour) in STOPS.items():
        here = (stops.rooms == room) & (stops.fates == fate)
        x, y = stops.pixels[here].T
        axes.plot(x, y, marker, color=colour, alpha=0.75, **_mark(marker))
