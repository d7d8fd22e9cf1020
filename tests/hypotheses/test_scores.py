"""Spec F1, F2: scores and disagreement against values worked by hand."""

import numpy as np
import pytest

from hypogoal.hypotheses import scores
from hypogoal.hypotheses.scores import best_threshold, cross_fitted, halves, mean_disagreement, member_scores, ranking

YES, NO = True, False
LABELS = np.array([YES, YES, YES, YES, NO, NO])
VERDICTS = np.array(
    [
        # right, one miss, always yes, never
        [YES, YES, YES, NO],
        [YES, YES, YES, NO],
        [YES, YES, YES, NO],
        [YES, NO, YES, NO],
        [NO, NO, YES, NO],
        [NO, YES, YES, NO],
    ]
)


def test_scores_by_hand():
    """Spec F1: four members on six states; always-yes has the better F1 of one that sees something."""
    found = member_scores(VERDICTS, LABELS)
    assert set(found) == {"balanced_accuracy", "precision", "recall", "accuracy", "f1"}
    np.testing.assert_allclose(found["recall"], [1, 3 / 4, 1, 0])
    np.testing.assert_allclose(found["balanced_accuracy"], [1, (3 / 4 + 1 / 2) / 2, 1 / 2, 1 / 2])
    np.testing.assert_allclose(found["precision"], [1, 3 / 4, 4 / 6, np.nan])
    np.testing.assert_allclose(found["accuracy"], [1, 4 / 6, 4 / 6, 2 / 6])
    np.testing.assert_allclose(found["f1"], [1, 6 / 8, 8 / 10, 0])


def test_scores_without_a_class_are_not_numbers():
    """Spec F1: nothing is made up where a class is missing, and no warning is raised."""
    negatives = member_scores(VERDICTS[4:], LABELS[4:])
    assert np.isnan(negatives["balanced_accuracy"]).all()
    assert np.isnan(negatives["recall"]).all()
    np.testing.assert_allclose(negatives["accuracy"], [1, 1 / 2, 0, 1])
    nothing = member_scores(VERDICTS[:0], LABELS[:0])
    assert all(np.isnan(values).all() and values.shape == (4,) for values in nothing.values())


def test_best_mean_and_worst_member():
    """Spec F1: the paper shows only the best; members without a score are left out."""
    assert scores.best_mean_worst(np.array([0.5, np.nan, 0.9, 0.7])) == pytest.approx(
        {"best": 0.9, "mean": 0.7, "worst": 0.5}
    )
    assert np.isnan(scores.best_mean_worst(np.array([np.nan]))["best"])


def test_disagreement_by_hand():
    """Spec F2: shares of states on which two members differ."""
    assert mean_disagreement(VERDICTS[:, [0, 3]]) == pytest.approx(4 / 6)
    assert mean_disagreement(VERDICTS) == pytest.approx((2 + 2 + 4 + 2 + 4 + 6) / 6 / 6)
    assert np.isnan(mean_disagreement(VERDICTS[:, :1]))
    assert np.isnan(mean_disagreement(VERDICTS[:0]))


def test_the_most_and_the_least_preferred_member():
    """Spec F6: of those that were offered; nobody where none was."""
    assert scores.most_and_least(np.array([1.0, 2.0])) == (1, 0)
    assert scores.most_and_least(np.array([np.nan, 3.0])) == (1, 1)
    assert scores.most_and_least(np.array([np.nan])) == (None, None)


def test_ranking_is_the_share_of_pairs_in_order():
    """Spec F1: worked by hand: 2 positives, 3 negatives; ties count half; no threshold matters."""
    labels = np.array([True, True, False, False, False])
    probabilities = np.array([[0.9, 0.1, 0.5], [0.8, 0.4, 0.5], [0.7, 0.2, 0.5], [0.1, 0.3, 0.5], [0.2, 0.9, 0.5]])
    assert ranking(probabilities, labels).tolist() == pytest.approx([1, 2 / 6, 1 / 2])
    assert ranking(probabilities / 100, labels).tolist() == pytest.approx([1, 2 / 6, 1 / 2])
    assert np.isnan(ranking(probabilities[:2], labels[:2])).all()
    assert np.isnan(ranking(probabilities[:0], labels[:0])).all()


def test_the_best_threshold_is_that_of_a_search() -> None:
    """Over every threshold, ties among them: its balanced accuracy is the highest, and its verdicts have it."""
    rng = np.random.default_rng(0)
    for _ in range(50):
        labels = rng.random(12) < 0.4
        labels[:2] = YES, NO
        probabilities = rng.integers(0, 6, (12, 3)).astype(np.float32) / 5
        thresholds, accuracy = best_threshold(probabilities, labels)
        np.testing.assert_allclose(member_scores(probabilities > thresholds, labels)["balanced_accuracy"], accuracy)
        every = [member_scores(probabilities > at, labels)["balanced_accuracy"] for at in np.arange(-0.1, 1.1, 0.1)]
        np.testing.assert_allclose(accuracy, np.max(every, axis=0))
    assert np.isnan(best_threshold(probabilities, labels & False)[1]).all()


def test_cross_fitted_by_hand() -> None:
    """Member 1 is best on the first half and scored on the second, member 0 the other way round."""
    first, second = np.array([0.6, 0.9, np.nan]), np.array([0.8, 0.7, 0.9])
    assert cross_fitted(first, second) == pytest.approx((0.7 + 0.6) / 2)
    assert np.isnan(cross_fitted(first, second * np.nan))


def test_halves_are_of_contexts() -> None:
    """Every other layout; none of one alone."""
    contexts = np.array([7, 3, 3, 9, 7, 12])
    assert halves(contexts).tolist() == [False, True, True, True, False, False]
    assert halves(contexts[1:3]) is None
