"""Options that learn while a second process plays (``play_ahead``): the same bytes as in one process (Spec G1, G2)."""

from __future__ import annotations

import multiprocessing
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hypogoal.cli import main
from hypogoal.core.checkpoints import PACE
from hypogoal.core.drafts import draft_folder
from hypogoal.core.errors import Killed, UserError
from hypogoal.core.workers import CORES, Companion
from hypogoal.domains import montezuma
from hypogoal.domains.montezuma_ahead import AheadEngine
from hypogoal.domains.montezuma_emulator import N_ACTIONS
from hypogoal.domains.montezuma_engine import MontezumaEngine
from tests.attacks.kills import STAGES, differences, needed

ROOT = Path(__file__).resolve().parents[2]
WAIT_SECONDS = 120.0
SMALL: dict[str, Any] = {"start_states": 3, "max_steps": 12, "memory": 60}


def children_of(process: int) -> list[int]:
    """The processes that a process has started."""
    pairs = []
    for entry in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = entry.read_text().rpartition(")")[2].split()
        except OSError:  # it has ended meanwhile
            continue
        pairs.append((int(fields[1]), int(entry.parent.name), fields[0]))
    return [child for parent, child, state in pairs if parent == process and state != "Z"]


def wait_for(holds: Callable[[], Any]) -> Any:
    until = time.monotonic() + WAIT_SECONDS
    while not (answer := holds()):
        assert time.monotonic() < until
        time.sleep(0.02)
    return answer


# The second process


def doubling(limit: int) -> Callable[[int], int]:
    def double(number: int) -> int:
        if number > limit:
            raise UserError("too large", number, "Ask for less.")
        return 2 * number

    return double


def process_itself() -> Callable[[int], int]:
    return lambda _: os.getpid()


def test_a_companion_answers_in_order_and_its_errors_are_ours() -> None:
    companion = Companion(doubling, 5)
    for number in (1, 2):
        companion.send(number)
    assert [companion.receive(), companion.receive()] == [2, 4]
    companion.send(6)
    with pytest.raises(UserError, match=r"too large: 6\. Ask for less\."):
        companion.receive()


def test_a_companion_that_is_killed_is_one_line_and_ends_with_us() -> None:
    """Spec G2: whether it is killed before it is asked or while it is waited for; nothing is left where it was kept."""
    companion = Companion(process_itself)
    companion.send(0)
    process = companion.receive()
    os.kill(process, signal.SIGTERM)  # as a cancelled job gets it, which still has a checkpoint to write
    companion.send(0)
    assert companion.receive() == process
    os.kill(process, signal.SIGKILL)
    for _ in range(2):
        companion.send(0)
        with pytest.raises(Killed, match="lack of memory"):
            companion.receive()
    other = Companion(process_itself)
    other.send(0)
    process = other.receive()
    del other
    wait_for(lambda: process not in children_of(os.getpid()))


# The engine


@pytest.mark.atari
def test_what_it_says_is_what_the_plain_engine_says() -> None:
    """Spec G1: steps, pictures, labels, restarts and snapshots, begun ahead or not, and resumed from one another."""
    rng, plain, ahead = np.random.default_rng(0), *(kind("1L", 2, **SMALL) for kind in (MontezumaEngine, AheadEngine))
    for number in range(90):
        actions = rng.integers(N_ACTIONS, size=2)
        if number % 3:
            ahead.begin_step(actions)
            kept = ahead.n_states, ahead.ids.tolist(), ahead.images(ahead.ids)
            assert kept[:2] == (plain.n_states, plain.ids.tolist()) and np.array_equal(kept[2], plain.images(plain.ids))
        one, other = plain.step(actions), ahead.step(actions)
        assert all(np.array_equal(a, b) for a, b in zip(one[:4], other[:4], strict=True))
        if number % 7 == 0:
            for engine in (plain, ahead):
                engine.restart(np.array([number % 2 == 0, True]))
        assert plain.ids.tolist() == ahead.ids.tolist() and plain.elapsed.tolist() == ahead.elapsed.tolist()
        seen = np.concatenate([one.next_ids, plain.ids])
        assert np.array_equal(plain.images(seen), ahead.images(seen))
        assert np.array_equal(plain.positions(seen), ahead.positions(seen))
        assert np.array_equal(plain.labels(seen), ahead.labels(seen))
        if number % 10 == 7:
            saved, same = plain.snapshot(), ahead.snapshot()
            assert saved.keys() == same.keys()
            assert all(np.array_equal(values, same[name]) for name, values in saved.items())
            plain.step(np.array([1, 1]))
            ahead.begin_step(np.array([2, 3]))  # what it was doing is forgotten
            ahead.step(np.array([2, 3]))
            plain.restore(same)
            ahead.restore(saved)
    with pytest.raises(IndexError, match="actions are 2 numbers"):
        ahead.begin_step(np.array([0, N_ACTIONS]))


# The stage


@pytest.fixture(scope="module")
def climbers(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder with what the stage ``ahead`` of the kill harness reads."""
    folder = tmp_path_factory.mktemp("ahead")
    for name in needed(["ahead"])[:-1]:
        stage = STAGES[name]
        assert main([*stage.arguments(folder), "--out", str(folder / f"{name}{stage.suffix}"), "-q"]) == 0
    return folder


class InOneProcess(MontezumaEngine):
    """What ``play_ahead`` is to do, written plainly: the loop learns first and plays then."""

    ahead = True


def train(folder: Path, out: str, *changes: str) -> Path:
    words = [*STAGES["ahead"].arguments(folder), "--out", str(folder / out), "-q"]
    assert main([*words, *(word for pair in changes for word in ("--set", pair))]) == 0
    return folder / out


@pytest.mark.atari
def test_options_are_those_of_one_process_in_the_same_order(climbers: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Spec G1: every file of the artefact. Learning a step later is another order, and gives other bytes."""
    changes = ("steps=400", "termination=oracle")
    usual = train(climbers, "usual", *changes, "play_ahead=false")
    ahead = train(climbers, "ahead", *changes)
    wait_for(lambda: not multiprocessing.active_children())
    monkeypatch.setattr(montezuma, "AheadEngine", InOneProcess)
    plain = train(climbers, "plain", *changes)
    assert differences(plain, ahead) == []
    assert "options.safetensors" in differences(usual, ahead)


@pytest.mark.atari
def test_nobody_is_left_behind_and_a_break_leaves_no_trace(climbers: Path) -> None:
    """Spec G1: Ctrl-C, SIGTERM and SIGKILL end both processes; then it goes on to the same bytes."""
    long = ("steps=1500", "termination=oracle")
    unbroken, out = train(climbers, "unbroken", *long), climbers / "broken"
    settings = [word for pair in long for word in ("--set", pair)]
    command = [*STAGES["ahead"].arguments(climbers), *settings, "--out", str(out), "-q", "--resume"]
    for number in (signal.SIGINT, signal.SIGKILL, signal.SIGTERM):
        before = checkpoint_of(out)
        with subprocess.Popen(
            [sys.executable, "-m", "hypogoal", *command],
            cwd=ROOT,
            env={**os.environ, PACE: "0.05"},
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
        ) as process:
            wait_for(lambda before=before: checkpoint_of(out) not in (None, before))
            children = children_of(process.pid)
            assert children, "who plays?"
            if number == signal.SIGKILL:
                process.kill()
            else:
                os.killpg(process.pid, number)  # as a terminal does, and a cluster
            _, words = process.communicate()
        if number != signal.SIGKILL:
            assert process.returncode == 128 + number and words.count("\n") == 1, words
            assert words.startswith("hypogoal: stopped; the last checkpoint is kept")
        wait_for(lambda children=children: not any(Path(f"/proc/{child}").exists() for child in children))
    assert main(command) == 0
    assert differences(unbroken, out) == []


def checkpoint_of(out: Path) -> float | None:
    """When the last checkpoint of an output was written."""
    times = [path.stat().st_mtime for path in draft_folder(out).glob("checkpoint/*.safetensors")]
    return max(times, default=None)


@pytest.mark.atari
def test_whose_second_process_dies_says_so_in_one_line(climbers: Path) -> None:
    """Spec G2: exit code 2, and how to go on."""
    out = climbers / "dying"
    settings = ["--set", "steps=100000", "--set", "termination=oracle"]
    command = [*STAGES["ahead"].arguments(climbers), *settings, "--out", str(out), "-q"]
    with subprocess.Popen(
        [sys.executable, "-m", "hypogoal", *command],
        cwd=ROOT,
        env={**os.environ, PACE: "0.05"},
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        wait_for(lambda: checkpoint_of(out))
        for child in children_of(process.pid):
            if b"resource_tracker" not in Path(f"/proc/{child}/cmdline").read_bytes():
                os.kill(child, signal.SIGKILL)
        _, words = process.communicate()
    assert process.returncode == 2
    assert words == (
        "hypogoal: the second process was killed by the system, most likely for lack of memory. Free some memory; the "
        "last checkpoint is kept: give the same command with --resume to continue\n"
    )


def test_where_nothing_plays_ahead_it_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Spec G2: in domains without it, on one core, and in sweeps: one line, and nothing is begun."""
    from hypogoal.domains.base import load_domain
    from hypogoal.meta.config import TrainOptionsConfig
    from hypogoal.meta.training import start_arguments

    config = TrainOptionsConfig(play_ahead=True, start="1L")
    assert start_arguments(montezuma.DOMAIN, config, 1, 0)["play_ahead"] is True
    with pytest.raises(UserError, match=r"doorkey, play_ahead=true\. Leave it out\."):
        start_arguments(load_domain("doorkey"), TrainOptionsConfig(play_ahead=True), 1, 0)
    monkeypatch.setenv(CORES, "1")
    with pytest.raises(UserError, match=f"needs two cores.*{CORES}=1"):
        start_arguments(montezuma.DOMAIN, config, 1, 0)
    monkeypatch.delenv(CORES)
    command = ["run", "montezuma-ladders", "--preset", "demo", "--out", str(tmp_path / "run")]
    assert main([*command, "--set", "train-options.play_ahead=true"]) == 2
    err = capsys.readouterr().err
    assert "play_ahead is for single runs" in err and err.count("\n") == 1 and not (tmp_path / "run").exists()
