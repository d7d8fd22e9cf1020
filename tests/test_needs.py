"""Spec G1: what a stage says it will need is what it takes, within a factor of 1.5."""

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from hypogoal.dataset import Collected, States, write_dataset
from tests.attacks.kills import STAGES, needed

ROOT = Path(__file__).resolve().parents[1]
UNIT = {"MB": 1e6, "GB": 1e9}
MAY_DIFFER = 1.5  # times
CODE = """
import re, sys
from hypogoal.cli import main
code = main(sys.argv[1:])
print(re.search(r"VmHWM:\\s+(\\d+)", open("/proc/self/status").read())[1])
sys.exit(code)
"""
SHAPES = [(64, 64, 3), (128, 128, 3), (240, 320, 3), (40,)]  # 480 x 640 takes 16 GB


def peak(arguments: list[str]) -> tuple[str, float]:
    """What a command says on stderr, and the most memory, in bytes, that its process had; workers are not counted.

    The process reads it: what the kernel keeps for a parent counts the parent's memory, too, of the moment of the fork.
    """
    done = subprocess.run([sys.executable, "-c", CODE, *arguments], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stderr, int(done.stdout.split()[-1]) * 1024.0


def compare(said: str, taken: float) -> None:
    """Whether the memory that a stage says it will need is what it took, within ``MAY_DIFFER``."""
    match = re.search(r"needs about ([\d.]+) (MB|GB) of memory", said)
    assert match, said
    need = float(match[1]) * UNIT[match[2]]
    print(f"{need / 1e6:.0f} MB said, {taken / 1e6:.0f} MB taken")
    assert taken / MAY_DIFFER <= need <= MAY_DIFFER * taken


@pytest.mark.parametrize("shape", [(112, 112, 3), *(pytest.param(shape, marks=pytest.mark.slow) for shape in SHAPES)])
def test_the_memory_said_for_own_data_is_what_they_take(tmp_path: Path, shape: tuple[int, ...]) -> None:
    """Spec G1: for pictures of any size in which nothing repeats, and for numbers."""
    noise = np.random.default_rng(0).integers(0, 256, (20, *shape)).astype(np.uint8 if len(shape) == 3 else np.float32)
    split = States(noise[:10], np.arange(10)[:, None] % 2 == 0)
    collected = Collected(shape, ("goal",), split, States(noise[10:], split.labels[:, :0]), split)
    write_dataset(tmp_path / "own.h5", collected, domain="imported", config={}, seed=0)
    out = ["--set", "steps=2", "--out", str(tmp_path / "ensemble")]
    compare(*peak(["train-ensemble", str(tmp_path / "own.h5"), *out]))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["ensemble", "options", "meta", "descent", "ppo", "dqn"])
def test_the_memory_said_is_what_it_takes(tmp_path: Path, name: str) -> None:
    """Spec G1: at toy scale, where most of it is the libraries; they are most of it at the demo's scale too."""
    for part in needed([name]):
        stage = STAGES[part]
        said, taken = peak([*stage.arguments(tmp_path), "--out", str(tmp_path / f"{part}{stage.suffix}")])
    compare(said, taken)
