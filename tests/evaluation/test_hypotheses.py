"""What members know of held-out states, wherever their thresholds lie, and which features they have found (F1, H1)."""

from itertools import product
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
import toy_data
from made_up import asked, results_of, row

from hypogoal.evaluation import hypotheses
from hypogoal.evaluation.hypotheses import coverage, knowledge
from hypogoal.evaluation.judging import Judged, judge
from hypogoal.hypotheses import ensemble
from hypogoal.hypotheses.scores import best_threshold, member_scores, ranking

RNG = np.random.default_rng(0)
LABELS = RNG.random(60) < 0.3
PROBABILITIES = np.clip(RNG.random((60, 3)) + np.array([0.5, 0.1, -0.2]) * LABELS[:, None], 0, 1).astype(np.float32)
CONTEXTS = np.repeat(np.arange(6), 10)
EVERY = np.ones(60, dtype=np.bool_)
HALF = np.full(3, 0.5, np.float32)
JUDGED = Judged(LABELS, {}, PROBABILITIES, PROBABILITIES > 0.5, PROBABILITIES[:0] > 0.5, HALF)


def test_members_numbers_are_their_scores() -> None:
    """The best threshold, and what the own one loses."""
    found, _ = knowledge(JUDGED, EVERY, CONTEXTS)
    accuracy = member_scores(JUDGED.predictions, LABELS)["balanced_accuracy"]
    best = best_threshold(PROBABILITIES, LABELS)[1]
    assert found["at_best_threshold"].tolist() == best.tolist()
    assert found["calibration_gap"].tolist() == (best - accuracy).tolist()
    assert min(found["calibration_gap"]) >= 0


def test_the_best_is_picked_where_it_is_not_scored() -> None:
    """By hand: the member that is best on contexts 0, 2, 4 on the others, and the other way round."""
    first = CONTEXTS % 2 == 0
    ranked = [ranking(PROBABILITIES[half], LABELS[half]) for half in (first, ~first)]
    expected = (ranked[1][ranked[0].argmax()] + ranked[0][ranked[1].argmax()]) / 2
    _, found = knowledge(JUDGED, EVERY, CONTEXTS)
    assert found["cross_fitted_ranking"] == pytest.approx(expected)
    for contexts in (None, CONTEXTS * 0):
        assert knowledge(JUDGED, EVERY, contexts)[1] == {}


CROSSED = np.array(list(product((0, 1), repeat=4)) * 20)  # (320, 4)
PLANTED = dict(zip("abcd", CROSSED.T, strict=True))
SURE = np.where(CROSSED, 0.9, 0.1).astype(np.float32)  # a member for each feature


@pytest.mark.parametrize(
    ("members", "covered"),
    [
        (SURE, 1.0),
        (np.repeat(SURE[:, [2]], 6, axis=1), 0.25),
        (np.full((320, 4), 0.3, np.float32), 0.0),
        (RNG.random((320, 4)).astype(np.float32), 0.0),
        ((SURE[:, :1] > 0.5) & (SURE[:, 1:2] > 0.5), 0.0),
        (0.6 * SURE[:, :1] + 0.2 * SURE[:, 1:2], 0.0),
        (0.6 * SURE[:, :1] - 0.2 * SURE[:, 1:2], 0.0),
    ],
    ids=["one each", "copies of one", "constant", "guesses", "two at once", "a hint of another", "a hint against"],
)
def test_coverage_of_members_whose_knowledge_is_known(members: np.ndarray, covered: float) -> None:
    """Spec H1: a member owns a feature if it ranks by it and by no other, neither way round."""
    assert coverage(members.astype(np.float32), PLANTED) == covered


def test_coverage_of_features_that_exclude_each_other_is_not_told() -> None:
    """Who ranks by one ranks by the other, too, the wrong way round."""
    apart = CROSSED[:, 0] != CROSSED[:, 1]
    planted = {"a": CROSSED[apart, 0], "b": CROSSED[apart, 1]}
    assert np.isnan(coverage(SURE[apart, :2], planted))


def accuracies(method: str, seed: int, **by_goal: list[float]) -> list[dict]:
    """Rows of an ensemble's members."""
    rows = []
    for sub_goal, values in by_goal.items():
        place = {"method": method, "seed": seed, "artefact": f"{method}-{seed}", "sub_goal": sub_goal}
        for member, value in enumerate(values):
            rows.append(row("balanced_accuracy", value, member=member, scope="heldout", **place))
    return rows


def test_best_mean_and_worst_member_over_seeds() -> None:
    """And the first method against the second, by seed and sub-goal."""
    rows = accuracies("D-BAT, 2 members", 0, red=[0.8, 0.6]) + accuracies("D-BAT, 2 members", 1, red=[0.9, 0.5])
    results = results_of(*rows, *accuracies("one classifier", 1, red=[0.7]))
    context = asked(hypotheses, results)
    table = context["table"].set_index(["method", "quantity"])["mean"]
    found = [table["D-BAT, 2 members", which] for which in ("best", "mean", "worst")]
    assert found == pytest.approx([0.85, 0.7, 0.55])
    best = context["pairs"].set_index("quantity").loc["best"]
    assert (best["n"], best["difference"]) == (1, pytest.approx(0.2))
    assert asked(hypotheses, results_of()) is None


def test_every_state_is_judged_by_the_members_own_threshold(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Held-out and unlabelled ones alike: .7 is above .6, and not above .8; .4 is above .3."""
    says, thresholds = np.array([0.7, 0.7, 0.4], np.float32), torch.tensor([0.6, 0.8, 0.3])
    members = SimpleNamespace(thresholds=thresholds, predict=lambda states: np.tile(says, (len(states), 1)))
    monkeypatch.setattr(ensemble, "read_ensemble", lambda *_: members)
    monkeypatch.setattr(ensemble, "together", lambda _: None)
    artefact: Any = SimpleNamespace(path=tmp_path, config={"sub_goals": ["one"]})
    judged = judge(artefact, toy_data.write(tmp_path / "data.h5", states=2))["one"]
    assert judged.predictions.tolist() == judged.unlabelled.tolist() == [[True, False, True]] * 2
