"""Spec F1, F2: Figure 3's numbers against values worked by hand: unseen rooms, validation."""

import numpy as np
import pandas as pd
import pytest
from made_up import asked, figures, results_of, row, shown

from hypogoal.evaluation import rooms
from hypogoal.evaluation.hypotheses import VALIDATED, choose, rows_of
from hypogoal.evaluation.judging import Judged

YES, NO = True, False
# Rooms 1 (labelled), 9 (unlabelled), 6 (unseen): two positives and two negatives each; 20 (unseen): two negatives.
ROOMS = np.array([1, 1, 1, 1, 9, 9, 9, 9, 6, 6, 6, 6, 20, 20])
SEEN = np.array([2, 2, 2, 2, 1, 1, 1, 1, 0, 0, 0, 0, 0, 0])
LABELS = np.array([YES, YES, NO, NO] * 3 + [NO, NO])
VERDICTS = np.array(
    [
        # knows room 1 by heart; knows bases; says yes to all
        *([YES, YES, YES], [YES, YES, YES], [NO, NO, YES], [NO, YES, YES]),  # room 1
        *([NO, YES, YES], [NO, YES, YES], [NO, NO, YES], [NO, NO, YES]),  # room 9
        *([NO, YES, YES], [NO, YES, YES], [NO, NO, YES], [YES, YES, YES]),  # room 6
        *([NO, NO, YES], [YES, NO, YES]),  # room 20
    ]
)


def judged() -> pd.DataFrame:
    """The rows of these members."""
    origins, thresholds = {"room": ROOMS, "seen": SEEN}, np.full(3, 0.5, np.float32)
    return pd.concat(rows_of(Judged(LABELS, origins, VERDICTS.astype(np.float32), VERDICTS, VERDICTS[:0], thresholds)))


@pytest.mark.parametrize(
    ("scope", "quantity", "values"),
    [
        ("unseen", "states", [6]),
        ("unseen", "positives", [2]),
        ("unseen", "rooms", [2]),
        ("all", "states", [14]),
        ("all", "rooms", [4]),
        ("labelled", "states", [4]),
        ("labelled", "balanced_accuracy", [1, (1 + 1 / 2) / 2, 1 / 2]),
        ("unseen", "balanced_accuracy", [(0 + 2 / 4) / 2, (1 + 3 / 4) / 2, 1 / 2]),
        ("unseen", "accuracy", [2 / 6, 5 / 6, 2 / 6]),
        ("unseen", "precision", [0, 2 / 3, 2 / 6]),
        ("all", "recall", [2 / 6, 1, 1]),
        ("all", "accuracy", [8 / 14, 12 / 14, 6 / 14]),
    ],
)
def test_each_scope_by_hand(scope: str, quantity: str, values: list[float]) -> None:
    """The member that knows the training room by heart is the best where that room counts least."""
    rows = judged()
    found = rows[(rows["scope"] == scope) & (rows["quantity"] == quantity)]["value"]
    assert found.tolist() == pytest.approx(values)


def test_the_validated_member_is_the_best_in_labelled_rooms() -> None:
    """The first of several; none where labelled rooms lack a class."""
    assert choose(VERDICTS, LABELS, SEEN) == {VALIDATED: 0, "validation": 1}
    assert choose(VERDICTS[:, [1, 0, 0]], LABELS, SEEN)[VALIDATED] == 1
    nothing = choose(VERDICTS, LABELS & False, SEEN)
    assert nothing == {VALIDATED: None, "validation": None}


def ensemble(method: str, groups: int, seed: int, *accuracies: float, validated: int = 0) -> list[dict]:
    """Rows of an ensemble's members on unseen rooms."""
    place = {"method": method, "N": groups, "seed": seed, "artefact": f"{method}-{groups}-{seed}", "sub_goal": "down"}
    rows = [row("validated_member", validated, scope="labelled", **place)]
    for scope in ("unseen", "all"):
        rows += [row("states", 8, scope=scope, **place), row("positives", 2, scope=scope, **place)]
        for member, value in enumerate(accuracies):
            for quantity in ("balanced_accuracy", "accuracy"):
                rows.append(row(quantity, value, member=member, scope=scope, **place))
    return rows


def test_a_row_for_each_method_and_n_over_seeds() -> None:
    """Best, validated, mean and worst; the paper's method first, N within it; pairs at each N."""
    rows = ensemble("D-BAT, 2 members", 1, 0, 0.9, 0.5, validated=1) + ensemble("D-BAT, 2 members", 1, 1, 0.7, 0.5)
    rows += ensemble("D-BAT, 2 members", 2, 0, 0.8, 0.6) + ensemble("one classifier", 1, 0, 0.6)
    results = results_of(*rows)
    context = asked(rooms, results)
    table = context["table"].set_index(["method", "N", "quantity"])["mean"]
    own = ("D-BAT, 2 members", 1)
    means = [table[*own, f"balanced_accuracy, unseen, {which}"] for which in ("best", "validated", "mean", "worst")]
    assert means == pytest.approx([0.8, 0.6, 0.65, 0.5])
    order = [("D-BAT, 2 members", 1), ("D-BAT, 2 members", 2), ("one classifier", 1)]
    assert shown(rooms, results).index.tolist() == order
    assert table["one classifier", 1, "accuracy, all, never positive"] == 0.75
    pairs = context["pairs"]
    assert pairs["N"].tolist() == [1, 1, 1] and pairs["difference"].tolist() == pytest.approx([0.3, -0.1, 0.1])
    (drawn,) = figures(rooms, results)
    (legend,) = drawn.figure.legends
    named = [text.get_text() for text in legend.get_texts()]
    assert drawn.name == "figure3" and named == ["D-BAT, 2 members", "one classifier"]
    assert asked(rooms, results_of()) is None
