"""What a stage says while it works and at its end."""

from __future__ import annotations

import io
import math
import re
import sys
import threading
import time
from pathlib import Path

import pytest

from hypogoal.cli.common import print_outcome
from hypogoal.core import progress
from hypogoal.core.errors import UserError
from hypogoal.core.progress import MetricsLog, Progress
from hypogoal.core.terminal import screen


def test_what_is_not_known_yet_is_not_said(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """A run without a whole episode has no success, and no 'nan' either."""
    monkeypatch.setattr(progress, "FIRST_SECONDS", 0.0)
    monkeypatch.setattr(progress, "PLAIN_INTERVAL_SECONDS", 0.0)
    with Progress("train", total=10) as bar:
        bar.update(5, success=math.nan, loss=0.25)
    said = capsys.readouterr().err
    assert "5/10" in said and "loss 0.25" in said and "nan" not in said and "success" not in said
    print_outcome({"steps": 5, "episodes": 0, "success": math.nan, "loss": 0.25}, quiet=False)
    assert capsys.readouterr().out == "steps 5, episodes 0, loss 0.25\n"


def test_what_others_do_is_counted(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """Spec A6: how far other processes are is asked again and again, so that a line comes while they work."""
    monkeypatch.setattr(progress, "FIRST_SECONDS", 0.0)
    monkeypatch.setattr(progress, "PLAIN_INTERVAL_SECONDS", 0.0)
    monkeypatch.setattr(progress, "LOOK_SECONDS", 0.01)
    asked: list[int] = []
    enough = threading.Event()

    def count() -> int:
        asked.append(len(asked))
        if len(asked) > 5:
            enough.set()
        return len(asked)

    with Progress("train", total=1000) as bar, bar.following(count):
        assert enough.wait(30)
    assert bar.done == len(asked)
    assert re.search(r"^train: 5/1000 \(\d+/s, \d+ s left\)$", capsys.readouterr().err, re.MULTILINE)
    time.sleep(0.05)
    assert bar.done == len(asked), "it is asked no more"


def test_how_long_it_will_take_is_said_early(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """After two seconds, once anything is done, and then every ten; what was done before a resume is no rate."""
    now = 0.0
    monkeypatch.setattr(progress.time, "monotonic", lambda: now)
    bar = Progress("collect", total=1000)
    for step in range(1, 26):
        now = step * 1.0
        bar.update(0 if step < 3 else 10 * step)
    said = [re.search(r"(\d+)/1000 \((.*) left\)", line) for line in capsys.readouterr().err.splitlines()]
    assert [match[1] for match in said if match] == ["30", "130", "230"]
    assert said[0] and said[0][2] == "10/s, 2 min"
    bar.resume(500)
    now += 3
    bar.update(600)
    assert capsys.readouterr().err == "collect: 600/1000 (33/s, 12 s left)\n"


def test_a_bar_has_a_pace_from_its_first_second(monkeypatch: pytest.MonkeyPatch) -> None:
    """Within 80 columns: the time spent until something is done, then the rate."""
    now, drawn = 0.0, io.StringIO()
    monkeypatch.setattr(progress.time, "monotonic", lambda: now)
    monkeypatch.setattr("sys.stderr.isatty", lambda: True, raising=False)
    monkeypatch.setattr(progress, "screen", lambda **_: screen(width=80, file=drawn, force_terminal=True))
    with Progress("train-meta", total=1_500_000) as bar:
        now = 2.0
        assert bar.pace() == "2 s so far"
        bar.update(1_234_567, success=0.123, length=123.0)
        assert bar.pace() == "617,284/s"
        bar.update(1_234_568)
        bar._bar.refresh()
    lines = [re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", line).strip() for line in re.split(r"[\r\n]", drawn.getvalue())]
    last = next(line for line in reversed(lines) if line)
    assert len(last) <= 80 and "1234568/1500000" in last and "617,284/s" in last and "success 0.123" in last, last


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
