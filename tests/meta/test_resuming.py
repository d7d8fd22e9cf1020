"""Spec G1: options played, learned and chosen go on after a break as if there had been none, to the last bit."""

import json
from pathlib import Path
from typing import Any

import pytest
import torch
from breaking import Breaking, Broken
from corridor import Corridor
from loops import CASES, loop_of

from hypogoal.core.checkpoints import Checkpoints
from hypogoal.core.progress import MetricsLog, Progress
from hypogoal.domains import episodes
from hypogoal.meta import training
from hypogoal.options import recording
from hypogoal.options.loop import OptionLoop

STEPS, BREAKS = 210, (23, 51)  # environment steps, and the steps of the loop after which it breaks


def run(case: str, folder: Path, checkpoints: Checkpoints, until: float = 0.0, steps: int = STEPS) -> OptionLoop:
    loop = loop_of(case)
    log, progress = MetricsLog(folder / "metrics.jsonl"), Progress("", 0, quiet=True)
    solved = training.train(loop, steps, log, progress, checkpoints, until)
    assert solved == (loop.recorder.steps < steps)
    return loop


@pytest.mark.usefixtures("small_gru")
@pytest.mark.parametrize("case", CASES)
def test_breaks_leave_no_trace(case: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Spec G1: networks, optimisers, replays, choices, episodes, verdicts, generators, log, after two breaks."""
    monkeypatch.setattr(training, "LOG_INTERVAL", 50)
    monkeypatch.setattr(recording, "WINDOW", 40)  # which begins at another step than the run
    (tmp_path / "unbroken").mkdir()
    (tmp_path / "broken").mkdir()
    unbroken = run(case, tmp_path / "unbroken", Checkpoints(None))
    path = tmp_path / "broken" / "checkpoint.safetensors"
    for last in BREAKS:
        before = Breaking(path, last + 5, saves=(last // 2, last))
        before.steps = 0 if last == BREAKS[0] else BREAKS[BREAKS.index(last) - 1]
        with pytest.raises(Broken):
            run(case, tmp_path / "broken", before)
    resumed = run(case, tmp_path / "broken", Checkpoints(path))

    for folder in ("unbroken", "broken"):
        loop = unbroken if folder == "unbroken" else resumed
        loop.recorder.write(tmp_path / folder)
        loop.recorder.write_exploits(tmp_path / folder, loop.terminations.of_running, loop.terminations.log_odds)
        Checkpoints(tmp_path / folder / "checkpoint.safetensors").save(loop.snapshot())
    tables = ("episodes.csv", "choices.csv", "exploits.csv")
    for name in ("metrics.jsonl", *tables, "terminations.h5", "checkpoint.safetensors"):
        one, other = (tmp_path / folder / name for folder in ("unbroken", "broken"))
        assert one.read_bytes() == other.read_bytes(), name
    weights = unbroken.learner.state()  # type: ignore[attr-defined]
    fresh = loop_of(case).learner.state()  # type: ignore[attr-defined]
    assert any(not torch.equal(value, fresh[name]) for name, value in weights.items()), "nothing was learned"


@pytest.mark.parametrize(("until", "reached"), [(0.9, True), (1.0, False)])
def test_training_that_succeeds_ends_whatever_breaks_it(
    until: float, reached: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At the first step by which so many of the last episodes succeeded, else at its limit; the log says which."""
    monkeypatch.setattr(episodes, "LAST", 20)
    monkeypatch.setattr(training, "LOG_INTERVAL", 50)
    case, folders = "light, shared, gaussian", (tmp_path / "unbroken", tmp_path / "broken")
    for folder in folders:
        folder.mkdir()
    run(case, folders[0], Checkpoints(None), until, 300)
    path = folders[1] / "checkpoint.safetensors"
    with pytest.raises(Broken):
        run(case, folders[1], Breaking(path, 28, saves=(11, 23)), until, 300)
    loop = run(case, folders[1], Checkpoints(path), until, 300)
    one, other = ((folder / "metrics.jsonl").read_bytes() for folder in folders)
    assert one == other
    last = json.loads(one.splitlines()[-1])
    assert (last["step"], last["until_reached"]) == (loop.recorder.steps, reached)
    shares = [
        sum(episode.reward > 0 for episode in loop.recorder.episodes.rows[: n + 1][-20:]) / 20
        for n in range(19, last["episodes"])
    ]
    first = [
        episode.step for episode, share in zip(loop.recorder.episodes.rows[19:], shares, strict=True) if share >= until
    ]
    assert first == ([last["step"]] * len(first) if reached else []) and bool(first) == reached


class Plain(Corridor):
    """An own domain's engine, which gives no snapshots."""

    resumes = False

    def snapshot(self) -> Any:
        raise AssertionError("nobody asks who cannot")


def test_an_engine_without_snapshots_begins_anew(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Spec B6, G1: own domains need none; what is played there saves no checkpoint."""
    monkeypatch.setitem(CASES, "plain", (Plain, "light", {}, "random"))
    checkpoints = Breaking(tmp_path / "checkpoint.safetensors", 6, saves=(1,))
    assert run("plain", tmp_path, checkpoints).recorder.steps == STEPS
    assert checkpoints.load() is None and checkpoints.steps == 0
