"""What a stage says while it works and at its end."""

from __future__ import annotations

import io
import itertools
import math
import re
import sys
import time
from pathlib import Path

import pytest

from hypogoal.core import progress
from hypogoal.core.errors import UserError
from hypogoal.core.progress import MetricsLog, Progress
from hypogoal.core.terminal import screen
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


def test_a_bar_fits_a_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    """Within 80 columns: how far, the numbers, the time left by the pace since the last resume."""
    drawn = io.StringIO()
    monkeypatch.setattr("sys.stderr.isatty", lambda: True, raising=False)
    monkeypatch.setattr(progress, "screen", lambda **_: screen(width=80, file=drawn, force_terminal=True))
    with Progress("train-meta", total=1) as bar:
        bar.total = 1_500_000
        bar.resume(1_000_000)
        bar.update(1_234_567, success=0.123, length=123.0)
        bar.update(1_234_568)
        assert bar._task.time_remaining is not None and bar._task.time_remaining < 60
    lines = [re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", line).strip() for line in re.split(r"[\r\n]", drawn.getvalue())]
    last = next(line for line in reversed(lines) if line)
    assert re.fullmatch(r"train-meta \S+ +1234568/1500000 +success 0.123 length 123 \d:\d\d:\d\d", last)


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
