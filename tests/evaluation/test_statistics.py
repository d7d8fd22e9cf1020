"""Spec F5: means, intervals and pairs of the one table, against values worked by hand."""

import math
import tomllib
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from made_up import numbers_of, row

from hypogoal.core.errors import UserError
from hypogoal.evaluation import table
from hypogoal.evaluation.statistics import (
    MEDIANS_FROM,
    SHARES_FROM,
    above,
    at_least,
    compare,
    interval,
    over,
    pairs,
)
from hypogoal.evaluation.table import per_run, read_numbers


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
    """Of 2, 4, 6: mean 4, variance 4, error 2 / sqrt(3); of one value no error."""
    (found,) = over(runs_of(2, 4, 6), ["method"]).to_dict("records")
    assert (found["mean"], found["standard_deviation"]) == (4, 2)
    assert found["standard_error"] == pytest.approx(2 / math.sqrt(3))
    (one,) = over(runs_of(3), ["method"]).to_dict("records")
    assert one["mean"] == 3 and math.isnan(one["standard_error"]) and math.isnan(one["low"])


def test_an_interval_is_of_the_mean_of_shares_and_of_the_median_of_all_else() -> None:
    """Three of three solved are certain of 29 % (.025 ** (1 / 3), drawn); six values hold the median in 97 %."""
    (share,) = over(runs_of(1, 1, 1, quantity="success"), ["method"]).to_dict("records")
    assert (share["estimate"], share["high"]) == (1, 1) and share["low"] == pytest.approx(0.025 ** (1 / 3), abs=0.01)
    (reward,) = over(runs_of(1, 2, 3, 4, 5, 100), ["method"]).to_dict("records")
    assert (reward["estimate"], reward["low"], reward["high"]) == (3.5, 1, 100)


@pytest.mark.parametrize(("are_shares", "least"), [(True, SHARES_FROM), (False, MEDIANS_FROM)])
def test_of_too_few_values_there_is_no_interval(are_shares: bool, least: int) -> None:
    values = np.linspace(0, 1, least)
    assert all(map(math.isnan, interval(values[1:], are_shares=are_shares)))
    low, high = interval(values, are_shares=are_shares)
    assert 0 <= low < values.mean() < high <= 1


@pytest.mark.parametrize(
    ("runs", "are_shares"), [(3, True), (6, True), (10, True), (6, False), (10, False), (40, False)]
)
def test_intervals_hold_as_often_as_they_say(runs: int, are_shares: bool) -> None:
    """How often what is said of runs that mostly succeed, or of skewed lengths, holds the truth; 95 % are meant."""
    rng = np.random.default_rng(runs)
    count, held = 400, 0
    for _ in range(count):
        solved = rng.random(runs) < 0.8
        values = np.where(solved, 1.0, rng.random(runs) / 2) if are_shares else rng.lognormal(0, 1, runs)
        low, high = interval(values, are_shares=are_shares)
        held += low <= (0.85 if are_shares else 1) <= high
    assert held / count >= 0.93


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
    """Won, lost, tied, won: (1 + 0 + 1/2 + 1) / 4; of 3 that are no ties 2 won: p is 1; of 2, -1, 0, 2 the median."""
    found = compared([3, 5, 2, 4], [1, 6, 2, 2])
    assert (found["n"], found["wins"], found["ties"]) == (4, 2, 1)
    assert (found["probability"], found["difference"], found["sign_test"]) == (0.625, 1.0, 1.0)
    assert compared([3, 5, 2, 4], [1, 6, 2, 2], higher=False)["probability"] == 0.375
    assert found["probability_low"] < 0.625 < found["probability_high"]


def test_a_win_in_every_pair_is_not_certainty() -> None:
    """Five of five are certain of 48 % (.025 ** (1 / 5)); the sign test is 2 / 2**5; there is a range."""
    found = compared([2, 3, 4, 5, 6], [1, 2, 2, 3, 5])
    assert (found["probability_low"], found["probability_high"]) == (pytest.approx(0.025 ** (1 / 5), abs=0.01), 1)
    assert found["sign_test"] == pytest.approx(2 / 2**5)
    assert (found["difference"], found["difference_least"], found["difference_most"]) == (1, 1, 2)
    assert math.isnan(found["difference_low"])


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
    assert found["difference"] == pytest.approx(1 / 3), "the median of 1/3, 1 and -1"


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


def test_what_is_a_share_by_its_meaning_is_one() -> None:
    """Its interval is of the mean and ends at 1 at most: here of 1, 1 and .9."""
    meanings = tomllib.loads((Path(table.__file__).with_name("quantities.toml")).read_text(encoding="utf-8"))
    named = {name for name, (_, meaning) in meanings.items() if meaning.startswith("share ")}
    assert {"success", "near", "within_2"} <= named <= table.shares()
    for quantity in sorted(named):
        (found,) = over(runs_of(1, 1, 0.9, quantity=quantity), ["method"]).to_dict("records")
        assert found["estimate"] == pytest.approx(2.9 / 3) and 0 < found["low"] < found["high"] <= 1, quantity
