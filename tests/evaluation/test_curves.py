"""Spec F5: curves over environment steps, numbers over runs, against values worked by hand."""

import math
import re

import numpy as np
import pytest
from made_up import LEARNED, asked, figures, numbers_of, results_of, row, shown

from hypogoal.evaluation import curves as question
from hypogoal.evaluation import page
from hypogoal.evaluation.curves import by_episode, curves, learning_curves, run_numbers
from hypogoal.options.tables import Episodes


def episodes(terminated, length=10):
    count = len(terminated)
    done = np.array(terminated, dtype=bool)
    return Episodes(np.arange(1, count + 1) * length, np.full(count, length), done.astype(float), done, done)


def test_curves_of_a_run_that_learns():
    """Figure 6: success rises when the episodes do, and not before they are over."""
    run = episodes([0] * 100 + [1] * 100)
    found = curves(run, np.array([199, 200, 1009, 1010, 2000]))
    assert found.index.tolist() == [200, 1009, 1010, 2000], "from the twentieth episode on"
    np.testing.assert_allclose(found["success"], [0, 0, 1 / 100, 1], atol=1e-12)
    np.testing.assert_allclose(found["reward"], found["success"])
    np.testing.assert_allclose(found["length"], 10)
    assert found["solved_length"].isna().tolist() == [True, True, False, False]


def test_steps_to_solve_needs_a_full_window():
    """Spec F5: the 100 episodes that end at step 1950 are the first of which 95 succeeded."""
    run = episodes([0] * 100 + [1] * 120)
    assert run_numbers(run, None)["steps_to_95"] == 1950
    assert math.isnan(run_numbers(episodes([1] * 99), None)["steps_to_95"])
    assert run_numbers(episodes([1] * 100), None)["steps_to_95"] == 1000
    assert math.isnan(run_numbers(episodes([1, 0] * 100), None)["steps_to_95"])


def test_near_counts_successes_within_one_and_a_half_shortest_paths():
    """Spec F5: of a shortest path of 10, 15 steps are near and 16 are not; nor is a death, nor a cut at the cap."""
    length = np.array([10, 15, 16, 15, 15, 12, 400, 11])
    reward = np.array([1.0, 1, 1, 0, 1, -1, 1, 1])
    terminated = np.array([1, 1, 1, 1, 0, 1, 1, 1], dtype=bool)
    run = Episodes(np.cumsum(length), length, reward, terminated, terminated & (reward > 0))
    assert run_numbers(run, 10)["near"] == 3 / 8
    assert run_numbers(run, 11)["near"] == 4 / 8
    for unknown in (run_numbers(run, None)["near"], run_numbers(episodes([]), 10)["near"]):
        assert np.isnan(unknown)


def test_numbers_of_a_run():
    """Spec F5: over the last 100 episodes, and length against the shortest path."""
    numbers = run_numbers(episodes([0] * 100 + [1] * 99 + [0], length=20), shortest_path=16)
    assert numbers["success"] == 0.99
    assert numbers["length_over_shortest"] == 1.25
    assert numbers["episodes"] == 200
    assert numbers["steps_to_95"] == 195 * 20
    nothing = run_numbers(episodes([]), None)
    assert nothing["episodes"] == 0
    assert np.isnan(nothing["success"])
    assert math.isnan(nothing["steps_to_95"])


def test_what_does_not_succeed_is_no_success():
    """Spec F5: whatever its reward, and whether it terminated; a hundred without success solve nothing."""
    terminated, succeeded = np.array([1, 1, 1, 1, 0], dtype=bool), np.array([0, 0, 1, 0, 0], dtype=bool)
    run = Episodes(np.arange(1, 6), np.full(5, 10), np.array([0.0, 0, 1, -1, 1]), terminated, succeeded)
    numbers = run_numbers(run, None)
    assert (numbers["success"], numbers["ended"], numbers["cut"]) == (0.2, 0.6, 0.2)
    none = np.zeros(100, dtype=bool)
    hundred = Episodes(np.arange(1, 101), np.full(100, 10), np.zeros(100), ~none, none)
    assert math.isnan(run_numbers(hundred, None)["steps_to_95"])
    assert curves(hundred, np.array([100]))["success"].tolist() == [0]


def test_agents_over_runs() -> None:
    """Spec F5: mean over layouts, each once; how many got to 95 %."""
    rows = []
    for number, (layout, success, steps) in enumerate(((100, 1, 1_000), (100, 1, 2_000), (101, 0, math.nan))):
        place = {"method": "option agent", "layout": layout, "seed": number, "artefact": f"a-{number}"}
        rows += [row("success", success, **place), row("steps_to_95", steps, **place), row("steps", 9_000, **place)]
    results = results_of(*rows, agents={"option agent": LEARNED})
    table = asked(question, results)["table"].set_index("quantity")
    assert table["mean"]["success"] == 0.5
    agent = shown(question, results).loc["option agent"]
    assert (agent["runs"], agent["runs at 95 %"]) == ("3", "2")
    assert asked(question, results_of()) is None


def test_a_figure_of_lengths_that_are_all_alike_says_nothing() -> None:
    """Spec F7: Figure 6 is drawn, with random play dotted; of lengths only where they differ; over episodes too."""
    place = {"method": "option agent", "layout": 1, "seed": 0, "artefact": "a"}
    rows = [row("reward", step / 200, step=step, **place) for step in (100, 200)]
    rows += [row("solved_length", 9, step=step, **place) for step in (100, 200)]
    agents = {"agents": {"option agent": LEARNED}}
    final, random = row("success", 1, **place), row("random_success", 0.2, layout=1)
    assert [drawn.name for drawn in figures(question, results_of(*rows, final, random, **agents))] == ["figure6"]
    more = row("solved_length", 8, step=200, **place | {"artefact": "b", "seed": 1})
    drawn = figures(question, results_of(*rows, more, final, random, **agents))
    assert [each.name for each in drawn] == ["figure6", "figure6-length"]
    assert drawn[0].about["dotted"] == "random_success"
    counted = [row("solved_by_episode", number / 40, step=number, **place) for number in (10, 40)]
    drawn = figures(question, results_of(*rows, *counted, final, random, **agents))
    assert [each.name for each in drawn] == ["figure6", "figure6-episodes"]
    axes = [each.figure.axes[0] for each in drawn]
    assert [(place.get_xlabel(), place.get_xscale()) for place in axes] == [
        ("environment steps, in thousands", "linear"),
        ("episodes", "log"),
    ]
    assert axes[1].xaxis.get_major_formatter()(10) == "10"
    scored = row("reward", 7, step=300, **place)
    assert figures(question, results_of(*rows, scored, final, random, **agents))[0].about["dotted"] == ""


def test_how_soon_in_episodes():
    """The shares of episodes 1-10, 11-20, 21-50 and 51-100 by hand; of episodes 36 to 55 all but one are solved."""
    run = episodes([0] * 10 + [1, 0] * 5 + [0] * 15 + [1] * 15 + [0] + [1] * 49)
    numbers = run_numbers(run, None)
    shares = [numbers[f"solved_{window}"] for window in ("1_10", "11_20", "21_50", "51_100")]
    np.testing.assert_allclose(shares, [0, 0.5, 0.5, 0.98])
    assert numbers["episodes_to_95"] == 55
    short = run_numbers(episodes([1] * 19), None)
    assert short["solved_1_10"] == 1 and np.isnan([short["solved_11_20"], short["episodes_to_95"]]).all()
    assert run_numbers(episodes([1] * 20), None)["episodes_to_95"] == 20
    assert np.isnan(run_numbers(episodes([]), None)["episodes_to_95"])


def test_curves_over_episodes():
    """Of the last twenty, from the tenth on; the index is the number of episodes, denser where these are few."""
    found = by_episode(np.array([False] * 10 + [True] * 30))["solved_by_episode"]
    assert found.index[0] == 10 and found.index[-1] <= 40 and found.index.is_unique
    np.testing.assert_allclose([found[10], found[20], found[30]], [0, 0.5, 1])
    assert by_episode(np.ones(9, np.bool_)).empty


def test_the_band_of_a_curve_is_the_standard_error() -> None:
    """Figure 6: of 1 and 3 on two layouts the mean is 2 and its error sqrt(2) / sqrt(2); their deviation is not 1."""
    rows = [row("reward", value, step=step, layout=value, method="a") for value in (1, 3) for step in (10, 20)]
    (axes,) = learning_curves(numbers_of(*rows), "reward").axes
    (band,) = axes.collections
    heights = band.get_paths()[0].vertices[:, 1]
    assert (heights.min(), heights.max()) == pytest.approx((1, 3))


def test_intervals_on_the_page_are_in_the_units_of_its_titles() -> None:
    """Three layouts: success in percent, median steps, and near as a share, each with its interval if it has one."""
    rows = []
    for layout in range(3):
        place = {"method": "option agent", "layout": layout, "seed": 0, "artefact": f"a-{layout}"}
        rows += [row("success", 1, **place), row("solved_length", 12, **place), row("near", 0.5, **place)]
    context = asked(question, results_of(*rows, agents={"option agent": LEARNED}))
    text = page.render("curves.html", **context).partition("95 % intervals, and agents")[2]
    cells = dict(re.findall(r'data-name="([^"]+)">([^<]*)', text.partition("</table>")[0]))
    assert cells["success, %"].startswith("100.0 [29.") and cells["success, %"].endswith(", 100.0]")
    assert cells["steps"] == "12" and cells["within 1.5 shortest paths"].startswith("0.50 [")
