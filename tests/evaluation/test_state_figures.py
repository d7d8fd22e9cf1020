"""Spec F2, F6: Figures 2, 7, 8 and 9 show every member, frame and side, and say what they show."""

import numpy as np
import pytest

from hypogoal.evaluation.plots import to_file, to_svg
from hypogoal.evaluation.saliency import EXPLAINED, attributions_of_every_frame, attributions_of_members
from hypogoal.evaluation.selection import termination_states


def explained(members, channels):
    rng = np.random.default_rng(0)
    state = rng.integers(0, 256, (12, 12, channels), dtype=np.uint8)
    values = rng.normal(size=(members, 12, 12, channels))
    said = (np.linspace(0.1, 0.9, members), np.arange(members) > 0, True)
    return dict(zip(EXPLAINED, (state, state, values, *said), strict=True))


def pictures(figure):
    return sum(len(axes.get_images()) for axes in figure.axes)


@pytest.mark.parametrize("members", [1, 3, 6])
def test_figure_2_has_the_state_and_every_member(members):
    """Spec F2: verdict and probability above each, the truth above the state, and what the colours mean."""
    drawn = attributions_of_members(explained(members, 4))
    svg = to_svg(drawn, "a")
    assert pictures(drawn) == members + 1
    for text in (
        "truth: positive",
        "member 0: negative 0.10",
        "attribution in log-odds",
        "against",
        "for &apos;reached&apos;",
    ):
        assert text in svg or text.replace("&apos;", "'") in svg
    assert ("member 5: positive 0.90" in svg) == (members == 6)


@pytest.mark.parametrize(("channels", "names"), [(4, ["3 steps before", "newest frame"]), (3, ["red", "blue"])])
def test_figure_9_has_every_member_and_frame(channels, names):
    """Spec F2: of a stack of frames each, of colours each."""
    drawn = attributions_of_every_frame(explained(3, channels))
    svg = to_svg(drawn, "a")
    assert pictures(drawn) == (3 + 1) * channels
    assert all(name in svg for name in [*names, "member 2: positive 0.90"])


def test_figures_7_and_8_say_where_a_classifier_never_ended_an_option():
    """Spec F6: the most and the least preferred member; no empty picture."""
    overlay = np.zeros((8, 8, 4), np.uint8)
    drawn = termination_states([("most preferred: member 1", overlay), ("least preferred: member 0", None)])
    assert pictures(drawn) == 1
    svg = to_svg(drawn, "a")
    assert "most preferred: member 1" in svg and "positive" in svg


@pytest.mark.parametrize(("kind", "start"), [("svg", b"<svg"), ("pdf", b"%PDF"), ("png", b"\x89PNG")])
def test_a_figure_as_a_file_is_the_same_bytes_each_time(kind, start):
    """Spec F7: in each format that can be asked for, PDFs with fonts and without a date."""
    overlay = np.zeros((8, 8, 3), np.uint8)
    first, second = (to_file(termination_states([("most", overlay)]), "name", kind) for _ in range(2))
    assert first.startswith(start)
    assert first == second
    assert b"CreationDate" not in first
