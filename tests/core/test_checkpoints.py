"""Spec G1, G3: a state on disk is the state, the last good one stays; Adam's step is torch's own."""

import json
import resource
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.numpy import save_file
from torch import nn

from hypogoal.core.adam import Adam
from hypogoal.core.checkpoints import Checkpoints, restored, snapshot_of
from hypogoal.core.errors import UserError


def test_a_state_comes_back_as_it_was(tmp_path: Path) -> None:
    """Spec G1: arrays, tensors, numbers of any size and their types, in dicts and lists, to the last bit."""
    checkpoints = Checkpoints(tmp_path / "checkpoint" / "stage.safetensors")
    assert checkpoints.load() is None
    rng = np.random.default_rng(0)
    state = {
        "rng": rng.bit_generator.state,
        "arrays": [rng.random((3, 4)).T, np.array(5, np.int16), np.zeros((0, 2), np.bool_)],
        "tensors": {"a": torch.rand(2, 3).T, "step": torch.tensor(7.0), "bytes": torch.arange(3, dtype=torch.uint8)},
        "numbers": [1, 0.1 + 0.2, True, None, "word", np.float32(0.1), (2, 3)],
        "nan": [float("nan"), np.array([np.nan])],  # what is no tensor may hold them
        "empty": {},
    }
    checkpoints.save(state)
    found = checkpoints.load()
    assert found is not None and found.keys() == state.keys()
    assert found["rng"] == state["rng"]
    for before, after in zip(state["arrays"], found["arrays"], strict=True):
        np.testing.assert_array_equal(before, after)
        assert before.dtype == after.dtype and before.shape == after.shape and after.flags.writeable
    assert all(torch.equal(found["tensors"][name], value) for name, value in state["tensors"].items())
    assert found["numbers"] == [1, 0.1 + 0.2, True, None, "word", float(np.float32(0.1)), [2, 3]]
    assert np.isnan(found["nan"][0]) and np.isnan(found["nan"][1][0]) and found["empty"] == {}


def test_another_versions_checkpoint_is_one_line(tmp_path: Path) -> None:
    """A state as 1.0 wrote it, without a format."""
    path = tmp_path / "stage.safetensors"
    text = json.dumps({"loop": {}, "logged": 0})
    save_file({"json": np.frombuffer(text.encode(), np.uint8)}, path)
    with pytest.raises(UserError, match="another version of hypogoal wrote this checkpoint"):
        Checkpoints(path).load()


def test_weights_of_half_precision_come_back(tmp_path: Path) -> None:
    """Spec G1: bfloat16, which NumPy does not have, to the last bit."""
    checkpoints = Checkpoints(tmp_path / "stage.safetensors")
    layer, other = (torch.nn.Linear(3, 2).bfloat16() for _ in range(2))
    checkpoints.save({"layer": snapshot_of(layer)})
    restored(other, (checkpoints.load() or {})["layer"])
    assert other.weight.dtype == torch.bfloat16 and torch.equal(other.weight, layer.weight)


@pytest.mark.parametrize("kind", [Adam, partial(torch.optim.Adam, fused=True)], ids=["ours", "torch's"])
def test_an_optimiser_goes_on_as_if_it_had_not_stopped(kind: Any) -> None:
    """Spec G1: moments and step counts, with steps of the same size before and after."""

    def steps(weight: torch.Tensor, optimiser: Any, count: int) -> None:
        for _ in range(count):
            optimiser.zero_grad()
            (weight**4).sum().backward()
            optimiser.step()

    weights = [torch.ones(5, requires_grad=True) for _ in range(2)]
    unbroken, first = (kind([weight], lr=0.1) for weight in weights)
    steps(weights[0], unbroken, 7)
    steps(weights[1], first, 4)
    resumed = kind([weights[1]], lr=0.1)
    restored(resumed, snapshot_of(first))
    steps(weights[1], resumed, 3)
    assert torch.equal(*weights)


def test_what_is_not_finite_is_not_saved(tmp_path: Path) -> None:
    """Spec G3: NaN in a weight leaves the last good checkpoint."""
    checkpoints = Checkpoints(tmp_path / "stage.safetensors")
    checkpoints.save({"weight": torch.ones(2)})
    checkpoints.save({"weight": torch.tensor([1.0, float("nan")])})
    assert torch.equal((checkpoints.load() or {})["weight"], torch.ones(2))


def test_a_full_disk_leaves_the_last_one_whole(tmp_path: Path) -> None:
    """Spec G1, G2: one line, and what was there is there."""
    checkpoints = Checkpoints(tmp_path / "stage.safetensors")
    checkpoints.save({"array": np.arange(10)})
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, hard))
    try:
        with pytest.raises(UserError, match="cannot be written"):
            checkpoints.save({"array": np.arange(10_000)})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    np.testing.assert_array_equal((checkpoints.load() or {})["array"], np.arange(10))
    assert [path.name for path in tmp_path.iterdir()] == ["stage.safetensors"]


@pytest.mark.parametrize("size", [0, 5, 100, -1])
def test_a_damaged_one_is_one_line(tmp_path: Path, size: int) -> None:
    """Spec G2."""
    path = tmp_path / "stage.safetensors"
    Checkpoints(path).save({"array": np.arange(10)})
    path.write_bytes(path.read_bytes()[:size])
    with pytest.raises(UserError, match="damaged"):
        Checkpoints(path).load()


def test_they_are_paced_by_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A checkpoint may cost a few per cent: none in the first seconds, then thirty times its cost apart."""
    seconds = [100.0]
    monkeypatch.setattr("hypogoal.core.checkpoints.time.monotonic", lambda: seconds[0])
    checkpoints = Checkpoints(tmp_path / "stage.safetensors")
    saved: list[float] = []

    def state() -> dict[str, float]:
        saved.append(seconds[0])
        seconds[0] += 2.0  # what it costs
        return {"at": seconds[0]}

    while seconds[0] < 250.0:
        checkpoints.offer(state)
        seconds[0] += 1.0
    assert saved == [110.0, 172.0, 234.0]


@pytest.mark.parametrize("settings", [{"lr": 1e-3}, {"lr": 5e-4, "eps": 1e-5}, {"lr": 2e-4, "weight_decay": 1e-2}])
def test_weights_get_the_same_bytes(settings: dict[str, float]) -> None:
    """Also where the rate changes, and where some weights have no gradient in some steps."""
    torch.manual_seed(0)
    networks = [nn.Sequential(nn.Conv2d(3, 16, 3), nn.Flatten(), nn.Linear(16 * 36, 7)) for _ in range(2)]
    networks[1].load_state_dict(networks[0].state_dict())
    ours, theirs = (
        Adam(networks[0].parameters(), **settings),
        torch.optim.Adam(networks[1].parameters(), fused=True, **settings),
    )
    for step in range(30):
        ours.lr = theirs.param_groups[0]["lr"] = settings["lr"] * (1 + step % 3)
        states = torch.randn(5, 3, 8, 8)
        for network, optimiser in zip(networks, (ours, theirs), strict=True):
            optimiser.zero_grad()
            network(states).square().sum().backward()
            if step % 4 == 0:
                network[0].weight.grad = None
            optimiser.step()
        for one, other in zip(networks[0].parameters(), networks[1].parameters(), strict=True):
            assert torch.equal(one, other)
