"""Spec F3, F4: distances, shares and means over ladders and seeds against values worked by hand."""

import numpy as np
import pytest
from ladder_run import COLUMNS, executions

from hypogoal.core.errors import UserError
from hypogoal.core.files import write_table
from hypogoal.evaluation.distance import (
    BEGAN_INSIDE,
    HIT,
    MISS,
    at_base,
    counted,
    distance_table,
    fates,
    option_numbers,
    options_of,
    rows_of_ladder,
)
from hypogoal.evaluation.table import BEST, VALIDATED, WORST, rows_of
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
    own = read(executions(0, [0, 4, 4, 5, 200], inside=2))
    assert counted(own).tolist() == [300, 300, 4, 5, 200]
    assert at_base(own).tolist() == [False, False, True, False, False]
    assert fates(own).tolist() == [BEGAN_INSIDE, BEGAN_INSIDE, HIT, MISS, MISS]


def test_one_option_by_hand(read):
    """Spec F3: ten executions: one began inside, two timed out, one died; the shares of all ten."""
    own = read(executions(0, [9, 0, 2, 4, 5, 11, 40, 50, 60, 3], inside=1, died=1, timed_out=2))
    found = option_numbers(own)
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
    own = read(rows).of(0)
    assert len(own.step) == 100
    assert option_numbers(own)["distance"] == 10
    one = option_numbers(read(rows).of(1))
    assert one["distance"] == 7
    assert np.isnan(one["executions_deviation"])


def learned(*arguments, **more):
    """What is said of the options of one ladder, by sub-goal."""
    return options_of(rows_of_ladder(*arguments, **more, ladder="1L", artefact="options"))


def test_best_worst_and_validated_member(read):
    """Spec F3: the best is the nearest; an option that was never offered, since it always began inside, counts 300."""
    rows = executions(0, [30, 50]) + executions(1, [10, 20]) + executions(2, [100], inside=1)
    (found,) = learned(read(rows), ("down",), 4, {"down": 0}, masked=False)
    distances = [option["distance"] for option in found["options"]]
    assert distances[:3] == [40, 15, 300]
    assert np.isnan(distances[3])
    assert (found["best"], found["worst"], found["validated"]) == (1, 2, 0)
    (masked,) = learned(read(rows), ("down",), 4, {}, masked=True)
    assert (masked["options"][3]["distance"], masked["options"][3]["executions"]) == (300, 0)
    assert [option["distance"] for option in masked["options"][:3]] == distances[:3]
    assert masked["validated"] is None
    (nothing,) = learned(read([]), ("down",), 2, {}, masked=True)
    assert (nothing["best"], nothing["worst"]) == (None, None)
    assert np.isnan(nothing["options"][0]["distance"])


def test_two_sub_goals_have_their_own_members(read):
    """Spec D1: option g*K + k is member k of sub-goal g."""
    rows = executions(1, [3]) + executions(2, [8]) + executions(3, [5])
    first, second = learned(read(rows), ("down", "up"), 2, {}, masked=False)
    assert (first["sub_goal"], first["best"]) == ("down", 1)
    assert [option["option"] for option in second["options"]] == [2, 3]
    assert (second["best"], second["worst"]) == (1, 0)


def stopped(ladder, seed, distances, method="dbat", groups=2, validated=0, number=0):
    """Rows of one artefact's options."""
    place = {"method": method, "N": groups, "sub_goal": "down", "ladder": ladder, "seed": seed}
    place["artefact"] = f"{method}-{ladder}-{seed}-{number}"
    shares = {"reached_base": 0.5, "inside_at_start": 0.0, "timed_out": 0.25, "died": 0.0}
    for member, distance in enumerate(distances):
        numbers = {"distance": float(distance), "executions_deviation": 2.0, **shares}
        yield from rows_of(numbers, **place, member=member)
    picked = {BEST: int(np.argmin(distances)), WORST: int(np.argmax(distances)), VALIDATED: validated}
    yield from rows_of(picked, **place)


def test_mean_over_ladders_then_over_seeds():
    """Spec F3, Figure 4: another member may be the best on each ladder; then mean and spread over seeds."""
    rows = [*stopped("1L", 0, [10, 30]), *stopped("2-6", 0, [60, 20])]
    rows += [*stopped("1L", 1, [14, 30]), *stopped("2-6", 1, [40, 36])]
    rows += stopped("1L", 0, [2], "oracle termination", None, None)
    over, oracle = distance_table(rows, ["1L", "2-6"])
    assert over["best"]["mean"] == pytest.approx((15 + 25) / 2)
    assert over["best"]["standard_deviation"] == pytest.approx(np.sqrt(50))
    assert over["validated"]["mean"] == pytest.approx((35 + 27) / 2)
    assert over["mean"]["mean"] == pytest.approx((30 + 30) / 2)
    assert over["worst"]["mean"] == pytest.approx((45 + 35) / 2)
    assert over["executions_deviation"]["mean"] == 2
    assert (over["reached_base"]["mean"], over["timed_out"]["mean"]) == (0.5, 0.25)
    assert (over["seeds"], over["incomplete_seeds"]) == (2, [])
    assert (oracle["seeds"], oracle["incomplete_seeds"]) == (0, [0])
    assert np.isnan(oracle["best"]["mean"])


def test_options_of_several_ensembles_with_one_seed_all_count():
    """Spec F3: three artefacts alike in seed and ladder are three, not the last one read."""
    rows = [row for away in (10, 200, 90) for row in stopped("1L", 0, [away], number=away)]
    (found,) = distance_table(rows, ("1L",))
    assert (found["seeds"], found["best"]["mean"]) == (3, 100)


def test_unlike_ladders_are_not_averaged():
    """Spec F3: a seed that lacks one of the ladders is left out of the mean over ladders, and told."""
    rows = [*stopped("1L", 0, [10]), *stopped("2-6", 0, [30]), *stopped("1L", 1, [1])]
    (over,) = distance_table(rows, ["1L", "2-6"])
    assert (over["best"]["mean"], over["best"]["n"], over["incomplete_seeds"]) == (20, 1, [1])


@pytest.mark.parametrize("text", ["step,option\n1,2\n", ",".join(COLUMNS) + "\n" + "nan," * 9 + "1\n", ""])
def test_a_damaged_table_is_one_line(tmp_path, text):
    """Spec G2: another table, a number that is none, an empty file."""
    path = tmp_path / "executions.csv"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(UserError, match=r"executions\.csv"):
        Executions.read(path)
