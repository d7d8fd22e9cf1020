"""Spec G5: options are played, learned and chosen on another device than the CPU, and go on there after a break."""

from pathlib import Path
from typing import Any

import pytest
import torch
from far_device import FAR, FarTensor, far_device
from loops import loop_of

from hypogoal.core.checkpoints import Checkpoints
from hypogoal.options.loop import OptionLoop

STEPS, BREAK = 32, 20
CASES = ("light, shared, ppo", "light, shared, gaussian", "light, own, n steps, even", "paper, own, random")
# A bias before BatchNorm has no gradient but rounding, which Adam follows as if it were one.
ROUNDING = ("features.0.bias", "features.4.bias", "running_mean")


def played(loop: OptionLoop, steps: int, path: Path) -> bytes:
    """A checkpoint after some steps."""
    for _ in range(steps):
        loop.step()
    Checkpoints(path).save(loop.snapshot())
    return path.read_bytes()


@pytest.mark.usefixtures("small_gru")
@pytest.mark.parametrize("case", CASES)
def test_another_device_gives_the_same(case: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Spec G1, G5: no array and no tensor is left behind on the CPU, and a checkpoint goes on there.

    To the same bytes as on the CPU; but torch computes a GRU (``paper``) by another way on other devices.
    """
    near = loop_of(case)
    wanted = played(near, STEPS, tmp_path / "cpu")
    with far_device(monkeypatch):
        unbroken = loop_of(case, FAR)
        found = played(unbroken, STEPS, tmp_path / "far")
        played(loop_of(case, FAR), BREAK, tmp_path / "broken")
        resumed = loop_of(case, FAR)
        saved = Checkpoints(tmp_path / "broken").load()
        assert saved is not None
        resumed.restore(saved)
        assert played(resumed, STEPS - BREAK, tmp_path / "resumed") == found
        learner: Any = unbroken.learner
        for member in getattr(learner, "members", None) or [learner.networks]:
            assert member.updates
            assert all(isinstance(weight, FarTensor) for weight in member.online.parameters())
        fresh: Any = loop_of(case, FAR).learner
        fresh.load(learner.state())
        state, again = ({name: value.cpu() for name, value in one.state().items()} for one in (learner, fresh))
    assert all(torch.equal(value, again[name]) for name, value in state.items())
    if not case.startswith("paper"):
        assert found == wanted
    assert near.recorder.episodes.rows == unbroken.recorder.episodes.rows
    for name, value in near.learner.state().items():  # type: ignore[attr-defined]
        assert name.endswith(ROUNDING) or torch.allclose(value.double(), state[name].double(), atol=5e-4), name
