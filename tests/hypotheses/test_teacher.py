"""Members that a teacher, own code, tells what to predict in unlabelled states (teacher=module:function)."""

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from test_training import TOY, follows, toy

from hypogoal.core.errors import UserError
from hypogoal.hypotheses.config import EnsembleConfig
from hypogoal.hypotheses.fit import taught_losses
from hypogoal.hypotheses.training import EnsembleTraining, train

CONFIG = TOY.model_copy(update={"diversity": "none", "teacher": "test_teacher:easy_and_hard"})
calls: list[tuple[object, ...]] = []


def easy_and_hard(
    observations: NDArray[np.uint8], labels: NDArray[np.bool_], unlabelled: NDArray[np.uint8], members: int, seed: int
) -> NDArray[np.float64]:
    """The toy's easy feature for the first member, less and less surely, its hard one for the second."""
    calls.append((observations.shape, labels.tolist(), unlabelled.shape, members, seed))
    state = np.arange(len(unlabelled))
    surely = np.linspace(2.0, 0.5, len(unlabelled))
    return np.stack([np.where(state % 2 == 0, surely, -surely), np.where(state % 4 < 2, 3.0, -3.0)])


def not_finite(observations: object, labels: object, unlabelled: NDArray[np.uint8], *_: object) -> NDArray[np.float64]:
    return np.full((2, len(unlabelled)), np.nan)


@pytest.fixture(autouse=True)
def trusted(monkeypatch: pytest.MonkeyPatch) -> None:
    calls.clear()
    monkeypatch.setenv("HYPOGOAL_TRUST", "1")


def test_each_member_learns_what_it_is_taught() -> None:
    """With nothing else to make them differ; without a teacher both take the easy feature."""
    easy, hard = follows(train(*toy(), CONFIG, seed=1))
    assert easy[0] > 0.9 and hard[1] > 0.9
    easy, hard = follows(train(*toy(), CONFIG.model_copy(update={"teacher": ""}), seed=1))
    assert (easy > 0.9).all()
    ((shape, labels, elsewhere, members, _),) = calls
    assert (shape, labels, elsewhere, members) == ((64, 48, 48, 3), toy()[1].tolist(), (128, 48, 48, 3), 2)


def test_teaching_weighs_in_proportion_to_the_scores() -> None:
    """By hand: w x cross entropy, w = |score| up to 1, mean over states."""
    probabilities = torch.tensor([[0.9, 0.2], [0.5, 0.5]], dtype=torch.float64)
    logits = torch.stack([(1 - probabilities).log(), probabilities.log()], dim=-1)
    losses = taught_losses(logits, torch.tensor([[3.0, -0.5], [0.25, 0.0]]))
    expected = [(-np.log(0.9) - 0.5 * np.log(0.8)) / 2, -0.25 * np.log(0.5) / 2]
    np.testing.assert_allclose(losses.numpy(), expected)


def test_a_teacher_is_one_more_term_of_the_loss() -> None:
    """It is asked once, and each member learns its own row."""
    steps = EnsembleTraining(*toy(), CONFIG.model_copy(update={"steps": 2}), 0).steps()
    for _, losses in steps:
        assert losses.loss > losses.labelled.sum() + 0.1
    assert len(calls) == 1


def test_scores_that_are_not_finite_are_refused() -> None:
    """Spec G2: in one line; other faults are found by the same look, see ``check/test_parts.py``."""
    fault = r"the teacher gave scores float64 \(2, 128\): test_teacher:not_finite\. Give finite ones, \(2, 128\)"
    with pytest.raises(UserError, match=fault):
        train(*toy(), CONFIG.model_copy(update={"teacher": "test_teacher:not_finite"}), 0)


def test_what_is_no_teacher_is_refused() -> None:
    """Spec G2: and so is one with nothing to teach."""
    with pytest.raises(UserError, match=r"unknown teacher: nobody\. Give module:object"):
        train(*toy(), EnsembleConfig(teacher="nobody"), 0)
    observations, labels, unlabelled = toy()
    with pytest.raises(UserError, match="unlabelled states are needed"):
        train(observations, labels, unlabelled[:0], CONFIG, 0)
