"""What the page opens with: where members part, what each is, and which one the agent went by."""

from typing import Any

import numpy as np
import pandas as pd
import pytest
from made_up import asked, results_of, row

from hypogoal.evaluation import page, parting
from hypogoal.evaluation.parting import agent_of, members_of, parted, went_by
from hypogoal.evaluation.run import Results

GOAL = "enter-room"
MADE = [  # path, kind, what it was made from
    ("ensemble", []),
    ("other", []),
    ("a", [{"relative": "../other"}]),
    ("runs/b", [{"relative": "../../ensemble"}]),
    ("runs/c", [{"relative": "../../ensemble"}]),
]
LEARNED = {"members": 2, "choice": "learned"}


def run_of(chosen: list[int], **facts: Any) -> Results:
    """Two members of which one tells the place and one the shape, and an agent that took their options so often."""
    rows = []
    for member, accuracies in enumerate([(0.6, 1.0, 0.5), (0.9, 0.5, 0.95)]):
        own = {"method": "D-BAT", "artefact": "ensemble", "sub_goal": GOAL, "member": member}
        for scope, accuracy in zip(("heldout", "planted_place", "planted_shape"), accuracies, strict=True):
            rows.append(row("balanced_accuracy", accuracy, scope=scope, **own))
        played = own | {"method": "agent", "artefact": "runs/b"}
        rows.append(row("chosen", chosen[member], scope="layout", **played))
    rows.append(row("success", 1.0, method="agent", artefact="a"))
    artefacts = [{"path": path, "inputs": inputs, "config": {}} for path, inputs in MADE]
    states = {"kinds": ["disagree"], "places": ["layout 7"] * 4, "colours": 3, "how": "DeepLift"}
    looked_at = {"ensemble": {"artefact": "ensemble", "seed": 0}, "sub_goals": {GOAL: states}}
    made = {"provenance": {"artefacts": artefacts}, "agents": {"agent": LEARNED}, "looked_at": looked_at}
    results = results_of(*rows, **made | facts)
    says = np.array([[1, 0], [1, 1], [1, 0], [0, 1]], dtype=np.bool_)
    arrays = {"observations": np.zeros((4, 2, 2, 3), np.uint8), "labels": says[:, 1], "predictions": says}
    arrays["probabilities"] = np.where(says, 0.8, 0.3)
    return Results(results.numbers, results.facts, {f"saliency/{GOAL}/{name}": part for name, part in arrays.items()})


def test_the_agent_is_one_that_learned_with_these_members() -> None:
    """The first by its inputs, wherever it lies; none where it did not learn to choose."""
    assert agent_of(run_of([9, 1]), "ensemble") == "runs/b"
    assert agent_of(run_of([9, 1]), "other") == "a"
    assert agent_of(run_of([9, 1], agents={}), "ensemble") == ""


def test_a_member_is_told_by_the_planted_feature_that_it_tells_best() -> None:
    members = members_of(run_of([9, 1]).of(sub_goal=GOAL))
    assert members["feature"].tolist() == ["place", "shape"] and members["tells"].tolist() == [1.0, 0.95]
    assert members["accuracy"].tolist() == [0.6, 0.9] and members["chosen"].tolist() == [9, 1]
    assert members["quality"].isna().all(), "the agent was not played after training"


@pytest.mark.parametrize(
    ("chosen", "rare", "led"), [([90, 10], False, True), ([55, 45], False, False), ([30, 9], True, None)]
)
def test_the_member_that_the_agent_went_by(chosen: list[int], rare: bool, led: bool | None) -> None:
    """Its share is above an even one by a tenth, of forty choices at least."""
    told = went_by(pd.Series(chosen))
    assert (told["times"], told["rare"], told.get("led")) == (sum(chosen), rare, led)
    assert rare or (told["most"], told["share"]) == (0, chosen[0] / 100)


def test_each_way_to_disagree_comes_before_any_comes_again() -> None:
    context = asked(parting, run_of([90, 10]))
    assert context is not None
    [goal] = context["sub_goals"]
    assert [state["predictions"].tolist() for state in goal["parted"]] == [[True, False], [False, True], [True, False]]
    assert len(context["states"]) == 4 and parted([]) == []


@pytest.mark.parametrize(
    ("chosen", "said"),
    [
        (
            [90, 10],
            "<b>The agent in runs/b preferred member 0.</b> In training it ran an option for this sub-goal 100 times",
        ),
        ([55, 45], "<b>The agent in runs/b preferred no single member.</b>"),
        ([3, 1], "ran an option for this sub-goal 4 times in training, which is too seldom"),
    ],
)
def test_the_page_says_which_member_the_agent_went_by(chosen: list[int], said: str) -> None:
    context = asked(parting, run_of(chosen))
    assert context is not None
    text = page.render("parting.html", **context)
    assert said in text
    assert text.count('class="card"') == 3 and text.count("<li data-goal") == 4
    assert 'member 0: <span class="wrong">yes (0.80)</span>' in text
