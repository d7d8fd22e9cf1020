"""Work in other processes: how many there may be, how they end."""

import os
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import pytest

from hypogoal.core.errors import UserError
from hypogoal.core.processes import CORES, allowed, cores, in_processes, stop


def ignore(number: int, result: object) -> None:
    """What is done with a result that nobody wants."""


def test_no_stage_uses_more_processes_than_it_was_allotted(monkeypatch: pytest.MonkeyPatch) -> None:
    """Spec G4: a cell's own ``workers`` stays within what its sweep gave it; on its own it is what was asked."""
    monkeypatch.delenv(CORES, raising=False)
    assert allowed(4096) == 4096 and allowed(0) == cores()
    monkeypatch.setenv(CORES, "2")
    assert allowed(4096) == 2 and allowed(1) == 1 and allowed(0) == cores() <= 2


def die() -> None:
    """As the system has it where memory is used up."""
    os.kill(os.getpid(), signal.SIGKILL)


def test_a_process_that_the_system_kills_is_one_line() -> None:
    """Spec G1, G2: what happened and what to do."""
    with pytest.raises(UserError, match=r"lack of memory.*workers=1"):
        in_processes([die, die], 2, ignore)


def fail_after(begun: Path) -> None:
    """When the other one has begun."""
    while not begun.exists():
        os.sched_yield()
    raise ValueError("first")


def sleep(begun: Path) -> None:
    begun.touch()
    time.sleep(600)


@pytest.mark.parametrize("forked", [False, True])
def test_what_fails_ends_the_others(tmp_path: Path, forked: bool) -> None:
    """At once, with the place of its error in user code, and in a stage, whose signals have a handler."""
    tasks = [partial(each, tmp_path / "begun") for each in (fail_after, *[sleep] * 4)]
    before = signal.signal(signal.SIGTERM, stop)
    try:
        with pytest.raises(UserError, match=r"your code raised ValueError: first: test_processes.py, line \d+"):
            in_processes(tasks, 2, ignore, forked=forked)
    finally:
        signal.signal(signal.SIGTERM, before)


NO_GUARD = """
from functools import partial
from hypogoal.core.processes import in_processes
in_processes([partial(print, "a"), partial(print, "b")], 2, print)
"""


def test_a_script_without_a_guard_is_told(tmp_path: Path) -> None:
    """Processes are spawned, which import it again."""
    (tmp_path / "script.py").write_text(NO_GUARD)
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])}
    command = [sys.executable, tmp_path / "script.py"]
    done = subprocess.run(command, capture_output=True, text=True, env=environment, timeout=120, check=False)
    assert "could not start. Run fewer at once: --set workers=1. In a script call hypogoal below 'if" in done.stderr
