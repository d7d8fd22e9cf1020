"""The verdict on made-up shares of solved episodes, where the right sentence is known (Spec F7)."""

import math
from dataclasses import asdict
from typing import Any

import numpy as np
import pytest
from works import work_of

from hypogoal.evaluation.choosing import FROZEN, UNIFORM
from hypogoal.evaluation.curves import Run
from hypogoal.evaluation.judging import Work
from hypogoal.evaluation.numbers import ONE, ensemble_title, plain
from hypogoal.evaluation.table import Row
from hypogoal.evaluation.verdict import (
    ALIKE,
    BETTER,
    CHOOSING,
    HYPOTHESES,
    UNDECIDED,
    WORSE,
    baselines,
    compare,
    findings,
    outcome_of,
    sentence,
    verdict,
)
from hypogoal.options.tables import Episodes


def pairs_of(*shares: tuple[float, float], layouts: bool = True) -> list[tuple[Row, Row]]:
    """Shares of solved episodes, a pair a layout, or a pair a seed of one layout."""
    places: list[dict[str, Any]] = [
        {"layout": number if layouts else 0, "seed": number} for number in range(len(shares))
    ]
    return [tuple(Row("success", value, **place) for value in pair) for pair, place in zip(shares, places, strict=True)]


def said(subject: str, *shares: tuple[float, float], **more: Any) -> str:
    """The sentence of these pairs, as a page has it."""
    second = "uniform-random choice among its own options" if subject == CHOOSING else ONE
    finding = compare(subject, "D-BAT, 3 members", second, pairs_of(*shares, **more))
    assert finding is not None
    return sentence(plain(asdict(finding)))


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
        ([(1.0, 1.0)] * 10, ALIKE),
        ([(1.0, 0.0)] * 10, BETTER),
    ],
)
def test_each_kind_of_outcome(shares: list[tuple[float, float]], outcome: str) -> None:
    finding = compare(CHOOSING, "", "", pairs_of(*shares))
    assert finding is not None and finding.outcome == outcome
    assert finding.units == len(shares)
    assert finding.difference == pytest.approx(sum(first - second for first, second in shares) / len(shares))


def test_a_small_certain_difference_is_none() -> None:
    """An interval within the margin is no difference, also where 0 lies outside of it."""
    assert outcome_of(0.05, 0.02, 0.08) == ALIKE
    assert outcome_of(0.09, 0.02, 0.16) == BETTER


def test_seeds_are_the_units_of_a_single_layout() -> None:
    """And the sentence says what the units are."""
    assert "over 3 seeds" in said(CHOOSING, (1.0, 0.5), (0.9, 0.4), (1.0, 0.45), layouts=False)
    assert "on this layout" in said(CHOOSING, (1.0, 0.5), layouts=False)
    assert said(HYPOTHESES, (1.0, 0.2), (0.2, 1.0)).startswith("Whether several hypotheses mattered is undecided over")


def test_several_runs_of_a_layout_count_once() -> None:
    pairs = pairs_of((1.0, 0.0), (0.0, 1.0))
    again = [tuple(row._replace(layout=0) for row in pairs[0]) for _ in range(9)]
    finding = compare(CHOOSING, "", "", [*again, pairs[1]])
    assert finding is not None and (finding.units, finding.difference) == (2, 0.0)


def test_intervals_stay_within_what_a_difference_can_be() -> None:
    finding = compare(CHOOSING, "", "", pairs_of((1.0, 0.0), (0.5, 0.5)))
    assert finding is not None and finding.interval == (-1.0, 1.0)


def test_no_pairs_no_finding() -> None:
    assert compare(CHOOSING, "", "", []) is None


def metrics_of(*findings: Any, **parts: Any) -> dict[str, Any]:
    empty: dict[str, Any] = {"agents": [], "hypotheses": [], "distance": {"options": []}}
    return {**empty, **parts, "verdict": {"findings": [plain(asdict(finding)) for finding in findings]}}


def test_one_run_is_called_no_evidence() -> None:
    one, three = (compare(CHOOSING, "", "", pairs_of(*[(1.0, 0.2)] * count)) for count in (1, 3))
    two = compare(CHOOSING, "", "", pairs_of((1.0, 0.2), (1.0, 0.2)))
    assert verdict(metrics_of(two))[-1].startswith("Two runs are not evidence")
    assert verdict(metrics_of(one))[-1] == "One run is not evidence: train more layouts or seeds."
    assert len(verdict(metrics_of(three))) == 1


def test_without_controls_nothing_is_claimed() -> None:
    agent = {"name": "options (learned members)", "kind": "meta", "success": {"mean": 0.5}}
    lines = verdict(metrics_of(agents=[agent]))
    assert "50 %" in lines[0] and "unknown" in lines[1]


def test_an_ensemble_alone_has_shown_nothing_yet() -> None:
    scores = {name: {"mean": value} for name, value in (("best", 0.94), ("mean", 0.76), ("worst", 0.59))}
    lines = verdict(metrics_of(hypotheses=[{"name": "dbat, K=3", "sub_goal": "door", **scores}]))
    assert lines[0].startswith("No agent has been trained yet")
    assert ".94 for the best member" in lines[1] and ".59 for the worst" in lines[1]


def test_options_without_a_comparison() -> None:
    options = [{"method": "dbat, K=3", "validated": 1, "options": [{"reached_base": 0.0}, {"reached_base": 0.25}]}]
    lines = verdict(metrics_of(distance={"options": options}))
    assert lines[0] == "Options of D-BAT, 3 members stop at the sub-goal in 25 % of their executions."
    assert "unknown" in lines[1]


def test_baselines_stand_beside_what_they_were_given() -> None:
    agent = {"name": "PPO tuned", "kind": "baseline", "success": {"mean": 0.0}, "runs": [{"steps": 250_000}]}
    assert baselines(metrics_of(agents=[agent])).endswith("PPO tuned 0 % (after 250,000 steps).")
    assert baselines(metrics_of()) == ""


@pytest.mark.parametrize(
    ("name", "title"),
    [
        ("dbat, K=3", "D-BAT, 3 members"),
        ("no diversity, K=3", "no diversity, 3 members"),
        ("single CNN", ONE),
        ("oracle termination", "oracle termination"),
    ],
)
def test_names_of_ensembles_for_people(name: str, title: str) -> None:
    assert ensemble_title(name) == title


def test_nan_bounds_are_those_of_one_unit() -> None:
    assert outcome_of(0.5, math.nan, math.nan) == BETTER


def agent(chooser: str, members: int) -> Run:
    """A trained agent of D-BAT's members, whose episodes do not matter here."""
    ensemble = f"dbat, K={members}"
    config = {"chooser": chooser, "members": members, "termination": "learned", "ensemble": ensemble}
    none = np.zeros(0, np.bool_)
    return Run("meta", chooser, 7, config, Episodes(none, none, none, none, none), {})


def run_of(shares: dict[str, list[float]], played: dict[str, list[float]] | None = None, **agents: Run) -> Work:
    """The work on a run: by agent the shares solved at the end of training, and those ``played`` frozen, by layout."""
    work = work_of()
    work.agents = {name: [one] for name, one in agents.items()}
    for scope, table in (("", shares), (FROZEN, played or {})):
        for method, values in table.items():
            owner = "several" if method == UNIFORM else method
            work.rows += [
                Row("success", value, method, layout=layout, seed=7, artefact=f"{owner}-{layout}", scope=scope)
                for layout, value in enumerate(values)
            ]
    return work


SEVERAL, SINGLE, RANDOMLY = agent("ppo", 3), agent("ppo", 1), agent("random", 3)


def test_an_agent_is_compared_with_uniform_choice_among_its_own_options() -> None:
    """Frozen play, even where an agent that chose at random is there too, and training says the contrary."""
    work = run_of(
        {"several": [0.0, 0.0, 0.0], "randomly": [1.0, 1.0, 1.0]},
        {"several": [1.0, 0.9, 1.0], UNIFORM: [0.2, 0.1, 0.3]},
        several=SEVERAL,
        randomly=RANDOMLY,
    )
    (finding,) = findings(work)
    assert finding.second == "uniform-random choice among its own options"
    assert (finding.subject, finding.outcome, finding.units) == (CHOOSING, BETTER, 3)
    assert (finding.success, finding.other) == pytest.approx((2.9 / 3, 0.2))


def test_without_frozen_play_an_agent_is_compared_with_one_that_chose_at_random() -> None:
    """At the end of training, run by run; that one has learned options of its own, and the finding says so."""
    work = run_of({"several": [0.2, 0.1, 0.3], "randomly": [1.0, 0.9, 1.0]}, several=SEVERAL, randomly=RANDOMLY)
    (finding,) = findings(work)
    assert finding.second == "an agent whose choice is uniform-random"
    assert (finding.outcome, finding.success, finding.other) == (WORSE, pytest.approx(0.2), pytest.approx(2.9 / 3))


def test_frozen_play_of_the_agent_alone_does_not_replace_the_fallback() -> None:
    """Without uniform-random choice among the same options there is nothing frozen to compare with."""
    work = run_of(
        {"several": [0.9, 0.9, 0.9], "randomly": [0.9, 0.9, 0.9]},
        {"several": [1.0, 1.0, 1.0]},
        several=SEVERAL,
        randomly=RANDOMLY,
    )
    (finding,) = findings(work)
    assert (finding.outcome, finding.success) == (ALIKE, pytest.approx(0.9))


def test_only_runs_of_the_same_layout_and_seed_are_compared() -> None:
    work = run_of({"several": [0.9, 0.2]}, several=SEVERAL, randomly=RANDOMLY)
    work.rows += [Row("success", 0.4, "randomly", layout=1, seed=7), Row("success", 0.9, "randomly", layout=0, seed=8)]
    (finding,) = findings(work)
    assert (finding.units, finding.success, finding.other) == (1, 0.2, 0.4)


def test_several_members_are_compared_with_one_classifier() -> None:
    """Both frozen where both have played so, else both in training; one classifier alone has no finding."""
    trained = {"several": [0.5, 0.5, 0.5], "single": [0.5, 0.5, 0.5]}
    both = run_of(trained, {"several": [1.0, 0.9, 1.0], "single": [0.3, 0.2, 0.3]}, several=SEVERAL, single=SINGLE)
    one = run_of(trained, {"several": [1.0, 0.9, 1.0]}, several=SEVERAL, single=SINGLE)
    assert [(each.subject, each.outcome, each.second) for each in findings(both)] == [(HYPOTHESES, BETTER, ONE)]
    assert [(each.subject, each.outcome) for each in findings(one)] == [(HYPOTHESES, ALIKE)]
    assert list(findings(run_of({"single": [0.5]}, single=SINGLE))) == []
    assert list(findings(run_of({"randomly": [0.5]}, randomly=RANDOMLY))) == []
