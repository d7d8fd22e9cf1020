"""Spec F5: curves over environment steps, numbers over runs, against values worked by hand."""

import numpy as np
import pytest

from hypogoal.evaluation.curves import curves, run_numbers, steps_to_solve, trailing_mean
from hypogoal.evaluation.numbers import (
    BOOTSTRAP_FROM,
    STUDENT,
    by_layout,
    interquartile_mean,
    interval,
    mean_and_error,
    over,
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


def test_mean_and_standard_error_by_hand():
    """Spec F5: of 2, 4, 6: mean 4, variance 4, error 2 / sqrt(3)."""
    assert mean_and_error(np.array([2.0, 4.0, 6.0])) == pytest.approx((4, 2 / np.sqrt(3)))
    mean, error = mean_and_error(np.array([3.0]))
    assert mean == 3
    assert np.isnan(error)
    assert np.isnan(mean_and_error(np.array([]))).all()


def test_interquartile_mean_by_hand():
    """Spec F5: of eight values the middle four; one outlier more or less does not move it."""
    values = np.array([0.0, 1, 2, 3, 4, 5, 6, 1000])
    assert interquartile_mean(values) == 3.5
    assert interquartile_mean(values[::-1]) == 3.5


def test_students_interval_by_hand():
    """Spec F5: 2, 4, 6: mean 4, error 2 / sqrt(3), t of two degrees of freedom 4.303; of one value there is none."""
    low, high, kind = interval(np.array([2.0, 4.0, 6.0]), np.random.default_rng(0))
    assert (low, high) == pytest.approx((4 - 4.3027 * 2 / np.sqrt(3), 4 + 4.3027 * 2 / np.sqrt(3)), abs=1e-3)
    assert kind == STUDENT
    low, high, kind = interval(np.array([2.0]), np.random.default_rng(0))
    assert np.isnan([low, high]).all()
    assert kind == "no interval"


def test_a_bootstrap_is_of_eight_values_at_least():
    """Spec F5: and the seed fixes it."""
    values = np.arange(8.0)
    assert interval(values[:7], np.random.default_rng(2))[2] == STUDENT
    found = interval(values, np.random.default_rng(2))
    assert found == interval(values, np.random.default_rng(2))
    assert "bootstrap" in found[2]


@pytest.mark.parametrize(("runs", "least"), [(2, 0.93), (3, 0.93), (5, 0.93), (7, 0.93), (10, 0.9)])
def test_intervals_hold_as_often_as_they_say(runs, least):
    """Spec F5: how often what is reported of normal runs holds the true value; 95 % are meant.

    Bootstraps of the interquartile mean of ten are known to be a little narrow. Two seeds of each layout, whose
    layouts differ more than its seeds, are as many values as there are layouts.
    """
    rng, layouts = np.random.default_rng(runs), np.repeat(range(runs), 2).tolist()
    count, held = 1_000 if runs < BOOTSTRAP_FROM else 300, 0
    for cell in range(count):
        values = np.repeat(rng.normal(3, 1, runs), 2) + rng.normal(0, 0.3, 2 * runs)
        low, high = over(values.tolist(), "", str(cell), layouts=layouts)["interval"]
        held += low <= 3 <= high
    assert least <= held / count <= 0.98


def test_runs_of_a_layout_count_once():
    """Spec F5: two layouts, of one of which there are three runs: 1 and 5, not 1, 1, 1 and 5."""
    found = over([0.0, 1.0, 2.0, 5.0], "steps", layouts=[8, 8, 8, 9])
    assert (found["mean"], found["standard_error"], found["n"]) == (3, 2, 4)
    assert found["interval_over"] == f"layouts: {STUDENT}"
    alone = over([0.0, 1.0, 2.0, 5.0], "steps", layouts=[8] * 4)
    assert (alone["mean"], alone["interval_over"]) == (2, f"runs: {STUDENT}")
    np.testing.assert_array_equal(
        by_layout(np.array([[0, 1], [2, np.nan], [5, np.nan]]), [8, 8, 9])[0], [[1, 1], [5, np.nan]]
    )


def test_aggregate_leaves_out_what_is_not_a_number():
    """Spec F5: n says how many runs there were a number of."""
    found = over([1.0, float("nan"), 3.0], "steps", layouts=[5, 6, 7])
    assert (found["mean"], found["n"], found["unit"]) == (2.0, 2, "steps")
    assert found["interval"] == pytest.approx([2 - 12.706, 2 + 12.706], abs=1e-3)
    empty = over([], "steps")
    assert empty["n"] == 0
    assert np.isnan(empty["mean"])
    assert np.isnan(empty["iqm"])
