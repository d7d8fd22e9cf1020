"""Faults on the way: numbers that are none, disks that are full, folders that may not be written (Spec G2, G3)."""

import os
import resource
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from command_line import refuses
from corridor import Corridor
from option_loops import loop_of, played
from torch import Tensor

from hypogoal.core.errors import NumericalError
from hypogoal.core.files import replace_text
from hypogoal.core.tensors import save_tensors
from hypogoal.meta.config import MetaConfig
from hypogoal.meta.ppo import MetaPolicy

QUICK = {"environments": 4, "warm_up": 20, "update_interval": 4, "option_batch": 16}


def stops(update: Callable[[], object], weight: Tensor, spoilt: Tensor, of_gradient: str, of_loss: str) -> None:
    """The update does, at an infinite gradient of a weight, which stays as it was, and at NaN in a spoilt one."""
    before = weight.detach().clone()
    hook = weight.register_hook(lambda gradient: gradient * torch.inf)
    with pytest.raises(NumericalError, match=of_gradient):
        update()
    hook.remove()
    assert torch.equal(before, weight)
    spoilt.fill_(torch.nan)
    with pytest.raises(NumericalError, match=of_loss):
        update()


def test_a_loss_or_gradient_that_is_no_number_stops_the_options() -> None:
    """Spec G3: the option, the batch and the step are named; the weights stay as they were."""
    loop = played(loop_of(Corridor(4), **QUICK), 20)
    heads = loop.learner.networks.online.heads
    of_gradient = r"a gradient of options \[0, 1\] is (nan|inf) in the batch of update \d+, step"
    of_loss = r"the loss of options \[1\] is nan in the batch of update \d+"
    stops(loop.learner._update, heads.weight, heads.bias.detach().view(2, -1)[1], of_gradient, of_loss)


def test_a_gradient_that_is_no_number_stops_the_meta_policy() -> None:
    """Spec G3."""
    loop = loop_of(Corridor(4), **QUICK)
    loop.chooser = MetaPolicy(loop.engine, 2, MetaConfig(decisions=8), seed=0)
    weight = next(loop.chooser.network.parameters())
    before = weight.detach().clone()
    weight.register_hook(lambda gradient: gradient * torch.inf)
    with pytest.raises(
        NumericalError, match=r"a gradient of the meta-policy is (nan|inf) in update 0, epoch 0, batch 0"
    ):
        played(loop, 100)
    assert torch.equal(before, weight)


def test_weights_that_are_no_numbers_are_never_saved(tmp_path: Path) -> None:
    """Spec G3: whatever let them through."""
    with pytest.raises(NumericalError, match=r"the weight b of options is NaN or Inf"):
        save_tensors(tmp_path / "options.safetensors", {"a": torch.zeros(2), "b": torch.tensor([1.0, torch.inf])})
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "words",
    [
        "collect own_domain:DOMAIN --out {out}.h5",
        "evaluate {run} --out {out}",
        "report {run} --figures {out}",
        "export {run}/ensemble --out {out}",
    ],
)
def test_a_command_without_room_leaves_nothing(corridor_run: Path, tmp_path: Path, words: str) -> None:
    """Spec G2: one line, and neither a draft nor a hidden file."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (700, hard))
    try:
        refuses("File too large", *words.format(run=corridor_run, out=tmp_path / "out").split())
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert not any(path.is_file() for path in tmp_path.rglob("*"))


def test_a_file_has_its_name_when_it_is_on_the_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Spec G1: a power failure leaves what was there before, or what replaced it: the file, its name, the folder."""
    path, seen, sync = tmp_path / "a.json", [], os.fsync
    path.write_text("before")

    def noted(file: int) -> None:
        seen.append((os.fstat(file).st_ino, path.read_text()))
        sync(file)

    monkeypatch.setattr("os.fsync", noted)
    replace_text(path, "after")
    assert seen == [(path.stat().st_ino, "before"), (tmp_path.stat().st_ino, "after")]
