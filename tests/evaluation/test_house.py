"""Spec F5: means, intervals and pairs of the one table, against values worked by hand."""

import math

import numpy as np
import pandas as pd
import pytest
from made_up import numbers_of, row

from hypogoal.core.errors import UserError
from hypogoal.evaluation import house
from hypogoal.evaluation.house import above, at_least, compare, interval, over, pairs, per_run, read_numbers


def runs_of(*values: float, layouts=(), quantity: str = "reward") -> pd.DataFrame:
    """A run for each value, of one method."""
    rows = []
    for number, value in enumerate(values):
        layout = layouts[number] if layouts else 7
        rows.append(row(quantity, value, method="a", layout=layout, seed=number, artefact=f"a-{number}"))
    return per_run(numbers_of(*rows), quantity)


def test_runs_of_a_layout_count_once() -> None:
    """Two layouts, of one of which there are three runs: 1 and 5, not 0, 1, 2 and 5."""
    (found,) = over(runs_of(0, 1, 2, 5, layouts=[8, 8, 8, 9]), ["method"]).to_dict("records")
    assert (found["mean"], found["standard_error"], found["n"]) == (3, 2, 4)
    assert found["units"] == 2
    (alone,) = over(runs_of(0, 1, 2, 5), ["method"]).to_dict("records")
    assert (alone["mean"], alone["units"]) == (2, 4)


def test_mean_and_standard_error_by_hand() -> None:
    """Of 2, 4, 6: mean 4, variance 4, error 2 / sqrt(3), t of two degrees of freedom 4.303; of one value no error."""
    (found,) = over(runs_of(2, 4, 6), ["method"]).to_dict("records")
    assert (found["mean"], found["standard_deviation"]) == (4, 2)
    assert found["standard_error"] == pytest.approx(2 / math.sqrt(3))
    assert (found["low"], found["high"]) == pytest.approx((4 - 4.3027 * 1.1547, 4 + 4.3027 * 1.1547), abs=1e-3)
    (one,) = over(runs_of(3), ["method"]).to_dict("records")
    assert one["mean"] == 3 and math.isnan(one["standard_error"]) and math.isnan(one["low"])


def test_bounds_of_shares_lie_within_0_and_1() -> None:
    """Of shares of episodes, not of rewards."""
    (share,) = over(runs_of(1, 1, 0.5, quantity="success"), ["method"]).to_dict("records")
    (reward,) = over(runs_of(1, 1, 0.5), ["method"]).to_dict("records")
    assert share["high"] == 1 < reward["high"] and share["low"] == reward["low"]


def test_the_interquartile_mean_by_hand() -> None:
    """Of eight values the middle four; one outlier more or less does not move it."""
    values = np.array([0.0, 1, 2, 3, 4, 5, 6, 1000])
    assert house.interquartile_mean(values) == house.interquartile_mean(values[::-1]) == 3.5


def test_a_bootstrap_is_of_eight_values_at_least() -> None:
    """And the same each time."""
    values = np.arange(8.0)
    assert interval(values[:7]) == house.student_interval(values[:7])
    assert interval(values) == interval(values) != house.student_interval(values)


@pytest.mark.parametrize(("runs", "least"), [(2, 0.93), (3, 0.93), (5, 0.93), (7, 0.93), (10, 0.9)])
def test_intervals_hold_as_often_as_they_say(runs: int, least: float) -> None:
    """How often what is said of normal runs holds the true value; 95 % are meant."""
    rng = np.random.default_rng(runs)
    count, held = 1_000 if runs < house.BOOTSTRAP_FROM else 300, 0
    for _ in range(count):
        low, high = interval(rng.normal(3, 1, runs))
        held += low <= 3 <= high
    assert least <= held / count <= 0.98


def test_members_become_one_value() -> None:
    """The best, mean and worst, or the one that another quantity names; members without a number are left out."""
    place = {"method": "a", "artefact": "a", "seed": 0}
    rows = [row("distance", value, member=member, **place) for member, value in enumerate((40.0, 15.0, math.nan))]
    numbers = numbers_of(*rows, row("validated_member", 1, **place))
    found = {which: per_run(numbers, "distance", member=which)["value"].tolist() for which in ("best", "mean", "worst")}
    assert found == {"best": [40], "mean": [27.5], "worst": [15]}
    assert per_run(numbers, "distance", member="validated_member")["value"].tolist() == [15]
    assert per_run(numbers, "distance", member="best_member").empty


def test_points_of_curves_are_no_final_numbers() -> None:
    """A run's 151 points of its learning curve do not count beside its last number."""
    place = {"method": "a", "artefact": "a", "layout": 5, "seed": 0}
    numbers = numbers_of(row("success", 1, **place), *(row("success", 0, step=step, **place) for step in range(151)))
    assert per_run(numbers, "success")["value"].tolist() == [1]


def compared(first, second, units=None, *, higher=True):
    """Of pairs of runs of a layout each, or of those that ``units`` says."""
    units = range(len(first)) if units is None else units
    both = pd.DataFrame({"value": first, "value_second": second, "layout": units, "seed": units})
    of = "success" if higher else "length"
    return compare(both.assign(of=of, method="a", method_second="b"))


def test_probability_of_improvement_by_hand() -> None:
    """Won, lost, tied, won: (1 + 0 + 1/2 + 1) / 4; of 3 that are no ties 2 won: p is 1."""
    found = compared([3, 5, 2, 4], [1, 6, 2, 2])
    assert (found["n"], found["wins"], found["ties"]) == (4, 2, 1)
    assert (found["probability"], found["difference"], found["sign_test"]) == (0.625, 0.75, 1.0)
    assert compared([3, 5, 2, 4], [1, 6, 2, 2], higher=False)["probability"] == 0.375
    assert found["probability_low"] < 0.625 < found["probability_high"]


def test_a_win_in_every_pair_is_not_certainty() -> None:
    """Five of five: they do not vary, so the interval has no width; the sign test is 2 / 2**5."""
    found = compared([2, 3, 4, 5, 6], [1, 2, 2, 3, 5])
    assert (found["probability_low"], found["probability_high"]) == (1, 1)
    assert found["sign_test"] == pytest.approx(2 / 2**5)
    assert found["difference"] == pytest.approx(7 / 5)


@pytest.mark.parametrize("higher", [True, False])
def test_means_that_differ_by_rounding_alone_are_ties(higher: bool) -> None:
    members = np.array([[0.1, 0.2, 0.3], [0.7, 0.8, 0.9], [0.4, 0.6, 0.7]])
    first, second = members.mean(axis=1), members[:, [2, 0, 1]].mean(axis=1)
    assert (first != second).any()
    found = compared(first, second, higher=higher)
    assert (found["wins"], found["ties"], found["probability"]) == (0, 3, 0.5)
    assert math.isnan(found["sign_test"])


def test_pairs_of_one_unit_are_one_piece_of_evidence() -> None:
    """One ensemble that wins on nine ladders has won once; two of three units won is no 6 of 9."""
    once = compared([1] * 9, [0] * 9, [0] * 9)
    assert (once["n"], once["units"], once["wins"], once["sign_test"]) == (9, 1, 9, 1.0)
    assert math.isnan(once["probability_low"])
    several = [1, 1, 0, 1, 1, 1, 0, 0, 0], [0] * 2 + [1] + [0] * 3 + [1] * 3, [5, 5, 5, 6, 6, 6, 7, 7, 7]
    found = compared(*several)
    assert (found["units"], found["wins"], found["n"], found["sign_test"]) == (3, 5, 9, 1.0)
    assert compared(*several, higher=False)["difference_low"] == pytest.approx(1 / 9 - 2.5297, abs=1e-3)
    assert (found["difference_low"], found["difference_high"]) == (-1, 1), "of shares"
    assert (found["probability_low"], found["probability_high"]) == (0, 1)


def agent(method: str, *runs: tuple[int, int, float]) -> list[dict]:
    """Rows of runs, each (layout, seed, length)."""
    rows = []
    for number, (layout, seed, length) in enumerate(runs):
        place = {"method": method, "layout": layout, "seed": seed, "artefact": f"{method}-{number}"}
        rows.append(row("length", length, **place))
    return rows


def test_agents_are_paired_by_layout_and_seed() -> None:
    """Runs without a partner count nothing; a shorter episode is the better one; each layout counts once."""
    own = agent("options", (100, 0, 12), (100, 1, 14), (101, 0, 20), (102, 0, 5))
    other = agent("random", (101, 0, 30), (100, 0, 24), (100, 1, 13))
    (found,) = pairs(per_run(numbers_of(*own, *other, *agent("elsewhere", (500, 0, 1))), "length")).to_dict("records")
    assert [found[name] for name in ("first", "second", "n", "wins", "units")] == ["options", "random", 3, 2, 2]
    assert found["difference"] == pytest.approx(((-12 + 1) / 2 - 10) / 2)
    assert pairs(per_run(numbers_of(*own), "length")).empty


def test_ensembles_of_no_layout_are_paired_at_each_n() -> None:
    """By seed and sub-goal, at each number of groups."""
    rows = []
    for method, best in (("D-BAT", 0.6), ("none", 0.5)):
        for groups in (1, 2):
            place = {"method": method, "N": groups, "seed": 0, "artefact": f"{method}-{groups}", "sub_goal": "down"}
            rows.append(row("balanced_accuracy", best + groups / 10, member=0, scope="unseen", **place))
    found = pairs(per_run(numbers_of(*rows), "balanced_accuracy", scope="unseen"))
    assert found["N"].tolist() == [1, 2] and found["n"].tolist() == [1, 1]
    assert found["difference"].tolist() == pytest.approx([0.1, 0.1])


def test_numbers_are_read_as_they_were_written(tmp_path) -> None:
    """Names that look like formulas or like nothing, and a later version's column."""
    rows = numbers_of(
        row("success", 1 / 3, method="=1+1", seed=-3), row("success", 0.5, method="None", layout=7, step=0)
    )
    rows.assign(later="x").to_csv(tmp_path / "numbers.csv", index=False)
    pd.testing.assert_frame_equal(read_numbers(tmp_path / "numbers.csv")[rows.columns], rows)


@pytest.mark.parametrize("text", ["", "quantity,value\nsuccess,much\n", "quantity\nsuccess\n"])
def test_a_damaged_table_is_one_line(tmp_path, text: str) -> None:
    (tmp_path / "numbers.csv").write_text(text)
    with pytest.raises(UserError, match="cannot be read"):
        read_numbers(tmp_path / "numbers.csv")


def test_what_misses_a_bound_by_rounding_meets_it() -> None:
    """Every difference of two hundredths against every other, as exact fractions compare; NaN meets none."""
    hundredths = np.arange(101)
    upper, lower = np.meshgrid(hundredths, hundredths)
    for bound in hundredths.tolist():
        assert (at_least(upper / 100 - lower / 100, bound / 100) == (upper - lower >= bound)).all()
        assert (above(upper / 100 - lower / 100, bound / 100) == (upper - lower > bound)).all()
    assert not at_least(0.2 - 1e-6, 0.2) and not at_least(math.nan, 0.0) and not above(math.nan, 0.0)
