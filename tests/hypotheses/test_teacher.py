"""Members that a teacher, own code, tells what to predict in unlabelled states (teacher=module:function)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from breaking import Breaking, Broken
from numpy.typing import NDArray
from test_training import TOY, follows, toy

from hypogoal.core.checkpoints import Checkpoints
from hypogoal.core.errors import UserError
from hypogoal.hypotheses.config import EnsembleConfig
from hypogoal.hypotheses.training import Round, fit

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


def too_few(*_: object) -> list[float]:
    return [0.0]


def not_finite(observations: object, labels: object, unlabelled: NDArray[np.uint8], *_: object) -> NDArray[np.float64]:
    return np.full((2, len(unlabelled)), np.nan)


@pytest.fixture(autouse=True)
def trusted(monkeypatch: pytest.MonkeyPatch) -> None:
    calls.clear()
    monkeypatch.setenv("HYPOGOAL_TRUST", "1")


def test_each_member_learns_what_it_is_taught() -> None:
    """With nothing else to make them differ; without a teacher both take the easy feature."""
    easy, hard = follows(fit(*toy(), CONFIG, seed=1))
    assert easy[0] > 0.9 and hard[1] > 0.9
    easy, hard = follows(fit(*toy(), CONFIG.model_copy(update={"teacher": ""}), seed=1))
    assert (easy > 0.9).all()
    ((shape, labels, elsewhere, members, _),) = calls
    assert (shape, labels, elsewhere, members) == ((64, 48, 48, 3), toy()[1].tolist(), (128, 48, 48, 3), 2)


def test_teaching_weighs_in_proportion_to_the_scores() -> None:
    """A member's loss grows by the mean of w * cross entropy, w = |score| up to 1."""
    observations, labels, unlabelled = toy()
    seen: list[torch.Tensor] = []
    made = Round._losses

    def recorded(self: Round, *batch: NDArray[np.int64]) -> tuple[torch.Tensor, torch.Tensor]:
        assert self.taught is not None
        with_teacher, _ = made(self, *batch)
        taught, self.taught = self.taught, torch.zeros_like(self.taught)
        without, _ = made(self, *batch)
        self.taught = taught
        scores = taught[:, batch[1] - self.states.n_labelled]
        for member, logits in enumerate(self.states.forward(self.networks, *batch, counted=(True, True))[1]):
            right = torch.where(scores[member] > 0, logits[:, 1], logits[:, 0]) - logits.logsumexp(1)
            seen.append(with_teacher[member] - without[member] + (right * scores[member].abs().clamp(max=1)).mean())
        return made(self, *batch)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Round, "_losses", recorded)
        fit(observations, labels, unlabelled, CONFIG.model_copy(update={"steps": 1, "batch_size": 32}), 0)
    assert len(seen) == 2
    assert torch.stack(seen).abs().max() < 1e-4


@pytest.mark.parametrize("schedule", ["simultaneous", "sequential"])
def test_a_broken_training_is_resumed_to_the_last_bit(tmp_path: Path, schedule: str) -> None:
    """Spec G1: and the teacher is not asked again."""
    config = CONFIG.model_copy(update={"steps": 4, "schedule": schedule})

    def trained(checkpoints: Checkpoints | None) -> dict[str, torch.Tensor]:
        return fit(*toy(), config, 0, checkpoints=checkpoints).state()

    unbroken = trained(None)
    calls.clear()
    for last in (3, 2):
        with pytest.raises(Broken):
            trained(Breaking(tmp_path / "ensemble.safetensors", last))
    resumed = trained(Checkpoints(tmp_path / "ensemble.safetensors"))
    assert len(calls) == 1
    assert all(torch.equal(resumed[name], value) for name, value in unbroken.items())


@pytest.mark.parametrize(
    ("teacher", "message"),
    [
        ("too_few", r"the teacher gave scores \(1,\): test_teacher:too_few\. Give finite ones, \(2, 128\)"),
        ("not_finite", r"gave scores \(2, 128\): .*Give finite ones"),
    ],
)
def test_scores_that_do_not_fit_are_refused(teacher: str, message: str) -> None:
    """Spec G2: in one line, with the place in the user's file."""
    with pytest.raises(UserError, match=message):
        fit(*toy(), CONFIG.model_copy(update={"teacher": f"test_teacher:{teacher}"}), 0)


def test_what_is_no_teacher_is_refused() -> None:
    """Spec G2: and so is one with nothing to teach."""
    with pytest.raises(UserError, match=r"unknown teacher: nobody\. Give module:object"):
        fit(*toy(), EnsembleConfig(teacher="nobody"), 0)
    observations, labels, unlabelled = toy()
    with pytest.raises(UserError, match="unlabelled states are needed"):
        fit(observations, labels, unlabelled[:0], CONFIG, 0)
