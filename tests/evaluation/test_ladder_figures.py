"""Spec F1, F3, F4: Figures 3, 4 and 5 say what they show, whatever is not a number in them."""

import numpy as np
import pytest

from hypogoal.evaluation.distance import distance_bars, stops_over_rooms
from hypogoal.evaluation.plots import to_png, to_svg
from hypogoal.evaluation.rooms import scores_over_groups

ACCURACY = ("accuracy, all rooms", "all", "accuracy", "best")
BALANCED = ("balanced, unseen", "unseen", "balanced_accuracy", "best")


def row(method, groups, mean, deviation=None, never=None):
    """As metrics.json has it: null where there is no number."""
    best = {"best": {"mean": mean, "standard_deviation": deviation}}
    scores = {scope: {"accuracy": best, "balanced_accuracy": best} for scope in ("all", "unseen")}
    about = {"method": method, "groups": groups, "scores": scores}
    return {**about, "all_negative": {"all": never}, "positives": {"all": 3, "unseen": int(groups == 1)}}


def scores():
    several = [row("dbat, K=6", 1, 0.6, 0.1, 0.9), row("dbat, K=6", 2, 0.9, 0.05), row("dbat, K=6", 7, None, None, 0.8)]
    return scores_over_groups([*several, row("single CNN", 1, 0.5, None, 0.9)], [ACCURACY, BALANCED])


def bars():
    found = [
        ("dbat, K=6", "N=1", 40.0, 5.0, (35.0, 45.0)),
        ("single CNN", "N=1", 280.0, np.nan, (280.0,)),
        ("oracle termination", "true sub-goal", 2.0, 0.0, (2.0, 2.0)),
    ]
    return distance_bars(found, ["dbat, K=6", "single CNN"], 300)


def stops(rooms=(1, 4)):
    pictures = [(room, np.full((210, 160, 3), 40, np.uint8)) for room in rooms]
    where = np.array([1, 1, 4, 9])
    pixels = np.array([[20.5, 30], [40, 50], [60, 70], [0, 0]])
    return stops_over_rooms(pictures, [("dbat", where, pixels, np.array([0, 1, 2, 0]))] * 3)


@pytest.mark.parametrize(
    ("draw", "texts"),
    [
        (scores, ["accuracy, all rooms", "balanced, unseen", "dbat, K=6", "single CNN", "labelled groups, N"]),
        (bars, ["N=1", "true sub-goal", "oracle termination", "distance to the true sub-goal", "began inside"]),
        (stops, ["dbat, room 1", "room 4", "at the true sub-goal", "elsewhere", "began inside: counts 300"]),
    ],
)
def test_figures_say_what_they_show(draw, texts):
    """Spec F: axes and legends are text in the SVG, which is the same bytes each time."""
    svg = to_svg(draw(), "name")
    for text in texts:
        assert text in svg
    assert svg == to_svg(draw(), "name")
    assert "NaN" not in svg
    assert to_png(draw()).startswith(b"\x89PNG")


def test_where_there_is_no_number_there_is_no_point():
    """Figure 3: a method's line ends where its score is not defined."""
    line = scores().axes[1].get_lines()[0]
    np.testing.assert_array_equal(line.get_ydata(), [0.6, 0.9, np.nan])
    assert scores().axes[1].get_xticks().tolist() == [1, 2, 7]
    blind = scores().axes[0].get_lines()[-1]
    assert (list(blind.get_xdata()), list(blind.get_ydata())) == ([1, 7], [0.9, 0.8])


NAMES = [f"dbat, K=3, some_setting=value-{index}" for index in range(20)]


def test_many_methods_are_told_apart():
    """Figures 3 and 4: all of them in the legend, which the figure has room for, and no two drawn alike."""
    lines = [row(name, groups, 0.6, 0.1) for name in NAMES for groups in (1, 2, 7)]
    bars = [(name, "N=1", 40.0, np.nan, (40.0,)) for name in NAMES]
    curves, columns = scores_over_groups(lines, [ACCURACY]), distance_bars(bars, NAMES, 300)
    for figure in (curves, columns):
        to_png(figure)  # lays it out
        (legend,) = figure.legends
        assert [text.get_text() for text in legend.get_texts()] == NAMES
        box = legend.get_window_extent()
        assert box.x1 <= figure.bbox.x1 and box.y0 >= 0
        assert figure.axes[0].get_window_extent().height / figure.dpi > 1.5
    drawn = [(line.get_color(), str(line._dash_pattern)) for line in curves.axes[0].get_lines()[:20]]
    assert len(set(drawn)) == 20
    assert len({(patch.get_facecolor(), patch.get_hatch()) for patch in columns.axes[0].patches}) == 20
    assert all(patch.get_edgecolor() != patch.get_facecolor() for patch in columns.axes[0].patches)  # hatches are seen


def test_with_one_n_methods_stand_side_by_side_with_error_bars():
    """Figure 3: a band would have no width, and methods would hide each other."""
    names = NAMES[:3]
    axes = scores_over_groups([row(name, 1, 0.8, 0.1) for name in names], [BALANCED]).axes[0]
    assert len(axes.containers) == 3
    places = [bars.lines[2][0].get_segments()[0] for bars in axes.containers]
    np.testing.assert_allclose([place[:, 1] for place in places], [[0.7, 0.9]] * 3)
    np.testing.assert_allclose([place[0, 0] for place in places], [0.94, 1.0, 1.06])
    marks = [line.get_xdata()[0] for line in axes.get_lines() if line.get_label() in names]
    np.testing.assert_allclose(marks, [0.94, 1.0, 1.06])


def test_a_bar_is_as_high_as_its_mean():
    """Figure 4: bars of methods side by side, the oracle's in a group of its own."""
    heights = [patch.get_height() for patch in bars().axes[0].patches]
    assert heights == [40, 280, 2]


def test_stops_are_drawn_in_their_room_by_shape():
    """Figure 5: hits, misses and what began inside differ in marker and in colour; a stop is in one room only."""
    axes = stops().axes
    assert len(axes) == 6
    first = {line.get_marker(): line.get_xdata().tolist() for line in axes[0].get_lines()[:3]}
    assert first == {"o": [20.5], "x": [40], "s": []}
    second = {line.get_marker(): line.get_xdata().tolist() for line in axes[1].get_lines()[:3]}
    assert second == {"o": [], "x": [], "s": [60]}
    assert len({line.get_color() for line in axes[0].get_lines()[:3]}) == 3
    assert len(stops((1,)).axes) == 3
