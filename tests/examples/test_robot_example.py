"""The story of a simulated arm, by its own commands, at toy size (Spec I6)."""

import csv
import ctypes.util
import os
import subprocess
import sys
from pathlib import Path

import pytest

from hypogoal.cli import main
from hypogoal.data import open_dataset

EXAMPLE = Path(__file__).parents[2] / "examples" / "robot_bin.py"
pytestmark = pytest.mark.skipif(ctypes.util.find_library("EGL") is None, reason="no EGL (Debian: libegl1)")
FEW = ["-q", "--set", "steps=3", "--set", "members=2", "--set", "workers=1"]


def run(folder: Path, *words: str) -> str:
    """The example's output; in a process of its own, whose renderer needs its own environment."""
    command = [sys.executable, str(EXAMPLE), *words]
    environment = os.environ | {"MUJOCO_GL": "egl", "PYTHONPATH": str(EXAMPLE.parents[1])}
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.slow
def test_from_recorded_play_to_the_second_audit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Spec I6: a LeRobotDataset, an audit, its answers, and the data that they become; the truth judges members."""
    monkeypatch.chdir(tmp_path)
    assert "5 episodes" in run(tmp_path, "record", "takes", "--demos", "2", "--others", "1")
    rule = ["--label", "block-in-bin=takes/labels.csv"]
    assert main(["import", "takes", *rule, "--out", "data.h5", "-q"]) == 0
    before = open_dataset(Path("data.h5"))
    labels = before.labelled("block-in-bin").labels
    assert before.observation_dtype["observation.images.wrist"].shape == (48, 64, 3)
    assert 0 < labels.sum() < len(labels), "a demonstration has both"
    assert main(["train-ensemble", "data.h5", "--out", "ensemble", *FEW]) == 0
    assert main(["audit", "ensemble", "--out", "audit"]) == 0
    assert "8 frames" in run(tmp_path, "answer", "audit", "takes", "labels.csv", "--count", "8")
    with open("labels.csv", newline="", encoding="utf-8") as file:
        answers = [row["label"] for row in csv.DictReader(file)]
    assert len(answers) == 8 and set(answers) <= {"0", "1"}
    assert main(["import", "data.h5", "--label", "block-in-bin=labels.csv", "--out", "more.h5", "-q"]) == 0
    after = open_dataset(Path("more.h5"))
    assert len(after.labelled("block-in-bin").labels) == len(labels) + 8
    assert len(after.unlabelled()) == len(before.unlabelled()) - 8
    assert main(["train-ensemble", "more.h5", "--out", "more", *FEW]) == 0
    assert main(["audit", "more", "--out", "audit-more"]) == 0
    lines = run(tmp_path, "judge", "ensemble", "more", "--plays", "2").splitlines()
    assert len(lines) == 4 and all("fooled" in line for line in lines)
    for line in lines:
        numbers = [int(word.strip(",")) for word in line.split() if word.strip(",").isdecimal()]
        assert sum(numbers) == 2, line
