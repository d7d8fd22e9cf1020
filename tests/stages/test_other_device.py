"""Spec G5: every training stage on another device than the CPU leaves the same files."""

from collections.abc import Callable
from functools import partial
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
from hypogoal.stages.train_options import train_options

PREPARE = "hypogoal.core.processes.prepare"
QUIET = {"quiet": True, "seed": 3}
SHORT: dict[str, Any] = {
    "steps": 192, "max_episode_steps": 30, "option_timeout": 7, "random_episodes": 1, "warm_up": 32, "replay": 200,
}  # fmt: skip


def ensemble(made: Path, out: Path) -> None:
    few = {"steps": 3, "members": 2, "workers": 1, "sub_goals": ("open-red-door",)}
    train_ensemble(made / "data.h5", out, device="cuda" if out.name == "far" else "cpu", **few, **QUIET)


def options(made: Path, out: Path) -> None:
    train_options(made / "ensemble", out, device=out.name, **SHORT, **QUIET)


def meta(made: Path, out: Path) -> None:
    train_meta(made / "ensemble", out, device=out.name, **SHORT, decisions=32, meta_batch=16, **QUIET)


def baseline(agent: str, made: Path, out: Path) -> None:
    few = {"agent": agent, "steps": 1_200, "max_episode_steps": 30, "random_episodes": 1}
    train_baseline("doorkey", out, device=out.name, **few, **QUIET)


CASES: dict[str, Callable[[Path, Path], None]] = {
    "train-ensemble": ensemble,
    "train-options": options,
    "train-meta": meta,
    "train-baseline, ppo": partial(baseline, "ppo"),
    "train-baseline, dqn": partial(baseline, "dqn"),
}


@pytest.mark.parametrize("case", CASES)
def test_the_same_files(case: str, tiny_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Spec G5: whole artefacts with the same tensors; learners' bytes are compared elsewhere."""
    train = CASES[case]
    train(tiny_run, tmp_path / "cpu")
    with far_device(monkeypatch):
        monkeypatch.setattr(PREPARE, lambda device="auto": FAR)
        train(tiny_run, tmp_path / "far")
    near, far = (open_artefact(tmp_path / name) for name in ("cpu", "far"))
    assert near.manifest.files.keys() == far.manifest.files.keys()
    for name in near.manifest.files:
        if name.endswith(".safetensors"):
            one, other = load_tensors(near.path / name), load_tensors(far.path / name)
            assert {key: (value.shape, value.dtype) for key, value in one.items()} == {
                key: (value.shape, value.dtype) for key, value in other.items()
            }
            if case in ("train-options", "train-meta"):
                assert all(torch.allclose(value.double(), other[key].double(), atol=1e-4) for key, value in one.items())


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_no_gpu_is_one_line(tiny_run: Path, tmp_path: Path) -> None:
    """Spec G2, G5: and nothing is written."""
    with pytest.raises(UserError, match="torch finds no GPU"):
        options(tiny_run, tmp_path / "cuda")
    assert not (tmp_path / "cuda").exists()


@pytest.mark.gpu
@pytest.mark.parametrize("case", CASES)
def test_on_a_gpu(case: str, tiny_run: Path, tmp_path: Path) -> None:
    """Spec G5: the real thing, where there is one."""
    if not torch.cuda.is_available():
        pytest.skip("no GPU")
    CASES[case](tiny_run, tmp_path / ("far" if case == "train-ensemble" else "cuda"))
    CASES[case](tiny_run, tmp_path / "cpu")
    near, far = (open_artefact(path) for path in sorted(tmp_path.iterdir()))
    assert near.manifest.files.keys() == far.manifest.files.keys()
