"""Spec F2, F6, F7: which states are browsed, and how they and their attributions become small pictures."""

import io
import json

import numpy as np
import pytest
from browser import needs_browser, run_in
from PIL import Image

from hypogoal.evaluation.attributing import pick_for_gallery
from hypogoal.evaluation.pictures import attribution_image, coloured, encoded, last_frame


def test_states_on_which_members_disagree_or_err_come_first():
    """Spec F7: one such state in 1,000 is shown though only 12 are; alike each time; places come up evenly."""
    labels = np.arange(1000) % 2 == 0
    verdicts = np.repeat(labels[:, None], 3, axis=1)
    verdicts[500] = ~verdicts[500]  # all err
    verdicts[501, 1] = ~verdicts[501, 1]  # members disagree
    rooms = np.arange(1000) // 250
    pick = [pick_for_gallery(verdicts, labels, {"room": rooms}, np.random.default_rng(0))[:12] for _ in range(2)]
    np.testing.assert_array_equal(*pick)
    assert {500, 501} == set(pick[0][:2].tolist()) and len(set(pick[0].tolist())) == 12
    assert np.bincount(rooms[pick[0]], minlength=4).min() >= 2
    assert labels[pick[0]].sum() == 6, "labels take turns"


def test_what_is_drawn_of_a_state():
    """Spec F2: of one frame its colours, of stacked grey frames the last, of stacked colour frames the last three."""
    assert last_frame(np.array([[9.0, 9, 9, 1, 2, 3]]), 3).tolist() == [[1, 2, 3]]
    assert last_frame(np.array([[1.0, 2.0, 3.0]])).tolist() == [[1, 2, 3]]
    assert last_frame(np.array([[1.0, 2.0, 3.0, 4.0]])).tolist() == [[4]]
    assert coloured(np.arange(4, dtype=np.uint8)[None]).tolist() == [[3, 3, 3]]


def test_the_picture_tells_signs_apart():
    """Figures 2 and 9: orange speaks for, blue against, white is nothing; the state shows through in grey."""
    values = np.array([[1.0, -1.0, 0.0, 0.0]])[..., None]
    state = np.array([[0, 0, 0, 255]], np.uint8)[..., None]
    image = attribution_image(values, state)[0].astype(int)
    red, green, blue = image.T
    assert red[0] > blue[0] and blue[1] > red[1]
    assert image[2].tolist() == [255, 255, 255]
    assert red[3] == green[3] == blue[3] and 150 < red[3] < 230
    np.testing.assert_array_equal(attribution_image(100 * values, state)[0], image, "each has its own scale")
    assert (attribution_image(0 * values, 0 * state) == 255).all()
    summed = attribution_image(np.array([[[9.0, 2, 1]]]), np.zeros((1, 1, 3), np.uint8))
    np.testing.assert_array_equal(summed, attribution_image(np.ones((1, 1, 1)), np.zeros((1, 1, 1), np.uint8)))


def test_pictures_on_the_page_are_the_same_pixels_and_large_ones_reduced():
    """Spec F7: a page of own photographs stays one that can be opened; small pictures are shown pixel for pixel."""
    image = np.random.default_rng(0).integers(256, size=(300, 257, 3), dtype=np.uint8)
    small = image[:128, :128]
    np.testing.assert_array_equal(np.asarray(Image.open(io.BytesIO(encoded(small)))), small)
    reduced = np.asarray(Image.open(io.BytesIO(encoded(image)))).astype(float)
    assert reduced.shape == (100, 86, 3)
    np.testing.assert_allclose(reduced[1, 2], image[3:6, 6:9].mean((0, 1)), atol=1)


FILTER = """
const goals = document.querySelector("select[data-filter=goal]");
goals.value = "open-red-door";
goals.dispatchEvent(new Event("change"));
const states = [...document.querySelectorAll(".gallery li")];
const shown = states.filter((state) => !state.hidden).map((state) => state.dataset.goal);
document.title = JSON.stringify([shown, states.length, document.querySelector("[role=status]").textContent]);
"""


@pytest.mark.browser
@needs_browser
def test_the_filters_of_the_gallery(tiny_run, tmp_path):
    """Spec F2: states of the chosen sub-goal alone are left, and counted; the policy lets the page's own script run."""
    title, complaints = run_in(tiny_run / "report" / "index.html", FILTER, tmp_path)
    shown, states, count = json.loads(title)
    assert complaints == []
    assert {*shown} == {"open-red-door"} and len(shown) < states
    assert count == f"{len(shown)} of {states} states"
