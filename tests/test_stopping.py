"""Killed, interrupted and resumed as a user does it; numbers that are none, disks that are full (Spec G1-G3)."""

import os
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from command_line import fails, refuses, settings
from corridor import Corridor
from option_loops import loop_of, played
from torch import Tensor
from toy_data import write

from hypogoal.core.checkpoints import PACE
from hypogoal.core.drafts import Draft
from hypogoal.core.errors import NumericalError
from hypogoal.core.files import replace_text
from hypogoal.core.tensors import save_tensors
from hypogoal.meta.config import MetaConfig
from hypogoal.meta.ppo import MetaPolicy

ROOT = Path(__file__).resolve().parents[1]
WAIT_SECONDS = 300.0


@pytest.mark.slow
def test_killed_commands_end_with_the_same_bytes() -> None:
    """SIGKILL at random moments, a few of them; ``python -m tests.attacks.kills`` is the long version."""
    command = [sys.executable, "-m", "tests.attacks.kills", "--kills", "2", "--commands", "sweep", "run/ensemble"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    rows = done.stdout.splitlines()[1:]
    assert [row.split()[1] for row in rows] == ["2", "2"], rows


def wait_for(holds: Callable[[], bool], process: subprocess.Popen[str]) -> None:
    until = time.monotonic() + WAIT_SECONDS
    while not holds():
        assert process.poll() is None and time.monotonic() < until
        time.sleep(0.05)


def last_checkpoint(out: Path) -> int:
    """When an unfinished output's newest checkpoint was written, in ns; 0 before the first."""
    files = Draft(out).checkpoint.glob("*.safetensors")
    return max((file.stat().st_mtime_ns for file in files), default=0)


def test_ctrl_c_and_sigterm_say_how_to_continue(tmp_path: Path) -> None:
    """One line and 128 + the signal; then neither flag, or another seed, is refused in one line."""
    data, out = write(tmp_path / "data.h5"), tmp_path / "ensemble"
    words = [
        "train-ensemble",
        str(data),
        "--out",
        str(out),
        "-q",
        *settings("steps=1000000", "workers=1", "sub_goals=one"),
    ]
    for number, resume in ((signal.SIGINT, []), (signal.SIGTERM, ["--resume"])):
        before = last_checkpoint(out)
        command = [sys.executable, "-m", "hypogoal", *words, *resume]
        paced = {**os.environ, PACE: "0.1"}
        with subprocess.Popen(command, cwd=ROOT, env=paced, stderr=subprocess.PIPE, text=True) as process:
            wait_for(lambda before=before: last_checkpoint(out) > before, process)  # type: ignore[misc]
            process.send_signal(number)
            _, told = process.communicate()
        assert process.returncode == 128 + number
        assert told == (
            "hypogoal: stopped; the last checkpoint is kept: give the same command with --resume to continue\n"
        )
        assert Draft(out).is_resumable and not out.exists()
    assert "an unfinished output exists" in fails(*words).err
    assert "begun with seed=0, not 1" in fails(*words, "--resume", "--seed", "1").err


SLEEPING = """
import os, time

def sleep(folder, number):
    (folder / f"{number}.new").write_text(str(os.getpid()))
    (folder / f"{number}.new").rename(folder / f"{number}.pid")
    time.sleep(600)
"""
SLEEPERS = """
import functools, pathlib, sys
from sleeping import sleep
from hypogoal.core.processes import in_processes

if __name__ == "__main__":
    in_processes([functools.partial(sleep, pathlib.Path(sys.argv[1]), number) for number in range(2)], 2, print)
"""


def test_a_stage_dies_with_all_its_processes(tmp_path: Path) -> None:
    """No orphan writes beside its successor."""
    (tmp_path / "sleeping.py").write_text(SLEEPING)
    (tmp_path / "script.py").write_text(SLEEPERS)
    command = [sys.executable, str(tmp_path / "script.py"), str(tmp_path)]
    path = os.pathsep.join([str(ROOT), str(tmp_path)])
    with subprocess.Popen(command, env={**os.environ, "PYTHONPATH": path}, text=True) as parent:
        wait_for(lambda: len(list(tmp_path.glob("*.pid"))) == 2, parent)
        parent.kill()
    until = time.monotonic() + WAIT_SECONDS
    while any(alive(int(path.read_text())) for path in tmp_path.glob("*.pid")):
        assert time.monotonic() < until
        time.sleep(0.05)


def alive(process: int) -> bool:
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


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
