"""Spec G1: what a stage says it will need is no less than what it takes, and not many times as much."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks.kills import STAGES, needed

ROOT = Path(__file__).resolve().parents[1]
UNIT = {"MB": 1e6, "GB": 1e9}


def peak(arguments: list[str]) -> tuple[str, float]:
    """What a command says on stderr, and the most memory, in bytes, that its process had; workers are not counted."""
    with subprocess.Popen(
        [sys.executable, "-m", "hypogoal", *arguments], cwd=ROOT, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL
    ) as process:
        assert process.stderr is not None
        said = process.stderr.read().decode()
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
    assert process.returncode == 0, said
    return said, usage.ru_maxrss * 1024.0


@pytest.mark.slow
@pytest.mark.parametrize("name", ["ensemble", "options", "meta", "descent", "ppo", "dqn"])
def test_the_memory_said_is_what_it_takes(tmp_path: Path, name: str) -> None:
    """Spec G1: at toy scale, where most of it is the libraries; they are most of it at the demo's scale too."""
    for part in needed([name]):
        stage = STAGES[part]
        said, taken = peak([*stage.arguments(tmp_path), "--out", str(tmp_path / f"{part}{stage.suffix}")])
    match = re.search(r"needs about ([\d.]+) (MB|GB) of memory", said)
    assert match, said
    need = float(match[1]) * UNIT[match[2]]
    print(f"{name}: {need / 1e6:.0f} MB said, {taken / 1e6:.0f} MB taken")
    assert taken <= need <= 3 * taken
