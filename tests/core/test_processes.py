"""Work in other processes: how many there may be, how they end; what a stage says while it works and at its end."""

import math
import os
import re
import signal
import subprocess
import sys
import time
from functools import partial
from math import inf
from pathlib import Path

import pytest

from hypogoal.command.call import outcome_of
from hypogoal.core import progress
from hypogoal.core.errors import UserError
from hypogoal.core.processes import CORES, allowed, cores, in_processes, quota, stop
from hypogoal.core.progress import MetricsLog, Progress


def ignore(number: int, result: object) -> None:
    """What is done with a result that nobody wants."""


def test_no_stage_uses_more_processes_than_it_was_allotted(monkeypatch: pytest.MonkeyPatch) -> None:
    """Spec G4: a cell's own ``workers`` stays within what its sweep gave it; on its own it is what was asked."""
    monkeypatch.delenv(CORES, raising=False)
    assert allowed(4096) == 4096 and allowed(0) == cores()
    monkeypatch.setenv(CORES, "2")
    assert allowed(4096) == 2 and allowed(1) == 1 and allowed(0) == cores() <= 2


@pytest.mark.parametrize(
    ("groups", "limits", "wanted"),
    [
        ("0::/", {"cpu.max": "50000 100000\n"}, 0.5),
        ("0::/", {"cpu.max": "max 100000\n"}, inf),
        ("0::/user/me", {"user/cpu.max": "150000 100000", "user/me/cpu.max": "max 100000"}, 1.5),
        ("0::/host/docker", {"cpu.max": "300000 100000"}, 3),
        ("2:cpu,cpuacct:/a\n0::/", {f"cpu,cpuacct/a/cpu.cfs_{n}_us": "50000" for n in ("quota", "period")}, 1),
        ("2:cpu:/", {"cpu/cpu.cfs_quota_us": "-1\n", "cpu/cpu.cfs_period_us": "100000\n"}, inf),
        ("2:cpu:/", {}, inf),
        (None, {}, inf),
    ],
)
def test_quotas_of_control_groups_are_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, groups: str | None, limits: dict[str, str], wanted: float
) -> None:
    """Of both versions, a group's own and those above it; half a core is one process."""
    mine = tmp_path / "cgroup"
    if groups:
        mine.write_text(groups)
    for name, text in limits.items():
        (tmp_path / "sys" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "sys" / name).write_text(text)
    assert quota(mine, tmp_path / "sys") == wanted
    monkeypatch.delenv(CORES, raising=False)
    monkeypatch.setattr("os.sched_getaffinity", lambda _: range(2))
    monkeypatch.setattr("hypogoal.core.processes.GROUPS", (mine, tmp_path / "sys"))
    assert cores() == (1 if wanted <= 1 else 2)


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


PROGRAM = """
from functools import partial
import os, sys
from hypogoal.core import own_code
from hypogoal.core.processes import in_processes
mine = "mine"
{first}
in_processes([partial({what}), partial({what})], 2, print)
"""


@pytest.mark.parametrize(
    "way", ["without a guard", "on standard input", "whose file is gone", "of which code is named"]
)
def test_a_program_is_not_run_again(tmp_path: Path, way: str) -> None:
    """Each task is done once, whatever the program is; unless a name of its own is to be loaded."""
    script = tmp_path / "script.py"
    first, what = {
        "whose file is gone": ("os.remove(sys.argv[0])", "len, 'ab'"),
        "of which code is named": (
            "own_code.allow(['__main__:mine'])\nif __name__ != '__main__': in_processes = lambda *rest: None",
            "own_code.load, '__main__:mine', 'word', 'none', {}",
        ),
    }.get(way, ("", "len, 'ab'"))
    script.write_text(PROGRAM.format(first=first, what=what))
    command = [sys.executable, "-"] if way == "on standard input" else [sys.executable, script]
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])}
    with script.open() as program:
        done = subprocess.run(
            command, capture_output=True, text=True, env=environment, timeout=120, check=False, stdin=program
        )
    result = "mine" if "named" in way else "2"
    lines = [line for line in done.stdout.splitlines() if line.endswith(result)]
    assert sorted(lines) == [f"0 {result}", f"1 {result}"], done.stderr


def test_processes_without_shared_memory_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """Spec G2: as where /dev/shm cannot be written; the line says what to do."""

    def refuse(*_: object) -> None:
        raise OSError(30, "Read-only file system")

    monkeypatch.setattr("multiprocessing.synchronize._multiprocessing.SemLock", refuse)
    with pytest.raises(UserError, match=r"Read-only file system.*/dev/shm. Make .* give HYPOGOAL_CORES=1"):
        in_processes([die, die], 2, ignore)


def test_a_line_says_how_far_it_is(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """With the time left by the pace since the last resume; a number that is not known yet is left out."""
    monkeypatch.setattr(progress, "FIRST_SECONDS", 0.0)
    monkeypatch.setattr(progress, "LINE_SECONDS", 0.0)
    with Progress("train-meta", total=1) as line:
        line.total = 1_500_000
        line.resume(1_000_000)
        line.update(1_234_567, success=0.123, length=math.nan)
        line.advance()
    *_, last = capsys.readouterr().err.split("\r")
    assert re.fullmatch(r"train-meta: 1234568/1500000 in 00:0\d, 00:0\d left, success=0.123 *\n", last)
    assert line.done == 1_234_568


def test_what_is_short_or_quiet_says_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    for quiet in (False, True):
        with Progress("train", total=10, quiet=quiet) as line:
            line.advance(10)
        assert capsys.readouterr().err == "" and line.done == 10


def test_a_result_without_a_whole_episode_has_no_success() -> None:
    assert outcome_of({"steps": 5, "episodes": 0, "success": math.nan}) == ["steps 5, episodes 0"]


def test_tensorboard_gets_the_numbers_of_a_log(tmp_path: Path) -> None:
    """Each number at its step, no text; the log's own lines are the same without it."""
    loader = pytest.importorskip("tensorboard.backend.event_processing.event_file_loader")
    plain, log = MetricsLog(tmp_path / "plain.jsonl"), MetricsLog(tmp_path / "log.jsonl", tmp_path / "board")
    for each in (plain, log):
        each.write(sub_goal="open-door", step=10, loss=0.5)
        each.write(sub_goal="open-door", step=20, loss=0.25, episodes=3)
        each.close()
    assert (tmp_path / "log.jsonl").read_bytes() == (tmp_path / "plain.jsonl").read_bytes()
    (file,) = (tmp_path / "board").iterdir()
    found = []
    for event in loader.EventFileLoader(str(file)).Load():
        found += [(event.step, value.tag, value.tensor.float_val[0]) for value in event.summary.value]
    assert found == [(10, "loss", 0.5), (20, "loss", 0.25), (20, "episodes", 3.0)]


def test_an_error_is_one_line_of_signs_that_can_be_printed() -> None:
    """Spec G2: it may quote a file."""
    assert str(UserError("kind \x1b[2J", "a\nb  c", "Do.")) == "kind ?[2J: a b c. Do."


def test_a_reader_that_has_enough() -> None:
    """As of any other program, before ``| head``: nothing is said."""
    reading, writing = os.pipe()
    os.close(reading)
    command = [sys.executable, "-m", "hypogoal", "config", "train-meta"]
    done = subprocess.run(command, stdout=writing, stderr=subprocess.PIPE, check=False)
    os.close(writing)
    assert (done.returncode, done.stderr) == (1, b"")
