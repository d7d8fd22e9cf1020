"""The verdict on made-up shares of solved episodes, where the right sentence is known (Spec F7)."""

import math
import statistics
from typing import Any

import pytest
from made_up import LEARNED, results_of, row

from hypogoal.evaluation.choosing import FROZEN
from hypogoal.evaluation.names import ONE, RANDOM, UNIFORM
from hypogoal.evaluation.questions import sentences
from hypogoal.evaluation.run import Results
from hypogoal.evaluation.verdict import ALIKE, BETTER, CHOOSING, HYPOTHESES, UNDECIDED, WORSE, findings, outcome_of

SEVERAL = "D-BAT, 3 members"
AGENTS = {SEVERAL: LEARNED, ONE: LEARNED | {"members": 1}, RANDOM: LEARNED | {"choice": "random"}}


def run_of(
    shares: dict[str, list[float]], played: dict[str, list[float]] | None = None, *, layouts: bool = True, **facts: Any
) -> Results:
    """A run: by agent the shares solved at the end of training, and those ``played`` frozen, by layout or by seed."""
    rows = []
    for scope, table in (("", shares), (FROZEN, played or {})):
        for method, values in table.items():
            owner = SEVERAL if method == UNIFORM else method
            for number, value in enumerate(values):
                place = {"layout": number if layouts else 0, "seed": number, "artefact": f"{owner}-{number}"}
                rows.append(row("success", value, method=method, scope=scope, **place))
    named = {name: made for name, made in AGENTS.items() if name in shares or name in (played or {})}
    return results_of(*rows, agents=named, **facts)


@pytest.mark.parametrize(
    ("shares", "outcome"),
    [
        ([(0.96, 0.23)], BETTER),
        ([(0.2, 0.9)], WORSE),
        ([(1.0, 0.98)], ALIKE),
        ([(1.0, 0.5), (0.9, 0.4), (1.0, 0.45)], BETTER),
        ([(0.5, 1.0), (0.4, 0.9), (0.45, 1.0)], WORSE),
        ([(1.0, 1.0), (0.99, 1.0), (1.0, 0.99)], ALIKE),
        ([(1.0, 0.2), (0.2, 1.0), (0.6, 0.5)], UNDECIDED),
        ([(1.0, 0.2)] * 5 + [(0.2, 0.3)], UNDECIDED),
        ([(1.0, 0.2)] * 9 + [(0.2, 0.3)], BETTER),
        ([(1.0, 1.0)] * 10, ALIKE),
        ([(1.0, 0.0)] * 10, BETTER),
    ],
)
def test_each_kind_of_outcome(shares: list[tuple[float, float]], outcome: str) -> None:
    """An agent against uniform-random choice among its own options, frozen, even where training says the contrary."""
    first, second = map(list, zip(*shares, strict=True))
    played = {SEVERAL: first, UNIFORM: second}
    (found,) = findings(run_of({SEVERAL: [0.0] * len(first), RANDOM: [1.0] * len(first)}, played))
    assert (found["subject"], found["second"], found["outcome"]) == (CHOOSING, UNIFORM, outcome)
    assert found["units"] == len(shares)
    assert found["difference"] == pytest.approx(statistics.median(a - b for a, b in shares))
    assert math.isnan(found["difference_low"]) == (len(shares) < 6)


def test_a_small_certain_difference_is_none() -> None:
    """An interval within the margin is no difference, also where 0 lies outside of it."""
    assert outcome_of(0.02, 0.08) == ALIKE
    assert outcome_of(0.02, 0.16) == BETTER


def test_seeds_are_the_units_of_a_single_layout() -> None:
    """And the sentence says what the units are, with the interval, or the range of too few."""
    played = {SEVERAL: [1.0, 0.9, 1.0], UNIFORM: [0.5, 0.4, 0.45]}
    sentence, warning = sentences(run_of({SEVERAL: [0.0]}, played, layouts=False))
    assert sentence == (
        "Choosing mattered on these 3 seeds: the agent solves 97 % of the episodes, but uniform-random choice among "
        "its own options solves 45 %. The median difference is +50 percentage points, and single "
        "differences go from 50 to 55. So choosing at random is not enough."
    )
    assert warning == "Fewer than six layouts or seeds are not evidence, so repeat the run with more."
    several = {SEVERAL: [1.0] * 6, UNIFORM: [0.5, 0.4, 0.45] * 2}
    (sentence,) = sentences(run_of({SEVERAL: [0.0]}, several, layouts=False))
    assert sentence.startswith("Choosing mattered on 6 seeds:") and sentence.endswith(
        "The median difference is +55 percentage points, with a 95 % interval from 50 to 60. So choosing at random is "
        "not enough."
    )
    one = sentences(run_of({SEVERAL: [0.0]}, {SEVERAL: [1.0], UNIFORM: [0.5]}))
    assert one[0].startswith("Choosing mattered on this layout:") and "points" not in one[0]
    assert one[1] == "One run is not evidence, so repeat it on more layouts or with more seeds."


def test_the_verdict_says_after_how_many_episodes() -> None:
    """The median of the runs that got there, and how many did if not all."""
    rows = []
    for number, episodes in enumerate((30, 40, 80, None)):
        place = {"layout": number, "seed": 0, "artefact": f"own-{number}"}
        rows.append(row("success", 1.0, method=SEVERAL, **place))
        rows += [row("success", 1.0, method=SEVERAL, scope=FROZEN, **place)]
        rows += [row("success", 0.2, method=UNIFORM, scope=FROZEN, **place)]
        rows += [] if episodes is None else [row("episodes_to_95", episodes, method=SEVERAL, **place)]
    _, told, *_ = sentences(results_of(*rows, agents={SEVERAL: LEARNED}))
    assert told.startswith("The reward told the agent what to do within 40 episodes, the median of its runs,")
    assert told.endswith("It came so far in 75 % of its runs."), "four layouts are too few to expect it of others"


def test_the_verdict_says_that_the_reward_has_not_told() -> None:
    """In how many episodes of training it has not."""
    place = {"method": SEVERAL, "layout": 0, "seed": 0, "artefact": "own"}
    rows = [row("success", 0.4, **place), row("episodes", 812, **place), row("success", 0.4, **place, scope=FROZEN)]
    rows += [row("success", 0.2, **{**place, "method": UNIFORM}, scope=FROZEN)]
    _, told, *_ = sentences(results_of(*rows, agents={SEVERAL: LEARNED}))
    assert told.startswith("The reward has not told the agent what to do: in 812 episodes of training it never")


@pytest.mark.parametrize(
    ("better", "said"),
    [
        (0.55, "not between hypotheses, and its preference does not tell which member is better."),
        (0.9, "the member that it prefers is likely the better one."),
    ],
)
def test_choosing_sub_goals_is_told_from_choosing_among_members(better: float, said: str) -> None:
    """By how often the better of two members is taken, against uniform-random choice among the same options."""
    rows = [row("success", 1.0, method=SEVERAL, layout=7, seed=0, artefact="own")]
    for method, solved, share in ((SEVERAL, 1.0, better), (UNIFORM, 0.27, 0.48)):
        place = {"method": method, "scope": FROZEN, "layout": 7, "seed": 0, "artefact": "own"}
        rows += [row("success", solved, **place), row("pair", share, **place)]
    first, second, *_ = sentences(results_of(*rows, agents={SEVERAL: LEARNED}))
    shares = f"takes the better one in {better:.0%} of the cases, and uniform-random choice takes it in 48%".replace(
        "%", " %"
    )
    assert first.startswith("Choosing mattered on this layout: the agent solves 100 %") and second.endswith(said)
    assert shares in second


def test_without_frozen_play_an_agent_is_compared_with_one_that_chose_at_random() -> None:
    """At the end of training, run by run; frozen play of the agent alone does not replace that."""
    (found,) = findings(run_of({SEVERAL: [0.2, 0.1, 0.3], RANDOM: [1.0, 0.9, 1.0]}, {SEVERAL: [1.0, 1.0, 1.0]}))
    assert (found["second"], found["outcome"]) == (RANDOM, WORSE)
    assert (found["mean_first"], found["mean_second"]) == pytest.approx((0.2, 2.9 / 3))


def test_several_members_are_compared_with_one_classifier() -> None:
    """Both frozen where both have played so, else both in training; one classifier alone has no finding."""
    trained = {SEVERAL: [0.5, 0.5, 0.5], ONE: [0.5, 0.5, 0.5]}
    both = findings(run_of(trained, {SEVERAL: [1.0, 0.9, 1.0], ONE: [0.3, 0.2, 0.3]}))
    assert [(each["subject"], each["outcome"], each["second"]) for each in both] == [(HYPOTHESES, BETTER, ONE)]
    one = findings(run_of(trained, {SEVERAL: [1.0, 0.9, 1.0]}))
    assert [(each["subject"], each["outcome"]) for each in one] == [(HYPOTHESES, ALIKE)]
    assert findings(run_of({ONE: [0.5]})) == findings(run_of({RANDOM: [0.5]})) == []


def test_agents_of_different_tasks_are_not_compared() -> None:
    """Two worlds that reward different features: one classifier in the one says nothing of members in the other."""
    shares = {SEVERAL: [0.9, 0.8], ONE: [0.3, 0.2]}
    for task, found in (("enter the red room", 1), ("enter the round room", 0)):
        run = run_of(shares, task_of={SEVERAL: "enter the red room", ONE: task})
        assert len(findings(run)) == found


def test_an_own_chooser_has_its_finding() -> None:
    """Spec E6: beside the built-in one's, by its name."""
    own = "option agent, chooser=first:First"
    rows = []
    for method, value in ((own, 1.0), (UNIFORM, 0.1)):
        rows.append(row("success", value, method=method, scope=FROZEN, layout=1, seed=0, artefact="own"))
    results = results_of(*rows, agents={own: LEARNED})
    (found,) = findings(results)
    assert (found["first"], found["outcome"]) == (own, BETTER)


def test_only_runs_of_the_same_layout_and_seed_are_compared() -> None:
    """Nine seeds of one layout and one of another count once each."""
    rows = [row("success", 0.9, method=SEVERAL, layout=0, seed=seed, artefact=f"s-{seed}") for seed in range(9)]
    rows += [row("success", 0.0, method=ONE, layout=0, seed=seed, artefact=f"o-{seed}") for seed in range(9)]
    rows += [row("success", 0.1, method=SEVERAL, layout=1, seed=0, artefact="s")]
    rows += [row("success", 1.0, method=ONE, layout=1, seed=0, artefact="o")]
    rows += [row("success", 1.0, method=ONE, layout=2, seed=0, artefact="p")]
    (found,) = findings(results_of(*rows, agents=AGENTS))
    assert (found["units"], found["difference"]) == (2, pytest.approx(0.0))


def ladder(method: str, seed: int, *shares: float, validated: int | None = 0) -> list[dict]:
    """Rows of options on a ladder."""
    place = {"method": method, "N": 1, "ladder": "1L", "seed": seed, "artefact": f"{method}-{seed}", "sub_goal": "down"}
    rows = [row("reached_base", share, member=member, **place) for member, share in enumerate(shares)]
    return rows + ([] if validated is None else [row("validated_member", validated, **place)])


def test_options_on_ladders_are_compared_by_the_member_that_validation_picks() -> None:
    """The first where nothing could be validated."""
    rows = [each for seed in range(3) for each in ladder("D-BAT, 2 members", seed, 0.0, 0.9, validated=1)]
    rows += [each for seed in range(3) for each in ladder(ONE, seed, 0.1, validated=None)]
    sentence, _ = sentences(results_of(*rows))
    assert sentence.startswith(
        'Having several hypotheses mattered on these 3 seeds: options of the ensemble "D-BAT, 2 '
    )
    assert "in 90 % of their executions, and options of one classifier in 10 %" in sentence
    (alone,) = sentences(results_of(*ladder("D-BAT, 2 members", 0, 0.25)))
    assert "unknown, because the run has no options of one classifier" in alone


def test_without_controls_nothing_is_claimed() -> None:
    lines = sentences(run_of({SEVERAL: [0.5]}))
    assert lines[0] == "D-BAT, 3 members solved 50 % of the last training episodes." and "unknown" in lines[1]
    assert sentences(results_of(agents=AGENTS)) == ["No episode of an agent has ended yet, so train with more steps."]


def test_an_ensemble_alone_has_shown_nothing_yet() -> None:
    (line,) = sentences(results_of())
    assert line.startswith("No agent has been trained yet")
