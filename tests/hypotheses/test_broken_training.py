"""Spec G1: ensembles trained with a break are those trained without, whatever is trained and changed on the way."""

from pathlib import Path

import pytest
import torch
from breaking import Breaking, Broken
from test_training import toy

from hypogoal.core.artefacts import Draft
from hypogoal.core.checkpoints import Checkpoints
from hypogoal.hypotheses.config import EnsembleConfig
from hypogoal.hypotheses.training import Watcher, fit
from hypogoal.stages.train_ensemble import train_ensemble

OWN = EnsembleConfig(members=2, steps=12, batch_size=16, diversity_weight=1e-2, view="own_view:Moved")


def dropping(channels: int) -> tuple[list[torch.nn.Module], tuple[int, ...]]:
    """A network with a layer that draws random numbers itself."""
    return [torch.nn.Conv2d(channels, 4, 5, stride=4), torch.nn.ReLU(), torch.nn.Dropout()], (8,)


@pytest.mark.parametrize(
    "config",
    [
        OWN,
        OWN.model_copy(update={"schedule": "sequential", "threshold": "unlabelled-split"}),
        OWN.model_copy(update={"view": "full", "network": "test_broken_training:dropping"}),
    ],
    ids=["own view", "sequential, thresholds", "dropout"],
)
def test_breaks_leave_no_trace(config: EnsembleConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Spec G1: weights, BatchNorm, view and thresholds, reports; a finished one is not trained again."""
    monkeypatch.setenv("HYPOGOAL_TRUST", "1")
    observations, labels, unlabelled = toy()

    def trained(checkpoints: Checkpoints | None) -> tuple[dict[str, torch.Tensor], list[tuple[int, dict[str, float]]]]:
        reports: list[tuple[int, dict[str, float]]] = []
        ensemble = fit(
            observations,
            labels,
            unlabelled,
            config,
            0,
            Watcher(lambda *report: reports.append(report)),
            checkpoints=checkpoints,
        )
        return ensemble.state(), reports

    unbroken, expected = trained(None)
    path = tmp_path / "ensemble.safetensors"
    for last in (5, 4, 4):
        with pytest.raises(Broken):
            trained(Breaking(path, last))
    resumed, reports = trained(Checkpoints(path))
    assert reports == expected[-len(reports) :] and reports
    again, nothing = trained(Checkpoints(path))
    assert nothing == []
    for state in (resumed, again):
        assert state.keys() == unbroken.keys()
        assert all(torch.equal(state[name], value) for name, value in unbroken.items())


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
