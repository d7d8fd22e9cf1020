"""Spec G1: ensembles trained with a break are those trained without, whatever is trained and changed on the way."""

from pathlib import Path

import pytest
import torch
from breaking import Breaking, Broken
from test_training import assert_same, toy

from hypogoal.core.checkpoints import Checkpoints
from hypogoal.core.drafts import Draft
from hypogoal.hypotheses.config import EnsembleConfig
from hypogoal.hypotheses.training import EnsembleTraining
from hypogoal.stages.train_ensemble import train_ensemble

OWN = EnsembleConfig(members=2, steps=12, batch_size=16, diversity_weight=1e-2, view="own_view:Moved")
TAUGHT = OWN.model_copy(update={"view": "full", "steps": 4, "teacher": "test_teacher:easy_and_hard"})
SEQUENTIAL = {"schedule": "sequential", "threshold": "unlabelled-split"}


def dropping(channels: int) -> tuple[list[torch.nn.Module], tuple[int, ...]]:
    """A network with a layer that draws random numbers itself."""
    return [torch.nn.Conv2d(channels, 4, 5, stride=4), torch.nn.ReLU(), torch.nn.Dropout()], (8,)


@pytest.mark.parametrize(
    "config",
    [
        OWN,
        OWN.model_copy(update=SEQUENTIAL),
        OWN.model_copy(update={"view": "full", "network": "test_broken_training:dropping"}),
        TAUGHT,
        TAUGHT.model_copy(update=SEQUENTIAL),
    ],
    ids=["own view", "sequential, thresholds", "dropout", "teacher", "teacher, sequential"],
)
def test_breaks_leave_no_trace(config: EnsembleConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Spec G1: weights, BatchNorm, view and thresholds, losses; a finished one is not trained again.

    Whoever drew from the global generator before; a teacher is not asked again.
    """
    monkeypatch.setenv("HYPOGOAL_TRUST", "1")
    unbroken = EnsembleTraining(*toy(), config, 0)
    expected = {step: losses.numbers() for step, losses in unbroken.steps()}
    torch.rand(7)
    checkpoints = Checkpoints(tmp_path / "ensemble.safetensors")
    total = len(expected)
    for last in (total // 4, total // 2 + 1, total):
        training = EnsembleTraining(*toy(), config, 0, saved=checkpoints.load())
        for step, losses in training.steps():
            assert losses.numbers() == expected[step]
            if step == last:
                checkpoints.save(training.snapshot())
                break
    finished = EnsembleTraining(*toy(), config, 0, saved=checkpoints.load())
    assert list(finished.steps()) == []
    assert_same(finished.ensemble.state_dict(), unbroken.ensemble.state_dict())


def test_a_broken_stage_ends_with_the_same_log(tiny_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Spec G1: what was logged after the last checkpoint is logged once."""
    few = {"steps": 32, "members": 2, "workers": 1, "sub_goals": ("open-red-door",)}

    def train(name: str, *, resume: bool = False) -> None:
        train_ensemble(tiny_run / "data.h5", tmp_path / name, seed=3, resume=resume, quiet=True, **few)

    train("unbroken")
    for last in (22, 8):
        with monkeypatch.context() as patch:

            def breaking(draft: Draft, name: str = "stage", last: int = last) -> Breaking:
                return Breaking(draft.checkpoint / f"{name}.safetensors", last)

            patch.setattr(Draft, "checkpoints", breaking)
            with pytest.raises(Broken):
                train("out", resume=last == 8)
    train("out", resume=True)
    for name in ("metrics.jsonl", "open-red-door.safetensors"):
        assert (tmp_path / "out" / name).read_bytes() == (tmp_path / "unbroken" / name).read_bytes()
