"""What a stage says while it works and at its end."""

from __future__ import annotations

import math

import pytest

from hypogoal.cli.common import print_outcome
from hypogoal.core import progress
from hypogoal.core.progress import Progress


def test_what_is_not_known_yet_is_not_said(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """A run without a whole episode has no success, and no 'nan' either."""
    monkeypatch.setattr(progress, "PLAIN_INTERVAL_SECONDS", 0.0)
    with Progress("train", total=10) as bar:
        bar.update(5, success=math.nan, loss=0.25)
    said = capsys.readouterr().err
    assert "5/10" in said and "loss 0.25" in said and "nan" not in said and "success" not in said
    print_outcome({"steps": 5, "episodes": 0, "success": math.nan, "loss": 0.25}, quiet=False)
    assert capsys.readouterr().out == "steps 5, episodes 0, loss 0.25\n"
