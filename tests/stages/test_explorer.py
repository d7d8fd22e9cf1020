"""Spec F2, F6, F7: the states to browse, what the page says of them, and the page's filters in a real browser."""

import json
import re

import h5py
import numpy as np
import pytest
from browser import document_of, needs_browser, title_of

from hypogoal.data import open_dataset
from hypogoal.domains.doorkey.domain import DOMAIN
from hypogoal.evaluation.explorer import MOST_EXPLAINED, MOST_STATES

MEMBERS = 2
GOAL = "collect-red-key"


@pytest.fixture(scope="module")
def metrics(tiny_run):
    return json.loads((tiny_run / "evaluation" / "metrics.json").read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def page(tiny_run):
    return tiny_run / "report" / "index.html"


@pytest.fixture(scope="module")
def data(page):
    """What the page holds."""
    found = re.search(r'id="explorer-data">(.*?)</script>', page.read_text(encoding="utf-8"), re.S)
    return {goal["name"]: goal for goal in json.loads(found[1])["goals"]}


def test_the_states_are_those_of_the_ensemble_that_was_used(tiny_run, metrics, data):
    """Spec F2: of two ensembles alike the one that agents were learned with; verdicts and truth as in the data."""
    assert (metrics["explorer"]["ensemble"], metrics["explorer"]["seed"]) == ("ensemble", 0)
    split = open_dataset(tiny_run / "data.h5").heldout(GOAL)
    about = next(goal for goal in metrics["explorer"]["sub_goals"] if goal["sub_goal"] == GOAL)
    assert about == {
        "sub_goal": GOAL,
        "states": len(split.labels),
        "shown": 30,
        "explained": 5,
        "reading": DOMAIN.reading,
    }
    with h5py.File(tiny_run / "evaluation" / "arrays.h5") as arrays:
        group = arrays[f"explorer/{GOAL}"]
        rows = group["rows"][()]
        assert len(set(rows.tolist())) == 30
        np.testing.assert_array_equal(group["observations"][()], split.observations[rows])
        np.testing.assert_array_equal(group["labels"][()], split.labels[rows])
        order = np.argsort(rows)
        verdicts, seeds = group["verdicts"][()][order], split.origins["layout_seed"][rows[order]]
        assert group["attributions"].shape == (5, MEMBERS, 64, 64)
        assert np.abs(group["attributions"][()].astype(int)).max() == 127
    assert [state["says"] for state in data[GOAL]["states"]] == verdicts.tolist()
    assert [state["place"] for state in data[GOAL]["states"]] == [f"layout {seed}" for seed in seeds]
    assert sum(len(state["saliency"]) == MEMBERS for state in data[GOAL]["states"]) == 5
    assert {state["truth"] for state in data[GOAL]["states"]} == {True, False}


def test_members_say_what_they_led_to(metrics, data):
    """Spec F6: how often the agent chose each member, in all and part by part of training."""
    (run_row,) = metrics["selection"][0]["runs"]
    assert run_row["ensemble"] == "ensemble"
    for goal in run_row["sub_goals"]:
        for member in goal["members"]:
            (option,) = data[goal["sub_goal"]]["members"][member["member"]]["options"]
            assert option["name"] == "layout 100, run seed 0"
            assert ["chosen", f"{member['chosen']:,} of {member['offered']:,} offers"] in option["facts"]


def test_the_page_stays_small(page):
    """Spec F7: under 10 MB even if every state took what the dearest takes here, at the numbers that are allowed."""
    found = re.search(r'id="explorer-data">(.*?)</script>', page.read_text(encoding="utf-8"), re.S)
    states = [state for goal in json.loads(found[1])["goals"] for state in goal["states"]]
    picture = max(len(state["png"]) for state in states)
    attributions = max(len(png) for state in states for png in state["saliency"])
    assert MOST_STATES * picture + MOST_EXPLAINED * 6 * attributions < 9_000_000


def expected(data, **wanted):
    """How many states of ``GOAL`` pass."""
    states = data[GOAL]["states"]
    if "truth" in wanted:
        states = [one for one in states if one["truth"] == (wanted["truth"] == "positive")]
    if "members" in wanted:
        states = [one for one in states if (len(set(one["says"])) > 1) == (wanted["members"] == "disagree")]
    if "errors" in wanted:
        wrong = {id(one): [said != one["truth"] for said in one["says"]] for one in states}
        kinds = {"none": lambda w: not any(w), "some": any, "all": all, "1": lambda w: w[1]}
        states = [one for one in states if kinds[wanted["errors"]](wrong[id(one)])]
    if "place" in wanted:
        states = [one for one in states if one["place"] == wanted["place"]]
    return len(states)


FILTERS = [
    {},
    {"truth": "positive"},
    {"members": "disagree"},
    {"members": "agree", "truth": "negative"},
    {"errors": "none"},
    {"errors": "all"},
    {"errors": "1", "truth": "positive"},
    {"place": "layout 1001", "errors": "some"},
]

# Sets each control as a user does, and reports what is shown after each step.
USE = """
const $ = (id) => document.getElementById(id);
const tiles = () => document.querySelectorAll("#explorer-tiles button");
const choose = (id, value) => { $(id).value = value; $(id).dispatchEvent(new Event("change")); };
const told = [];
const at_first = $("explorer-members").value;
for (const filters of FILTERS) {
  $("explorer-reset").click();
  choose("explorer-goal", GOAL);
  for (const [name, value] of Object.entries(filters)) choose("explorer-" + name, value);
  told.push([$("explorer-count").textContent, tiles().length]);
}
$("explorer-reset").click();
tiles()[0].click();
tiles()[0].dispatchEvent(new KeyboardEvent("keydown", { key: "ArrowRight", bubbles: true }));
const second = document.activeElement.getAttribute("data-state");
document.querySelectorAll("#explorer-detail button")[1].click();
tiles()[0].click();
const height = (tile) => tile.getBoundingClientRect().top;
const columns = [...tiles()].filter((tile) => height(tile) === height(tiles()[0])).length;
tiles()[0].dispatchEvent(new KeyboardEvent("keydown", { key: "ArrowDown", bubbles: true }));
const below = Number(document.activeElement.getAttribute("data-state")) === columns && columns > 1;
tiles()[0].click();
tiles()[0].dispatchEvent(new KeyboardEvent("keydown", { key: "ArrowRight", bubbles: true }));
document.querySelectorAll("#explorer-detail button")[1].click();
document.title = JSON.stringify({
  told, at_first, below, second, hash: location.hash,
  pressed: [...document.querySelectorAll("#explorer-tiles [aria-pressed=true]")].map((b) => b.dataset.state),
  heading: $("explorer-member").querySelector("h3").textContent,
  focused: document.activeElement.textContent,
  unnamed: [...document.querySelectorAll("#explorer button, #explorer select")].filter(
    (node) => !(node.labels?.[0]?.textContent || node.getAttribute("aria-label") || node.textContent)).length,
  wide: document.documentElement.scrollWidth - document.documentElement.clientWidth,
});
"""


@pytest.mark.browser
@needs_browser
def test_the_filters_in_a_browser(page, data, tmp_path):
    """Spec F7: each filter shows just the states it should; states and members can be chosen by click and by key."""
    script = USE.replace("FILTERS", json.dumps(FILTERS)).replace("GOAL", json.dumps(GOAL))
    found = json.loads(title_of(document_of(page, "", tmp_path, script)))
    counts = [expected(data, **filters) for filters in FILTERS]
    assert found["told"] == [[f"{count} of 30 states", count] for count in counts]
    assert len(set(counts)) > 3
    apart = any(expected({GOAL: goal}, members="disagree") for goal in data.values())
    assert found["at_first"] == ("disagree" if apart else "") and found["below"]
    assert found["second"] == "1" and found["pressed"] == ["1"]
    assert found["hash"] == f"#explorer?goal={GOAL}&state=1&member=1"
    assert found["heading"] == found["focused"] == f"Member 1 of {GOAL}"
    assert found["unnamed"] == 0
    assert found["wide"] <= 0


@pytest.mark.browser
@needs_browser
def test_the_address_holds_the_filters(page, data, tmp_path):
    """Spec F7: an address that was shared shows what its sender saw."""
    count = expected(data, errors="some", truth="negative")
    document = document_of(page, f"explorer?goal={GOAL}&errors=some&truth=negative&member=1", tmp_path)
    assert f">{count} of 30 states<" in document
    assert document.count('class="tile"') == count
    assert f"Member 1 of {GOAL}" in document
    assert 'role="status" aria-live="polite"' in document


@pytest.mark.browser
@needs_browser
def test_the_page_begins_with_states_on_which_members_disagree(page, tmp_path):
    """Spec F7: of the first sub-goal that has any; 'clear' shows all."""
    text = page.read_text(encoding="utf-8")
    found = re.search(r'(?<=id="explorer-data">).*?(?=</script>)', text, re.S)
    goals = json.loads(found[0])
    for goal in goals["goals"]:
        for index, state in enumerate(goal["states"]):
            state["says"] = [True, goal["name"] != GOAL or index >= 3]
    copy = tmp_path / "apart.html"
    copy.write_text(text.replace(found[0], json.dumps(goals).replace("<", "\\u003c")), encoding="utf-8")
    script = """
    const told = () => document.getElementById("explorer-count").textContent;
    const first = [document.getElementById("explorer-goal").value, told()];
    document.getElementById("explorer-reset").click();
    document.title = JSON.stringify([...first, told()]);
    """
    assert json.loads(title_of(document_of(copy, "", tmp_path, script))) == [GOAL, "3 of 30 states", "30 of 30 states"]
