"""Spec F5: methods against each other pair by pair, against values worked by hand."""

import numpy as np
import pytest

from hypogoal.core.files import write_table
from hypogoal.evaluation import curves, distance, hypotheses, rooms
from hypogoal.evaluation.numbers import compare_pairs
from hypogoal.evaluation.page import comparison_tables
from hypogoal.evaluation.table import BEST, VALIDATED, Row, compared, read_rows, rows_of


def pairs(first, second, units=None, **more):
    first, second = np.array(first, dtype=float), np.array(second, dtype=float)
    return compare_pairs(first, second, units or range(len(first)), **more)


def test_probability_of_improvement_by_hand():
    """Spec F5: won, lost, tied, won: (1 + 0 + 1/2 + 1) / 4; of 3 that are no ties 2 won: p is 1."""
    found = pairs([3, 5, 2, 4], [1, 6, 2, 2])
    assert (found["n"], found["wins"], found["ties"]) == (4, 2, 1)
    assert (found["probability"], found["difference"], found["sign_test"]) == (0.625, 0.75, 1.0)
    assert pairs([3, 5, 2, 4], [1, 6, 2, 2], higher=False)["probability"] == 0.375
    assert found["interval"][0] < 0.625 < found["interval"][1]


def test_a_win_in_every_pair_is_not_certainty():
    """Spec F5: five of five: they do not vary, so the interval has no width; the sign test is 2 / 2**5."""
    found = pairs([2, 3, 4, 5, 6], [1, 2, 2, 3, 5])
    assert found["interval"] == [1, 1]
    assert found["sign_test"] == pytest.approx(2 / 2**5)
    assert found["difference"] == pytest.approx(7 / 5)


def test_means_that_differ_by_rounding_alone_are_ties():
    """The same three members in another order, the other method's are no better and no worse."""
    members = np.array([[0.1, 0.2, 0.3], [0.7, 0.8, 0.9], [0.4, 0.6, 0.7]])
    first, second = members.mean(axis=1), members[:, [2, 0, 1]].mean(axis=1)
    assert (first != second).any()
    for higher in (True, False):
        found = pairs(first, second, higher=higher)
        assert (found["wins"], found["ties"], found["probability"]) == (0, 3, 0.5)
        assert np.isnan(found["sign_test"])


def test_pairs_of_one_unit_are_one_piece_of_evidence():
    """Spec F5: one ensemble that wins on nine ladders has won once; two of three units won is no 6 of 9."""
    once = pairs([1] * 9, [0] * 9, [0] * 9)
    assert (once["n"], once["units"], once["wins"], once["sign_test"]) == (9, 1, 9, 1.0)
    assert np.isnan(once["interval"]).all()
    found = pairs([1, 1, 0, 1, 1, 1, 0, 0, 0], [0] * 2 + [1] + [0] * 3 + [1] * 3, [5, 5, 5, 6, 6, 6, 7, 7, 7])
    assert (found["units"], found["wins"], found["n"]) == (3, 5, 9)
    assert found["sign_test"] == 1.0  # two of three
    assert found["difference_interval"] == pytest.approx([1 / 9 - 2.5297, 1 / 9 + 2.5297], abs=1e-3)
    assert found["interval"] == [0, 1]  # a probability's is cut there
    assert pairs([3, 3], [1, 3], [0, 1])["sign_test"] == 1.0  # a unit that ties is left out


def test_pairs_without_a_number_are_left_out():
    """Spec F5: where a balanced accuracy is not defined; without any pair nothing is said."""
    found = pairs([np.nan, 1, 1], [0, np.nan, 0])
    assert (found["n"], found["probability"]) == (1, 1)
    nothing = pairs([], [])
    assert nothing["n"] == 0
    assert np.isnan([nothing["probability"], nothing["difference"], nothing["sign_test"], *nothing["interval"]]).all()
    assert np.isnan(pairs([1, 2], [1, 2])["sign_test"])


def agent(name, *runs):
    """Rows of runs, each (layout, seed, length)."""
    for number, (layout, seed, length) in enumerate(runs):
        numbers = {"success": 1.0, "length": length, "near": float(length <= 15)}
        place = {"layout": layout, "seed": seed, "artefact": f"{name}-{number}"}
        yield from rows_of(numbers, method=name, **place)


def test_agents_are_paired_by_layout_and_seed():
    """Spec F5: runs without a partner count nothing; a shorter episode is the better one."""
    own = list(agent("options", (100, 0, 12), (100, 1, 14), (101, 0, 20), (102, 0, 5)))
    other = list(agent("random", (101, 0, 30), (100, 0, 24), (100, 1, 13)))
    alone = list(agent("elsewhere", (500, 0, 1)))
    rows = compared([*own, *other, *alone], curves.PAIRS)
    assert [(row["first"], row["second"], row["quantity"]) for row in rows] == [
        ("options", "random", quantity) for quantity in ("success", "length", "near")
    ]
    success, length, near = rows
    assert (success["ties"], success["probability"]) == (3, 0.5)
    assert (length["n"], length["wins"]) == (3, 2)
    assert (near["n"], near["wins"], near["ties"]) == (3, 1, 2)
    assert length["units"] == 2
    assert length["difference"] == pytest.approx(((-12 + 1) / 2 - 10) / 2)  # each layout once
    assert compared([], curves.PAIRS) == compared(own, curves.PAIRS) == []
    unknown = [row._replace(value=np.nan) if row.quantity == "near" else row for row in (*own, *other)]
    assert [row["n"] for row in compared(unknown, curves.PAIRS)] == [3, 3, 0]


def members(values, quantity, **place):
    """A row per member."""
    return [Row(quantity, value, member=member, **place) for member, value in enumerate(values)]


def ensemble(name, seed, **best):
    place = {"method": name, "seed": seed, "artefact": f"{name}-{seed}", "scope": "heldout"}
    goals = best.items()
    return [row for goal, value in goals for row in members([value], "balanced_accuracy", **place, sub_goal=goal)]


def test_ensembles_are_paired_by_seed_and_sub_goal():
    """Spec F1: D-BAT first, whatever comes first on disk; over all sub-goals."""
    ensembles = [
        *ensemble("no diversity, K=2", 0, red=0.6, door=0.9),
        *ensemble("no diversity, K=2", 1, red=0.7, door=0.9),
        *ensemble("dbat, K=2", 0, red=0.8, door=0.8),
        *ensemble("dbat, K=2", 1, red=0.9, door=1.0),
    ]
    rows = compared(ensembles, hypotheses.PAIRS)
    (best,) = (row for row in rows if "best" in row["quantity"])
    assert (best["first"], best["where"], best["units"]) == ("dbat, K=2", "", 2)
    assert (best["n"], best["wins"]) == (4, 3)
    assert best["difference"] == pytest.approx((0.2 + 0.2 - 0.1 + 0.1) / 4)


def judged(method, groups, seed, best):
    place = {"method": method, "N": groups, "seed": seed, "artefact": f"{method}-{groups}-{seed}", "sub_goal": "down"}
    return members([best], "balanced_accuracy", **place, scope="unseen")


def test_methods_on_ladders_are_paired_at_each_number_of_groups():
    """Spec F1: N=1 with N=1; where nothing could be validated there is no pair."""
    bests = {"none": 0.5, "dbat": 0.6}
    ensembles = [row for method in bests for groups in (1, 2) for row in judged(method, groups, 0, bests[method])]
    rows = compared(ensembles, rooms.PAIRS)
    found = {(row["where"], row["quantity"].split(", ")[1]): row for row in rows}
    assert found["N=2", "best member"]["difference"] == pytest.approx(0.1)
    assert found["N=1", "best member"]["n"] == 1
    assert found["N=1", "validated member"]["n"] == 0


def stopped(method, ladder, seed, *distances, validated=None):
    place = {"method": method, "N": None if method.startswith("oracle") else 2, "ladder": ladder, "seed": seed}
    place |= {"sub_goal": "down", "artefact": f"{method}-{ladder}-{seed}"}
    return [*members(distances, "distance", **place), *rows_of({BEST: 0, VALIDATED: validated}, **place)]


def test_options_are_paired_by_ladder_and_seed():
    """Spec F3: the nearer is the better; oracle terminations are not a method."""
    options = (
        [
            *stopped("none", "1L", 0, 40), *stopped("none", "1R", 0, 10), *stopped("dbat", "1L", 0, 10),
            *stopped("dbat", "1R", 0, 20), *stopped("oracle termination", "1L", 0, 0),
        ]
    )  # fmt: skip
    rows = compared(options, distance.PAIRS)
    row, _, mean = rows
    assert (row["first"], row["second"], row["wins"], row["n"], row["where"]) == ("dbat", "none", 1, 2, "N=2")
    assert (row["units"], row["difference"]) == (1, -10)
    assert (mean["quantity"], mean["difference"]) == ("distance, mean member", -10)


def test_the_mean_member_does_not_gain_by_being_one_of_many():
    """Spec F3: of many alike the nearest is near; their mean is not."""
    many, one = stopped("dbat", "1L", 0, 10, 50, 90, float("nan")), stopped("single CNN", "1L", 0, 50)
    found = {row["quantity"]: row["difference"] for row in compared([*many, *one], distance.PAIRS)}
    assert found["distance, best member"] == -40
    assert found["distance, mean member"] == 0
    assert np.isnan(found["distance, validated member"])


def test_a_member_that_was_never_executed_has_no_distance():
    """Spec F3, F7: runs with such a member are compared by the others."""
    many = stopped("dbat", "1L", 0, 10, float("nan"), validated=0)
    rows = [*many, *stopped("single CNN", "1L", 0, 50, validated=0)]
    found = {row["quantity"]: row["difference"] for row in compared(rows, distance.PAIRS)}
    assert found == dict.fromkeys((f"distance, {which} member" for which in ("best", "validated", "mean")), -40)


def test_what_is_alike_in_all_counts_each_for_itself():
    """Spec F5: options of three ensembles, all with the same seed: three pairs, not the last one read."""
    runs = agent("a", *((5, 0, length) for length in (10, 20, 30)))
    others = agent("b", *((5, 0, length) for length in (11, 22, 33)))
    rows = compared([*runs, *others], curves.PAIRS)
    length = next(row for row in rows if row["quantity"] == "length")
    assert (length["n"], length["wins"], length["units"]) == (3, 3, 3)
    assert length["difference"] == pytest.approx(-2)


def test_the_table_says_each_method_once():
    """Spec F7: with digits and signs; where nothing is told apart by N or sub-goal that column is not there."""
    rows = compared([*agent("a", (1, 0, 10)), *agent("b", (1, 0, 12)), *agent("c", (1, 0, 12))], curves.PAIRS)
    rows = [{**row, "interval": [None, None], "difference_interval": [None, None]} for row in rows]
    (table,) = comparison_tables(rows, "seed", "layouts", {"length": 0})
    assert [column["name"] for column in table["columns"]][:2] == ["quantity", "second"]
    assert table["heading"] == "Seed by seed: a against the others"
    length = [line["cells"] for line in table["rows"]][2:4]
    assert length[0][:2] == ["length (lower is better)", "b"]
    assert length[1][:2] == ["", "c"]
    assert length[0][2]["text"] == "1.00" and length[0][3] == "1–0–0" and length[0][5]["text"] == "-2.0"
    (told,) = comparison_tables([*rows, {**rows[0], "first": "b", "where": "N=1"}], "seed", "layouts")
    assert [column["name"] for column in told["columns"]][:4] == ["quantity", "of", "first", "second"]
    assert comparison_tables([], "seed", "layouts") == []


def test_names_that_look_like_formulas_are_read_as_they_were(tmp_path):
    """Spec A5: as any other name."""
    rows = [Row("success", 1.0, method="=1+1, steps=-2", seed=-3), Row("success", 0.5, method="it's; @x", layout=7)]
    write_table(tmp_path / "numbers.csv", Row._fields, rows)
    assert read_rows(tmp_path / "numbers.csv") == rows
