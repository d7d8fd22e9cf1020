"""Tasks on several cores: how many there may be."""

import os
import signal
from functools import partial
from pathlib import Path

import pytest

from hypogoal.cli import notes_of
from hypogoal.core.artefacts import create
from hypogoal.core.checkpoints import Checkpoints
from hypogoal.core.errors import Killed
from hypogoal.core.workers import CORES, allowed, cores, in_processes


def test_no_stage_uses_more_processes_than_it_was_allotted(monkeypatch: pytest.MonkeyPatch) -> None:
    """Spec G4: a cell's own ``workers`` stays within what its sweep gave it; on its own it is what was asked."""
    monkeypatch.delenv(CORES, raising=False)
    assert allowed(4096) == 4096 and allowed(0) == cores()
    monkeypatch.setenv(CORES, "2")
    assert allowed(4096) == 2 and allowed(1) == 1 and allowed(0) == cores() <= 2


def die() -> None:
    """As the system has it where memory is used up."""
    os.kill(os.getpid(), signal.SIGKILL)


def stage(out: Path) -> None:
    """One that loses its processes after its first checkpoint."""
    with create(out, kind="ensemble", config={}, seed=0) as draft:
        draft.checkpoints().save({"step": 1})
        in_processes([die, die], 2, lambda number, result: None)


def test_a_process_that_the_system_kills_is_one_line(tmp_path: Path) -> None:
    """Spec G1, G2: what happened and what to do, and that the checkpoint is kept."""
    with pytest.raises(Killed, match=r"lack of memory.*workers=1") as caught:
        stage(tmp_path / "ensemble")
    assert "the last checkpoint is kept" in "; ".join(notes_of(caught.value))


def fail_after(begun: Path) -> None:
    """When the other one has begun."""
    while not begun.exists():
        os.sched_yield()
    raise ValueError("first")


def fail_when_told_to_stop(begun: Path) -> None:
    """Its own error is what ends it: the SIGTERM was for the next checkpoint, of which there is none."""
    with Checkpoints(None) as checkpoints:
        begun.touch()
        while checkpoints._signal is None:
            os.sched_yield()
        raise ValueError("second")


def test_processes_that_fail_at_once_are_not_waited_for_for_ever(tmp_path: Path) -> None:
    """Spec G2: the first error is told, though the others fail of their own while they are told to stop."""
    tasks = [partial(fail, tmp_path / "begun") for fail in (fail_after, fail_when_told_to_stop)]
    with pytest.raises(ValueError, match="first"):
        in_processes(tasks, 2, lambda number, result: None)
