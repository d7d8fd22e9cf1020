"""Spec F2, F6, F7: which states are browsed, and how they and their attributions become small pictures."""

import io
import json
import re
from html import unescape
from types import SimpleNamespace

import h5py
import numpy as np
import pytest
import torch
from browser import needs_browser, run_in
from PIL import Image
from torch import nn

from hypogoal.data import Collected, States, write_dataset
from hypogoal.evaluation import page
from hypogoal.evaluation.judging import Judged, Judgement, Work
from hypogoal.evaluation.parting import outcomes, pick_for_gallery, pick_to_explain
from hypogoal.evaluation.pictures import attribution_image, coloured, encoded, last_frame, overlay
from hypogoal.evaluation.run import Contents
from hypogoal.evaluation.saliency import look
from hypogoal.evaluation.table import joined
from hypogoal.hypotheses import ensemble as hypotheses


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


def test_outcomes_by_hand() -> None:
    """Spec F7: the filters of the gallery, of three members."""
    labels = np.array([True, True, True, False])
    predictions = np.array([[1, 1, 1], [1, 0, 0], [0, 0, 0], [1, 1, 0]], dtype=np.bool_)
    assert outcomes(predictions, labels).tolist() == ["all right", "disagree", "all wrong", "disagree"]


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


def test_attributions_are_to_what_members_see(tmp_path, monkeypatch):
    """Spec F2: of an ensemble that sees a window, what is attributed to, drawn and averaged is the window."""

    member = nn.Linear(2, 2, bias=False)
    with torch.no_grad():
        member.weight[:] = torch.tensor([[0.0, 0.0], [1.0, 2.0]])
    ensemble = SimpleNamespace(members=[nn.Sequential(nn.Flatten(), member)], see=lambda states: states[:, :, 1:])
    values = np.array([[0.2, 0, 1], [0.4, 1, 0], [0, 0, 0]])
    observations = (255 * values[:, None, :, None]).round().astype(np.uint8)
    labels = np.array([True, False, False])
    yes = np.array([[True], [True], [False]])
    sure = np.array([[0.9], [0.8], [0.1]], np.float32)
    judged = Judged(labels, {}, sure, yes, yes[2:], np.array([0.5], np.float32))
    stored = States(observations, labels[:, None])
    data = Collected((1, 3, 1), ("down",), stored, States(observations[2:], np.zeros((1, 0), np.bool_)), stored)
    write_dataset(tmp_path / "data.h5", data, domain="x", config={}, seed=0)
    with h5py.File(tmp_path / "arrays.h5", "w") as arrays:
        here = SimpleNamespace(path=tmp_path, config={"sub_goals": ["down"]})
        monkeypatch.setattr(hypotheses, "read_ensemble", lambda *_: ensemble)
        work = Work(Contents(tmp_path, [], [], [], []), arrays, None)
        work.browsed = tmp_path
        monkeypatch.setattr(Work, "place_of", lambda work, judgement: {"artefact": "ensemble"})
        rows = joined(look(work, Judgement(here, tmp_path / "data.h5", "down", judged)))
        group = arrays["saliency/down"]
        assert group["observations"].shape == (3, 1, 3, 1)
        assert group["seen"].shape == (3, 1, 2, 1)
        np.testing.assert_allclose(group["attributions"][:, 0, 0, :, 0], [[0, 2], [1, 0], [0, 0]])
    assert work.facts["looked_at"]["sub_goals"]["down"]["kinds"] == ["true positive", "false positive"]
    errors = rows[rows["quantity"] == "completeness_error"]
    assert (
        errors["scope"].tolist() == ["state: true positive", "state: false positive"] and errors["value"].max() < 1e-9
    )


def test_the_states_that_are_explained():
    """Figures 2 and 9: a true positive that most see, one that members disagree about, a false positive; none twice."""
    probabilities = np.array([[0.9, 0.1], [0.8, 0.9], [0.7, 0.2], [0.6, 0.8], [0.1, 0.1]], np.float32)
    labels = np.array([True, True, False, False, False])
    verdicts = probabilities > 0.5
    everywhere = np.ones_like(labels)
    picked = pick_to_explain(probabilities, verdicts, labels, everywhere)
    assert picked == {"true positive": 1, "disagree": 0, "false positive": 3}
    assert pick_to_explain(probabilities, np.zeros_like(verdicts), labels, everywhere) == {}
    alone = pick_to_explain(probabilities[:, :1], verdicts[:, :1], labels, everywhere)
    assert alone == {"true positive": 0, "false positive": 2}
    assert pick_to_explain(probabilities, verdicts, labels, labels) == {"true positive": 1, "disagree": 0}


def test_overlay_keeps_what_is_shared():
    """Figures 7 and 8: what all states share stays; one agent is whole, the others are half transparent."""
    states = np.zeros((4, 1, 6, 3), np.uint8)
    states[:, 0, 0] = 200
    for index, cell in enumerate((2, 3, 4, 5)):
        states[index, 0, cell] = (100, 0, 0)
    states[1, 0, 1] = (100, 0, 0)
    assert overlay(states)[0, :, 0].tolist() == [200, 50, 100, 50, 50, 50]
    assert overlay(states[:1])[0, :, 0].tolist() == [200, 0, 100, 0, 0, 0]


def test_the_policy_of_a_page_lets_its_own_script_and_style_in_alone() -> None:
    """Spec F7: by their digests; nothing else is loaded, and pictures are in the page."""
    text = page.render("lines.html", title="x", about="", lines=[], sections=[])
    (policy,) = re.findall(r'<meta http-equiv="Content-Security-Policy" content="([^"]+)">', text)
    (script,), (style,) = (re.findall(rf"<{tag}>(.*?)</{tag}>", text, re.DOTALL) for tag in ("script", "style"))
    own = f"default-src 'none'; script-src {page.digest(script)}; style-src {page.digest(style)}; img-src data:;"
    assert unescape(policy) == f"{own} base-uri 'none'; form-action 'none'"
