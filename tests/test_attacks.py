"""Full disks, signals and files made to hurt, a few of the many of ``tests.attacks.attacks`` (Spec G1, G2)."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from tests.attacks.attacks import RUN_FREE, Bad, Ended

ROOT = Path(__file__).resolve().parents[1]


def attacked(folder: Path, *arguments: str) -> list[dict[str, object]]:
    """The rows of the harness."""
    command = [sys.executable, "-m", "tests.attacks.attacks", "--folder", str(folder / "box"), *arguments]
    done = subprocess.run([*command, "--json", str(folder / "rows.json")], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    return list(json.loads((folder / "rows.json").read_text(encoding="utf-8")))


def test_hostile_files_are_one_line_at_most(tmp_path: Path) -> None:
    """Spec G2: of each family that needs no run."""
    rows = attacked(tmp_path, "--cases", "2", *(word for name in RUN_FREE for word in ("--family", name)))
    assert [row["family"] for row in rows] == list(RUN_FREE)
    assert all(row["cases"] == 2 and row["bad"] == 0 for row in rows)
    assert sum(int(str(row["refused"])) for row in rows) > 3, "nothing was refused: are the files hostile at all?"


def test_a_stage_that_gets_signals_ends_with_the_same_bytes(tmp_path: Path) -> None:
    """Spec G1: the collection of data, which takes a second."""
    (row,) = attacked(tmp_path, "--family", "signals", "--case", "0")
    assert row["accepted"] == 1 and row["bad"] == 0


@pytest.mark.parametrize(
    ("code", "words"),
    [
        (1, "hypogoal: internal error: KeyError: 'x'"),
        (2, "hypogoal: no\nhypogoal: twice"),
        (2, "UserWarning: look\n"),
        (2, "hypogoal: \x1b[2J"),
        (-9, ""),
        (0, "Traceback (most recent call last):"),
    ],
)
def test_what_is_bad_would_be_seen(code: int, words: str) -> None:
    """The harness itself."""
    assert Ended("show", 0, "", 0.0, 0).accepted() and not Ended("show", 2, "hypogoal: no", 0.0, 0).accepted()
    with pytest.raises(Bad):
        Ended("show", code, words, 0.0, 0).accepted()
