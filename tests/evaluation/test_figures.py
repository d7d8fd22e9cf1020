"""Spec F: figures say what they show, whatever is not a number in them, and come out the same each time."""

from itertools import pairwise

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg

from hypogoal.evaluation.curves import Line, learning_curves
from hypogoal.evaluation.distance import distance_bars
from hypogoal.evaluation.hypotheses import best_mean_worst_members
from hypogoal.evaluation.pictures import image_png
from hypogoal.evaluation.plots import BLUE, STYLES, VERMILLION, to_png, to_svg

GRID = np.arange(0, 1_001, 100)


def curves():
    several = np.linspace(0, 1, 11) * np.array([[1.0], [0.8], [0.6]])
    several[1, 7:] = np.nan
    several[:, 0] = np.nan
    lines = [Line("options", GRID, several, BLUE), Line("PPO", GRID, several[:1], VERMILLION, STYLES[1])]
    return learning_curves(lines, "reward", {"random play": 0.1})


def of_members(name, sub_goal, best, mean, worst):
    """As metrics.json has it: null where there is no number."""
    scores = {"best": best, "mean": mean, "worst": worst}
    return {"name": name, "sub_goal": sub_goal, **{which: {"mean": score} for which, score in scores.items()}}


def members():
    found = [
        ("dbat, K=3", "red", 0.9, 0.8, 0.7),
        ("dbat, K=3", "blue", 1.0, None, 0.5),
        ("single CNN", "red", 0.8, 0.7, 0.6),
    ]
    return best_mean_worst_members([of_members(*values) for values in found])


@pytest.mark.parametrize(
    ("draw", "texts"),
    [
        (curves, ["options", "PPO", "random play", "reward per episode", "environment steps, in thousands"]),
        (members, ["red", "blue", "dbat, K=3", "single CNN", "balanced accuracy on held-out states"]),
    ],
)
def test_figures_say_what_they_show(draw, texts):
    """Spec F: axes, units and legends are text in the SVG, which is the same bytes each time."""
    svg = to_svg(draw(), "name")
    for text in texts:
        assert text in svg
    assert svg == to_svg(draw(), "name")
    assert "NaN" not in svg
    assert 'id="name-' in svg
    assert 'id="figure_1"' not in svg
    assert to_png(draw()).startswith(b"\x89PNG")


def test_the_curve_is_the_mean_of_runs_that_have_a_value():
    """Figure 6: where one of three runs has ended the mean is of the other two."""
    line = curves().axes[0].get_lines()[0]
    assert line.get_label() == "options"
    np.testing.assert_allclose(line.get_ydata()[1:7], np.linspace(0, 1, 11)[1:7] * 0.8)
    np.testing.assert_allclose(line.get_ydata()[7:], np.linspace(0, 1, 11)[7:] * 0.8)
    assert np.isnan(line.get_ydata()[0])


LONG = [
    "options (learned members), ensemble=dbat, K=3, termination=one_room:Patience:10000, option_gamma=0.99",
    "options (learned members), ensemble=no diversity, K=3",
    "PPO tuned, COST=$a_1$ b$^$",
    "RANDOM CHOICE WHILE OPTIONS LEARN, ENSEMBLE=NO DIVERSITY, AND MORE",
]


def long_curves():
    values = np.linspace(0, 1, 11)[None]
    return learning_curves([Line(name, GRID, values, BLUE) for name in LONG], "reward")


def long_members():
    return best_mean_worst_members([of_members(name, "red", 0.8, 0.8, 0.8) for name in LONG])


@pytest.mark.parametrize("draw", [long_curves, long_members])
def test_every_entry_of_a_legend_is_on_the_picture(draw):
    """Spec F: fewer columns and broken lines for long names, a higher figure for many; a dollar is a dollar."""
    figure = draw()
    assert to_png(figure)  # lays it out
    (legend,) = figure.legends
    assert [" ".join(text.get_text().split()) for text in legend.get_texts()] == LONG
    box, whole = legend.get_window_extent(), figure.bbox
    assert box.x0 >= 0 and box.y0 >= 0 and box.x1 <= whole.x1
    assert figure.axes[0].get_window_extent().y0 > box.y1
    assert figure.axes[0].get_window_extent().height / figure.dpi > 0.8


def test_names_beside_lines_do_not_lie_on_each_other():
    """Spec F: lines that end alike have their names one above the other, none above or below the picture."""
    lines = [
        Line(name, GRID, np.full((1, 11), end), BLUE) for name, end in (("a", 1.0), ("b", 1.0), ("c", 1.0), ("d", 0.0))
    ]
    figure = learning_curves(lines, "reward", {"random play": 0.0})
    FigureCanvasAgg(figure).draw()  # lays it out
    assert not figure.legends
    texts = {text.get_text(): text.get_window_extent() for text in figure.axes[0].texts}
    assert list(texts) == ["a", "b", "c", "d", "random play"]
    boxes = sorted(texts.values(), key=lambda box: box.y0)
    assert all(below.y1 <= above.y0 + 1 for below, above in pairwise(boxes))
    assert boxes[0].y0 >= 0 and boxes[-1].y1 <= figure.bbox.y1 and max(box.x1 for box in boxes) <= figure.bbox.x1
    assert texts["d"].y1 < texts["c"].y0 and texts["c"].y0 > figure.bbox.y1 / 2


def test_an_observation_as_png_is_the_same_pixels():
    """Spec F7: the picture in the page is the state itself."""
    import io

    from matplotlib.image import imread

    image = np.random.default_rng(0).integers(0, 256, (8, 8, 3), dtype=np.uint8)
    read = imread(io.BytesIO(image_png(image)))
    np.testing.assert_array_equal((read[..., :3] * 255).round().astype(np.uint8), image)


def test_a_name_that_begins_with_an_underscore_is_in_the_legend():
    """Spec F: matplotlib takes such a label for its own; a user's sub-goal or setting may be called so."""
    values = np.linspace(0, 1, 11)[None]
    for figure in (
        best_mean_worst_members([of_members(name, "red", 0.8, 0.8, 0.8) for name in ("_x", "red")]),
        learning_curves([Line("_x", GRID, values, BLUE), Line("red", GRID, values, VERMILLION)], "reward"),
        distance_bars([(name, "N=1", 4.0, 1.0, (3.0, 5.0)) for name in ("_x", "red")], ["_x", "red"], 300),
    ):
        named = figure.legends[0].get_texts() if figure.legends else figure.axes[0].texts
        assert [text.get_text().strip() for text in named] == ["_x", "red"]
