"""Spec G5: every training stage on another device than the CPU leaves the same files."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from far_device import FAR, far_device

from hypogoal.core.artefacts import open_artefact
from hypogoal.core.errors import UserError
from hypogoal.core.tensors import load_tensors
from hypogoal.stages.train_baseline import train_baseline
from hypogoal.stages.train_ensemble import train_ensemble
from hypogoal.stages.train_meta import train_meta

FEW = {"max_episode_steps": 30}
SHORT = FEW | {"steps": 192, "option_timeout": 7, "warm_up": 32, "replay": 200}
ENSEMBLE = {"steps": 3, "members": 2, "workers": 1, "sub_goals": ("open-red-door",)}
CASES: dict[str, tuple[Callable[..., Any], str, dict[str, Any]]] = {
    "train-ensemble": (train_ensemble, "data.h5", ENSEMBLE),
    "train-meta": (train_meta, "ensemble", SHORT | {"decisions": 32, "meta_batch": 16}),
    "train-baseline": (train_baseline, "", FEW | {"agent": "dqn", "steps": 700}),
}


def train(case: str, made: Path, out: Path, device: str) -> dict[str, Any]:
    """What a stage makes: its files, of weights all tensors by name."""
    stage, source, settings = CASES[case]
    stage(made / source if source else "doorkey", out, device=device, seed=3, quiet=True, **settings)
    files = open_artefact(out).manifest.files
    return {name: load_tensors(out / name) if name.endswith(".safetensors") else {} for name in files}


@pytest.mark.parametrize("case", CASES)
def test_the_same_files(case: str, tiny_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whole artefacts with the same tensors; learners' bytes are compared elsewhere."""
    near = train(case, tiny_run, tmp_path / "near", "cpu")
    with far_device(monkeypatch):
        monkeypatch.setattr("hypogoal.core.processes.prepare", lambda device="auto": FAR)
        far = train(case, tiny_run, tmp_path / "far", "cuda")
    assert near.keys() == far.keys()
    for name, tensors in near.items():
        assert tensors.keys() == far[name].keys()
        for key, tensor in tensors.items():
            other = far[name][key]
            assert (tensor.shape, tensor.dtype) == (other.shape, other.dtype)
            if case == "train-meta":
                torch.testing.assert_close(tensor, other, atol=1e-4, rtol=1e-5)


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_no_gpu_is_one_line(tiny_run: Path, tmp_path: Path) -> None:
    """Spec G2, G5: and nothing is written."""
    with pytest.raises(UserError, match="torch finds no GPU"):
        train("train-meta", tiny_run, tmp_path / "cuda", "cuda")
    assert not (tmp_path / "cuda").exists()


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")
@pytest.mark.parametrize("case", CASES)
def test_on_a_gpu(case: str, tiny_run: Path, tmp_path: Path) -> None:
    """The real thing, where there is one."""
    near, far = (train(case, tiny_run, tmp_path / device, device) for device in ("cpu", "cuda"))
    assert near.keys() == far.keys()
