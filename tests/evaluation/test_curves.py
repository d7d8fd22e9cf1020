"""Spec F5: curves over environment steps, numbers over runs, against values worked by hand."""

import math

import numpy as np
from made_up import LEARNED, results_of, row

from hypogoal.evaluation.curves import (
    context,
    curves,
    figures,
    run_numbers,
    steps_to_solve,
    tables,
    trailing_mean,
)
from hypogoal.options.tables import Episodes


def episodes(terminated, length=10):
    count = len(terminated)
    done = np.array(terminated, dtype=bool)
    return Episodes(np.arange(1, count + 1) * length, np.full(count, length), done.astype(float), done, done)


def test_trailing_mean_by_hand():
    """Spec F5: the last two values known at each grid point, fewer at first, none before the first."""
    found = trailing_mean(
        np.array([10, 20, 20, 50]), np.array([1.0, 3.0, 5.0, 7.0]), np.array([0, 10, 19, 20, 49, 50]), 2
    )
    np.testing.assert_array_equal(found, [np.nan, 1, 1, 4, 4, 6])


def test_curves_of_a_run_that_learns():
    """Figure 6: success rises when the episodes do, and not before they are over."""
    run = episodes([0] * 50 + [1] * 50)
    found = curves(run, np.array([199, 200, 509, 510, 1000]), window=50)
    np.testing.assert_allclose(found["success"], [np.nan, 0, 0, 1 / 50, 1])
    np.testing.assert_allclose(found["reward"], found["success"])
    np.testing.assert_allclose(found["length"][1:], 10)


def test_steps_to_solve_needs_a_full_window():
    """Spec F5: the 100 episodes that end at step 1950 are the first of which 95 succeeded."""
    run = episodes([0] * 100 + [1] * 120)
    assert steps_to_solve(run) == 1950
    assert steps_to_solve(episodes([1] * 99)) is None
    assert steps_to_solve(episodes([1] * 100)) == 1000
    assert steps_to_solve(episodes([1, 0] * 100)) is None


def test_near_counts_successes_within_one_and_a_half_shortest_paths():
    """Spec F5: of a shortest path of 10, 15 steps are near and 16 are not; nor is a death, nor a cut at the cap."""
    length = np.array([10, 15, 16, 15, 15, 12, 400, 11])
    reward = np.array([1.0, 1, 1, 0, 1, -1, 1, 1])
    terminated = np.array([1, 1, 1, 1, 0, 1, 1, 1], dtype=bool)
    run = Episodes(np.cumsum(length), length, reward, terminated, terminated & (reward > 0))
    assert run_numbers(run, 10)["near"] == 3 / 8
    assert run_numbers(run, 11)["near"] == 4 / 8
    assert run_numbers(run, 10, window=2)["near"] == 1 / 2  # of the last ones
    for unknown in (run_numbers(run, None)["near"], run_numbers(episodes([]), 10)["near"]):
        assert np.isnan(unknown)


def test_numbers_of_a_run():
    """Spec F5: over the last 100 episodes, and length against the shortest path."""
    numbers = run_numbers(episodes([0] * 100 + [1] * 99 + [0], length=20), shortest_path=16)
    assert numbers["success"] == 0.99
    assert numbers["length_over_shortest"] == 1.25
    assert numbers["episodes"] == 200
    assert numbers["window"] == 100
    assert numbers["steps_to_95"] == 195 * 20
    nothing = run_numbers(episodes([]), None)
    assert nothing["episodes"] == 0
    assert np.isnan(nothing["success"])
    assert nothing["steps_to_95"] is None


def test_what_does_not_succeed_is_no_success():
    """Spec F5: whatever its reward, and whether it terminated; a hundred without success solve nothing."""
    terminated, succeeded = np.array([1, 1, 1, 1, 0], dtype=bool), np.array([0, 0, 1, 0, 0], dtype=bool)
    run = Episodes(np.arange(1, 6), np.full(5, 10), np.array([0.0, 0, 1, -1, 1]), terminated, succeeded)
    assert run_numbers(run, None)["success"] == 0.2
    none = np.zeros(100, dtype=bool)
    hundred = Episodes(np.arange(1, 101), np.full(100, 10), np.zeros(100), ~none, none)
    assert steps_to_solve(hundred) is None
    assert curves(hundred, np.array([100]))["success"][0] == 0


def test_agents_over_runs() -> None:
    """Spec F5: mean over layouts, each once; how many got to 95 %, and the median that counts those that did not."""
    rows = []
    for number, (layout, success, steps) in enumerate(((100, 1, 1_000), (100, 1, 2_000), (101, 0, math.nan))):
        place = {"method": "option agent", "layout": layout, "seed": number, "artefact": f"a-{number}"}
        rows += [row("success", success, **place), row("steps_to_95", steps, **place), row("steps", 9_000, **place)]
    results = results_of(*rows, agents={"option agent": LEARNED})
    made = tables(results)
    assert made["agents"].set_index("quantity")["mean"]["success"] == 0.5
    assert made["agents-solved"].to_dict("records") == [
        {"method": "option agent", "runs": 3, "reached": 2, "median": 2_000}
    ]
    shown = context(results)["table"]
    assert shown.loc["option agent", "95 % at"] == "2 of 3" and shown.loc["option agent", "runs"] == "3"
    assert context(results_of()) is None


def test_a_figure_of_lengths_that_are_all_alike_says_nothing() -> None:
    """Spec F7: Figure 6 is drawn, with random play dotted; the figure of lengths only where they differ."""
    place = {"method": "option agent", "layout": 1, "seed": 0, "artefact": "a"}
    rows = [row("reward", step / 200, step=step, **place) for step in (100, 200)]
    rows += [row("solved_length", 9, step=step, **place) for step in (100, 200)]
    agents = {"agents": {"option agent": LEARNED}}
    random = row("random_success", 0.2, layout=1)
    assert [drawn.name for drawn in figures(results_of(*rows, random, **agents))] == ["figure6"]
    more = row("solved_length", 8, step=200, **place | {"artefact": "b", "seed": 1})
    drawn = list(figures(results_of(*rows, more, random, **agents)))
    assert [each.name for each in drawn] == ["figure6", "figure6-length"]
    assert drawn[0].about["dotted"] == ["random play"]
