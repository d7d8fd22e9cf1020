"""Spec G1: killed, interrupted and resumed as a user does it, in processes of their own."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from command_line import fails, settings
from toy_data import write

from hypogoal.core.artefacts import Draft
from hypogoal.core.checkpoints import PACE

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
