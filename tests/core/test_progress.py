"""What a stage says while it works and at its end."""

from __future__ import annotations

import itertools
import math
import os
import re
import subprocess
import sys
import time
from pathlib import Path

import pytest

from hypogoal.core import progress
from hypogoal.core.errors import UserError
from hypogoal.core.progress import MetricsLog, Progress
from hypogoal.stages import outcome_of


def test_without_a_terminal_there_is_a_line_now_and_then(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """With the time left; a run without a whole episode has no success, and no 'nan' either."""
    with Progress("train", total=10) as bar:
        bar.update(3, success=0.5)
        assert capsys.readouterr().err == "", "ten seconds are not over"
        monkeypatch.setattr(progress, "LINE_SECONDS", 0.0)
        bar.update(5, success=math.nan, loss=0.25)
        bar.update(6)
    first, second, last = capsys.readouterr().err.splitlines()
    assert re.fullmatch(r"train: 5/10, (\?|0:00:0\d) left loss 0\.25", first)
    assert re.fullmatch(r"train: 6/10, (\?|0:00:0\d) left loss 0\.25", second)
    assert last == "train: 6/10, done in 0:00:00"
    numbers = {"steps": 5, "episodes": 0, "success": math.nan, "loss": 0.25}
    assert outcome_of(numbers) == ["steps 5, episodes 0, loss 0.25"]


def test_what_others_do_is_counted(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """Spec A6: how far other processes are is asked again and again, so that a line comes while they work."""
    monkeypatch.setattr(progress, "LINE_SECONDS", 0.0)
    monkeypatch.setattr(progress, "LOOK_SECONDS", 0.01)
    asked = itertools.count()
    with Progress("train", total=10_000) as bar, bar.following(lambda: next(asked)):
        until = time.monotonic() + 30
        while bar.done < 6 and time.monotonic() < until:
            time.sleep(0.01)
    assert "train: 5/10000" in capsys.readouterr().err


def test_a_line_fits_a_terminal(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """Drawn over and over, with the time left by the pace since the last resume."""
    monkeypatch.setattr("sys.stderr.isatty", lambda: True, raising=False)
    monkeypatch.setattr(progress, "REDRAW_SECONDS", 0.0)
    with Progress("train-meta", total=1) as bar:
        bar.total = 1_500_000
        bar.resume(1_000_000)
        bar.update(1_234_567, success=0.123, length=123.0)
        bar.update(1_234_568)
    first, *_, last = capsys.readouterr().err.split("\r")[1:]
    assert len(first) == 79 and re.match(r"train-meta: 1234567/1500000, 0:00:0\d left success 0.123 length 123 ", first)
    assert last.endswith("\n") and last.split() == ["train-meta:", "1234568/1500000,", "done", "in", "0:00:00"]


def test_tensorboard_gets_the_numbers_of_a_log(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
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

    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", None)
    with pytest.raises(UserError, match=r"pip install 'hypogoal\[tensorboard\]'"):
        MetricsLog(tmp_path / "log.jsonl", tmp_path / "board")


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
