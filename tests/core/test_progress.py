"""What a stage says while it works and at its end."""

import math
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from hypogoal.command.call import outcome_of
from hypogoal.core import progress
from hypogoal.core.errors import UserError
from hypogoal.core.progress import MetricsLog, Progress


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
