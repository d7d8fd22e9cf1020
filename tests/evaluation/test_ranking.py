"""What members know wherever their thresholds lie, against the scores it is made of."""

import math

import numpy as np
import pytest

from hypogoal.evaluation import ranking as question
from hypogoal.hypotheses.scores import best_threshold, member_scores, ranking

RNG = np.random.default_rng(0)
LABELS = RNG.random(60) < 0.3
PROBABILITIES = np.clip(RNG.random((60, 3)) + np.array([0.5, 0.1, -0.2]) * LABELS[:, None], 0, 1).astype(np.float32)
CONTEXTS = np.repeat(np.arange(6), 10)
VERDICTS = PROBABILITIES > 0.5


def test_members_rows_are_their_scores() -> None:
    """Ranking, the best threshold, and what the own one loses."""
    found, _ = question.knowledge(PROBABILITIES, VERDICTS, LABELS, CONTEXTS)
    accuracy = member_scores(VERDICTS, LABELS)["balanced_accuracy"]
    best = best_threshold(PROBABILITIES, LABELS)[1]
    assert found["ranking"].tolist() == ranking(PROBABILITIES, LABELS).tolist()
    assert found["at_best_threshold"].tolist() == best.tolist()
    assert found["calibration_gap"].tolist() == (best - accuracy).tolist()
    assert min(found["calibration_gap"]) >= 0


def test_the_best_is_picked_where_it_is_not_scored() -> None:
    """By hand: the member that is best on contexts 0, 2, 4 on the others, and the other way round."""
    first = CONTEXTS % 2 == 0
    ranked = [ranking(PROBABILITIES[half], LABELS[half]) for half in (first, ~first)]
    expected = (ranked[1][ranked[0].argmax()] + ranked[0][ranked[1].argmax()]) / 2
    _, found = question.knowledge(PROBABILITIES, VERDICTS, LABELS, CONTEXTS)
    assert found["cross_fitted_ranking"] == pytest.approx(expected)
    for contexts in (None, CONTEXTS * 0):
        assert math.isnan(question.knowledge(PROBABILITIES, VERDICTS, LABELS, contexts)[1]["cross_fitted_ranking"])
