"""A run that release 1.0.3 made, as it lies in data/: what today's code reads, goes on with, or refuses in a line.

It has an ensemble of rooms, options, an agent that continues these, and options whose training was killed.
"""

import tarfile
from pathlib import Path

import numpy as np
import pytest
from command_line import refuses, run, settings

import hypogoal
from hypogoal.data import open_dataset

ARCHIVE = Path(__file__).parent / "data" / "run-1.0.3.tar.xz"
SMALL = settings("steps=100", "environments=4", "warm_up=20", "replay=200")


@pytest.fixture
def earlier(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The run's folder."""
    with tarfile.open(ARCHIVE) as archive:
        archive.extractall(tmp_path, filter="data")
    monkeypatch.chdir(tmp_path)
    return Path("run")


def test_it_is_read_and_evaluated(earlier: Path) -> None:
    """Ensemble, options and agent play and are told as a run of today's."""
    assert run("verify", earlier).out.startswith("run: whole so far")
    assert "meta: meta; success 0.12" in run("show", earlier / "meta").out
    told = run("evaluate", earlier).out
    assert "D-BAT, 2 members" in told and "option agent" in told
    states = open_dataset(earlier / "data.h5").unlabelled()
    predictions = hypogoal.load_ensemble(earlier / "ensemble", "right-room").predict(states)
    assert predictions.shape == (16, 2) and np.isfinite(predictions).all()
    assert hypogoal.load_options(earlier / "meta", earlier / "ensemble").count == 2


def test_its_options_are_continued(earlier: Path) -> None:
    """Settings in its manifest hold under their flat names."""
    out = earlier / "again"
    more = ("--options", earlier / "options", "--chooser", "ppo", *settings("decisions=32"), *SMALL)
    run("train-meta", earlier / "ensemble", *more, "--layout-seed", 5, "--out", out)
    first, *_ = (out / "episodes.csv").read_text().splitlines()[1:]
    assert first == (earlier / "options" / "episodes.csv").read_text().splitlines()[1]


def test_what_was_interrupted_is_begun_anew(earlier: Path) -> None:
    """Its checkpoint has another format: one line says so, and nothing is lost."""
    words = [*SMALL, *settings("steps=3000"), "--layout-seed", 5, "--out", earlier / "unfinished", "--resume"]
    line = refuses("another version of hypogoal wrote this checkpoint", "train-options", earlier / "ensemble", *words)
    assert line.endswith("Give --force and no --resume to begin anew.")
