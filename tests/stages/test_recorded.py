"""What recorded states say about a classifier, on cases worked by hand (Spec I6)."""

from __future__ import annotations

import numpy as np
import pytest

from hypogoal.evaluation.page import lines_of
from hypogoal.hypotheses.labelling import density_of, disagreement, sketches_of, to_label
from hypogoal.observations import packed
from hypogoal.tools.audit_recorded import member_table


def test_members_disagree_about_their_own_thresholds() -> None:
    """0 where both say the same, 1 where they are sure of opposites; of one member its own prediction."""
    both = np.array([[0.5, 0.9], [1.0, 0.0], [0.999, 0.9999]])
    found = disagreement(both, np.array([0.5, 0.9]))
    np.testing.assert_allclose(found[:2], [0.0, 1.0], atol=1e-6)
    assert found[2] < 0.01
    np.testing.assert_allclose(
        disagreement(np.array([[0.9], [1.0], [0.0]]), np.array([0.9])), [0.5, 1.0, 0.0], atol=1e-6
    )
    pairs = disagreement(np.array([[0.0, 0.0, 1.0]]), np.full(3, 0.5))
    np.testing.assert_allclose(pairs, [2 / 3], atol=1e-6)  # two of three pairs


def test_states_to_label_are_disputed_common_and_unlike_each_other() -> None:
    """Two crowds that are disputed get one each before either gets a second; a stray state comes after, others last."""
    rng = np.random.default_rng(0)
    crowds = [rng.normal(place, 0.1, (20, 2)) for place in ((0, 0), (5, 0), (0, 5))]
    sketches = np.concatenate([*crowds, [[40.0, 40.0]]])
    scores = np.repeat([0.9, 0.0, 0.8, 0.95], [20, 20, 20, 1])
    rows = to_label(scores * density_of(sketches), sketches, 4)
    assert sorted(row // 20 for row in rows[:2].tolist()) == [0, 2]
    assert 60 not in rows.tolist(), "whatever its score, nothing else is like it"
    assert len({*rows.tolist()}) == 4 and all(scores[rows] > 0)
    np.testing.assert_array_equal(to_label(np.ones(3), sketches[:3], 9).shape, (3,))
    np.testing.assert_array_equal(to_label(np.ones(1), sketches[:1], 1), [0])


def test_members_are_told_apart_by_what_they_alone_call_positive() -> None:
    labels = np.array([True, False, False, True, False])
    scores = np.array([[0.9, 0.9], [0.2, 0.6], [0.7, 0.1], [0.1, 0.1], [0.4, 0.4]])
    unlabelled = np.array([[0.9, 0.1], [0.9, 0.9], [0.1, 0.1]])
    table = member_table(labels, scores, unlabelled, np.array([0.5, 0.5]))
    assert table["negatives"].tolist() == [3, 3] and table["false_positives"].tolist() == [1, 1]
    assert table["highest_negative"].tolist() == [0.7, 0.6]
    assert table["positive_unlabelled"].tolist() == pytest.approx([2 / 3, 1 / 3])
    assert table["positive_alone"].tolist() == pytest.approx([1 / 3, 0])


def test_sketches_are_alike_where_states_are() -> None:
    """Pictures and numbers count alike, whatever their sizes and units."""
    rng = np.random.default_rng(0)
    kinds = np.arange(40) % 4
    cameras = rng.integers(0, 20, (40, 32, 32, 3), dtype=np.uint8)
    cameras[kinds % 2 == 1, :16] += 200
    numbers = rng.normal(0, 10, (40, 3)).astype(np.float32)
    numbers[kinds >= 2] += 1e4
    sketches = sketches_of(packed({"camera": cameras, "numbers": numbers}))
    distance = np.linalg.norm(sketches[:, None] - sketches[None], axis=2)
    np.fill_diagonal(distance, np.inf)
    np.testing.assert_array_equal(kinds[distance.argmin(1)], kinds)


def test_the_line_names_members_that_hold_all_states_for_the_same() -> None:
    """Of one classifier, which cannot disagree, the line says how many unlabelled states it predicts positive."""
    rows = [
        {"member": member, "negatives": 4, "false_positives": 0, "highest_negative": 0.1, "positive_unlabelled": share}
        for member, share in enumerate((1.0, 0.25, 0.0))
    ]
    part = {"sub_goal": "door", "unlabelled": 8, "disagreement": 1.0, "members": rows}
    several, alone = lines_of("audited.txt", parts=[part, part | {"members": rows[1:2]}])
    assert "100.0% of 8 unlabelled states (the same prediction for all of them: member 0, 2)" in several
    assert "the classifier predicts 25.0% of 8 unlabelled states positive" in alone and "disagree" not in alone
