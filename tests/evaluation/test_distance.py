"""Spec F3, F4: distances, shares and means over ladders and seeds against values worked by hand."""

import numpy as np
import pytest
from ladder_run import COLUMNS, executions
from made_up import asked, figures, results_of, row, shown
from toy_data import write_table

from hypogoal.evaluation import distance
from hypogoal.evaluation.distance import BEST, WORST, last_executions, option_numbers, rows_of_ladder
from hypogoal.evaluation.table import joined
from hypogoal.options.tables import Executions


@pytest.fixture
def read(tmp_path):
    """Executions as the evaluation reads them from a file."""

    def of(rows):
        write_table(tmp_path / "executions.csv", COLUMNS, rows)
        return Executions.read(tmp_path / "executions.csv")

    return of


def test_the_columns_are_those_that_are_written():
    """Spec A8: the reader's columns are the recorder's."""
    assert Executions.names() == COLUMNS


def test_an_execution_that_begins_inside_counts_300(read):
    """Spec F3: wherever it stops, even at a base; within 4 of a base is there, 5 is not."""
    own = last_executions(read(executions(0, [0, 4, 4, 5, 200], inside=2)))
    assert own["counted"].tolist() == [300, 300, 4, 5, 200]
    assert own["reached_base"].tolist() == [False, False, True, False, False]
    assert own["fate"].tolist() == [distance.BEGAN_INSIDE] * 2 + [distance.HIT] + [distance.MISS] * 2


def test_one_option_by_hand(read):
    """Spec F3: ten executions: one began inside, two timed out, one died; the shares of all ten."""
    own = read(executions(0, [9, 0, 2, 4, 5, 11, 40, 50, 60, 3], inside=1, died=1, timed_out=2))
    found = option_numbers(own).loc[0]
    distances = np.array([300, 0, 2, 4, 5, 11, 40, 50, 60, 3])
    assert found["executions"] == 10
    assert found["distance"] == pytest.approx(distances.mean())
    assert found["executions_deviation"] == pytest.approx(np.sqrt(((distances - 47.5) ** 2).sum() / 9))
    assert found["duration"] == 7
    assert (found["reached_base"], found["inside_at_start"]) == (0.4, 0.1)
    assert (found["timed_out"], found["died"]) == (0.2, 0.1)


def test_the_last_hundred_of_each_option_count(read):
    """Spec F3: earlier ones do not, and other options' are not mixed in."""
    rows = executions(0, [50] * 30 + [10] * 100) + executions(1, [7])
    found = option_numbers(read(rows))
    assert found["executions"].tolist() == [100, 1]
    assert found["distance"].tolist() == [10, 7]
    assert np.isnan(found["executions_deviation"][1])


def of_ladder(read, rows, sub_goals=("down",), members=1, **more):
    """What is said of the options of one ladder: a column for each number, by sub-goal and member."""
    config = {"sub_goals": sub_goals, "members": members, "mask_reached": False, **more}
    found = joined(rows_of_ladder(read(rows), config, {"down": 0}, {"ladder": "1L", "artefact": "options"}))
    return found.set_index(["sub_goal", "quantity", "member"])["value"].sort_index()


def test_best_worst_and_validated_member(read):
    """Spec F3: the best is the nearest; an option that was never offered, since it always began inside, counts 300."""
    rows = executions(0, [30, 50]) + executions(1, [10, 20]) + executions(2, [100], inside=1)
    found = of_ladder(read, rows, members=4)["down"]
    assert found["distance"].to_dict() == {0: 40, 1: 15, 2: 300}
    picked = {name: found[name].item() for name in (BEST, WORST, "validated_member")}
    assert picked == {BEST: 1, WORST: 2, "validated_member": 0}
    masked = of_ladder(read, rows, members=4, mask_reached=True)["down"]
    assert masked["distance"].to_dict() == {0: 40, 1: 15, 2: 300, 3: 300}
    nothing = of_ladder(read, [], members=2, mask_reached=True)["down"]
    assert "distance" not in nothing and BEST not in nothing


def test_two_sub_goals_have_their_own_members(read):
    """Spec D1: option g*K + k is member k of sub-goal g."""
    rows = executions(1, [3]) + executions(2, [8]) + executions(3, [5])
    found = of_ladder(read, rows, ("down", "up"), 2)
    assert (found["down", BEST].item(), found["up", BEST].item(), found["up", WORST].item()) == (1, 1, 0)
    assert found["up", "distance"].to_dict() == {0: 8, 1: 5}


def stopped(ladder, seed, *distances, method="D-BAT", groups=2, validated=0, number=0):
    """Rows of one artefact's options."""
    place = {"method": method, "N": groups, "sub_goal": "down", "ladder": ladder, "seed": seed}
    place["artefact"] = f"{method}-{ladder}-{seed}-{number}"
    rows = []
    for member, away in enumerate(distances):
        numbers = {"distance": away, "executions_deviation": 2.0, "reached_base": 0.5, "timed_out": 0.25}
        rows += [row(name, value, member=member, **place) for name, value in numbers.items()]
    picked = {BEST: np.nanargmin(distances), WORST: np.nanargmax(distances), "validated_member": validated}
    return rows + [row(name, value, **place) for name, value in picked.items()]


def test_mean_over_ladders_then_over_seeds():
    """Spec F3, Figure 4: another member may be the best on each ladder; then mean and spread over seeds."""
    rows = [
        *stopped("1L", 0, 10, 30),
        *stopped("2-6", 0, 60, 20),
        *stopped("1L", 1, 14, 30),
        *stopped("2-6", 1, 40, 36),
    ]
    rows += stopped("1L", 0, 2, method="oracle termination", groups=None)
    results = results_of(*rows)
    table = asked(distance, results)["table"].set_index(["method", "quantity"])
    assert {*table.index.get_level_values("method")} == {"D-BAT"}, "the oracle lacks a ladder"
    found = table.loc["D-BAT"]
    means = [found["mean"][which] for which in ("best", "validated", "mean", "worst", "executions_deviation")]
    assert means == [20, 31, 30, 40, 2]
    assert found["standard_deviation"]["best"] == pytest.approx(np.sqrt(50))
    assert (found["mean"]["reached_base"], found["mean"]["timed_out"], found["n"]["best"]) == (0.5, 0.25, 2)
    assert shown(distance, results).loc["D-BAT", "best"] == "20.0 ± 7.1"
    assert [drawn.name for drawn in figures(distance, results)] == ["figure4"]
    assert asked(distance, results_of()) is None


def test_unlike_ladders_are_not_averaged():
    """Spec F3: a seed that lacks one of the ladders is left out of the mean over ladders."""
    rows = [*stopped("1L", 0, 10), *stopped("2-6", 0, 30), *stopped("1L", 1, 1)]
    found = asked(distance, results_of(*rows))["table"].set_index("quantity")
    assert (found["mean"]["best"], found["n"]["best"]) == (20, 1)


def test_options_are_paired_by_ladder_and_seed():
    """Spec F3: the nearer is the better; oracle terminations are not a method; members never executed count nothing."""
    rows = [*stopped("1L", 0, 10, np.nan), *stopped("1R", 0, 20, np.nan)]
    rows += [*stopped("1L", 0, 40, method="one"), *stopped("1R", 0, 10, method="one")]
    rows += stopped("1L", 0, 0, method="oracle termination", groups=None)
    pairs = asked(distance, results_of(*rows))["pairs"].set_index("quantity")
    best = pairs.loc["best"]
    assert (best["first"], best["second"], best["n"], best["wins"], best["units"]) == ("D-BAT", "one", 2, 1, 1)
    assert pairs["difference"].tolist() == [-10, -10, -10]
