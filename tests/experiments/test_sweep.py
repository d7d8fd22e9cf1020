"""Spec G1, G4: the cells of an experiment on this machine: killed, resumed, failed, made in part, looked at."""

import multiprocessing
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace

import pandas as pd
import pytest
from command_line import fails, refuses, run
from toy import DATA, PLAY, SMALL, write_toy

from hypogoal.cells import Cell, read_plan, status_lines
from hypogoal.core.drafts import Draft
from hypogoal.experiments.plan import plan
from hypogoal.experiments.run import PRELOADED, begin, run_local

ROOT = Path(__file__).resolve().parents[2]
WAIT_SECONDS = 300.0


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with ``toy.toml`` and its unbroken run ``out``."""
    folder = tmp_path_factory.mktemp("whole")
    write_toy(folder / "toy.toml", evaluate=True)
    run("run", folder / "toy.toml", "--out", folder / "out", "-q")
    return folder


@pytest.fixture
def out(whole: Path, tmp_path: Path) -> Path:
    """A copy of that run."""
    return Path(shutil.copytree(whole / "out", tmp_path / "out"))


def bytes_of(out: Path) -> dict[str, bytes]:
    """The files of a run but those that say when and by which command it was made."""
    files = [path for path in out.rglob("*") if path.is_file() and "logs" not in path.parts]
    return {
        str(path.relative_to(out)): path.read_bytes()
        for path in files
        if path.name not in ("manifest.json", "sweep.json")
    }


def states(out: Path) -> dict[str, str]:
    return {cell.name: cell.state for cell in read_plan(out)}


def made(out: Path) -> dict[str, int]:
    """When each output was written, in ns."""
    places = {cell.name: out / cell.place for cell in read_plan(out)}
    files = {name: place if place.suffix else place / "manifest.json" for name, place in places.items()}
    return {name: file.stat().st_mtime_ns for name, file in files.items() if file.exists()}


def renewed(before: dict[str, int], out: Path) -> list[str]:
    return [name for name, moment in made(out).items() if moment != before.get(name)]


def begun(*words: object) -> subprocess.Popen[bytes]:
    """The command as a process and a group of its own."""
    environment = {**os.environ, "HYPOGOAL_CHECKPOINT_SECONDS": "0"}
    command = [sys.executable, "-m", "hypogoal", *map(str, words)]
    return subprocess.Popen(command, cwd=ROOT, env=environment, start_new_session=True, stderr=subprocess.DEVNULL)


def test_forked_and_fresh_cells_make_the_same_bytes(whole: Path, tmp_path: Path) -> None:
    """Spec G5: those of ``whole`` are forked where that can be; a fork starts where a fresh process starts."""
    cells, _ = plan(str(whole / "toy.toml"), tmp_path / "fresh", seeds="0")
    chain = cells[:3]
    begin(chain, tmp_path / "fresh")
    said: list[str] = []
    run_local(chain, workers=2, say=said.append, forked=False)
    starts = [line for line in said if " begins; " in line]
    assert [line.split()[0] for line in starts] == [cell.name for cell in chain]
    assert starts[0].endswith("; 2 commands to come") and re.search(
        r"; 1 command to come, about 00:\d\d left$", starts[1]
    )
    assert all(map(find_spec, PRELOADED))
    fresh, forked = bytes_of(tmp_path / "fresh"), bytes_of(whole / "out")
    assert fresh == {name: forked[name] for name in fresh} and len(fresh) > 8


@pytest.mark.parametrize(("sent", "code"), [(signal.SIGTERM, 143), (signal.SIGINT, 130)])
def test_a_signal_has_each_cell_save(whole: Path, tmp_path: Path, sent: signal.Signals, code: int) -> None:
    """Spec G1: 128 + the signal and no process left over; the cell goes on from its checkpoint."""
    toy = tmp_path / "toy.toml"
    toy.write_text((whole / "toy.toml").read_text().replace("steps=20", "steps=100000"))
    out, until = tmp_path / "out", time.monotonic() + WAIT_SECONDS
    process = begun("run", toy, "--out", out, "--seed", "0")
    while not list(out.glob("ensemble/.seed-0.partial/checkpoint/*.safetensors")):
        assert process.poll() is None and time.monotonic() < until
        time.sleep(0.05)
    assert states(out)["ensemble/seed-0"] == "running"
    to_all = sent == signal.SIGINT  # as a terminal sends it
    os.kill(-process.pid if to_all else process.pid, sent)
    assert process.wait() == code
    assert states(out) == {"data": "done"} | dict.fromkeys([cell.name for cell in read_plan(out)[1:]], "waiting")
    ended_by = (out / "logs/ensemble/seed-0.code").read_text()
    assert ended_by in ("143\n", f"{code}\n")  # by Ctrl-C, or by the SIGTERM that follows it
    assert "stopped; the last checkpoint is kept" in (out / "logs/ensemble/seed-0.log").read_text()


def test_what_shares_its_work_among_the_cores_has_them_first(tmp_path: Path) -> None:
    """``after`` holds a cell while the other is made, though it reads nothing of it, and no longer."""
    words = ["collect", "rooms"]
    data, needs = Cell(name="data", words=words, run=tmp_path), ["data.h5"]
    wide = Cell(name="wide", words=words, needs=needs, run=tmp_path)
    other = Cell(name="other", words=words, needs=needs, after=["wide.h5"], run=tmp_path)
    said: list[str] = []
    begin([data, other, wide], tmp_path)
    run_local([data, other, wide], workers=3, say=said.append)
    assert said.index("wide is done") < next(
        place for place, line in enumerate(said) if line.startswith("other begins")
    )
    other.out.unlink()
    wide.out.unlink()
    run_local([other], workers=3, say=said.append)
    assert other.is_done


@pytest.mark.parametrize(("workers", "shares"), [(0, "5 5 5"), (1, "16 16 16"), (2, "8 8 16"), (50, "5 5 5")])
def test_cells_share_the_cores(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, workers: int, shares: str) -> None:
    """Three cells on sixteen cores: as many of them as may run at once leave no core without work."""
    given = []

    class AtOnce:
        """A process that makes its cell's output at once."""

        exitcode = 0

        def __init__(self, target: object, args: tuple[list[str], Path, dict[str, str]]):
            words, _, variables = args
            self.out = Path(words[words.index("--out") + 1])
            given.append(variables["HYPOGOAL_CORES"])

        def start(self) -> None:
            self.out.touch()

        def join(self) -> None:
            pass

    monkeypatch.setattr(multiprocessing, "get_context", lambda kind: SimpleNamespace(Process=AtOnce))
    monkeypatch.setattr("hypogoal.experiments.run.cores", lambda: 16)
    cells = [Cell(name=name, words=["collect", "rooms"], run=tmp_path) for name in "abc"]
    begin(cells, tmp_path)
    run_local(cells, workers=workers, say=print, forked=False)
    assert given == shares.split()


def test_a_cell_that_crashes_goes_on(whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As where an emulator ends with a segmentation fault: said in a line, and the same bytes."""
    monkeypatch.setenv("HYPOGOAL_CHECKPOINT_SECONDS", "0")
    toy, out = tmp_path / "toy.toml", tmp_path / "out"
    toy.write_text((whole / "toy.toml").read_text().replace("steps=20", "steps=80"))
    cells, _ = plan(str(toy), out, seeds="0")
    chain = cells[:2]
    said: list[str] = []
    begin(chain, out)
    running = threading.Thread(target=run_local, args=(chain,), kwargs={"workers": 1, "say": said.append})
    running.start()
    until = time.monotonic() + WAIT_SECONDS
    while not list(out.glob("ensemble/.seed-0.partial/checkpoint/*.safetensors")):
        assert running.is_alive() and time.monotonic() < until
        time.sleep(0.01)
    [child] = multiprocessing.active_children()
    assert child.pid is not None
    os.kill(child.pid, signal.SIGSEGV)
    running.join()
    assert said[-2].startswith("ensemble/seed-0 begins; 0 commands to come") and said[-1] == "ensemble/seed-0 is done"
    assert any(re.match(r"ensemble/seed-0 crashed \(signal (6|11)\): it goes on", line) for line in said)
    unbroken = tmp_path / "unbroken"
    run("train-ensemble", out / "data.h5", "--out", unbroken, "-q", *SMALL.replace("20", "80").split(), "--seed", "0")
    name = "right-room.safetensors"
    assert (out / "ensemble/seed-0" / name).read_bytes() == (unbroken / name).read_bytes()


FAILS = f"""
[[cells]]
name = "worse"
command = "train-ensemble {{data}} {SMALL} --set sub_goals=nowhere"

[[cells]]
name = "lost"
command = "train-meta {{worse}} {PLAY}"
"""


def test_no_two_rows_of_results_differ_in_the_value_alone(whole: Path) -> None:
    """An agent and uniform-random choice among its own options are two methods, so no mean mixes them."""
    rows = pd.read_csv(whole / "out" / "evaluation" / "results.csv")
    assert rows.loc[rows["stage"] == "train-meta", "measured_method"].nunique() > 1
    assert not rows.drop(columns="value").duplicated().any()


def test_a_cell_begun_otherwise_is_told_as_a_part_of_its_run(whole: Path, out: Path) -> None:
    """Spec G2: --force is for a command; for a run it would make everything anew."""
    cell = next(cell for cell in read_plan(out) if cell.stage == "train-meta")
    shutil.copytree(cell.out, cell.draft.files)
    shutil.move(cell.draft.files / "manifest.json", cell.draft.begun)
    cell.draft.checkpoint.mkdir()
    (cell.draft.checkpoint / "0.safetensors").touch()
    cell.draft.begun.write_text(re.sub('"hypogoal": "[^"]*"', '"hypogoal": "0.1"', cell.draft.begun.read_text()))
    shutil.rmtree(cell.out)
    err = fails("run", whole / "toy.toml", "--out", out, "--resume", "-q").err
    assert "Give --from train-meta and no --resume to make that stage anew" in err and "--force" not in err


def test_a_cell_that_fails_holds_only_those_that_need_it(whole: Path, out: Path, tmp_path: Path) -> None:
    """Spec G4: told in one line with its log, at the end; the status says what waits; mended, only that is run.

    What was evaluated of fewer cells is evaluated again.
    """
    toy = write_toy(tmp_path / "toy.toml", "0-1", FAILS, evaluate=True)
    err = fails("run", toy, "--out", out, "--resume", "-q").err
    assert err.count("\n") == 1 and "5 of 9 cells done, 1 failed, 3 waiting: failed worse: " in err
    assert str(out / "logs/worse.log") in err and "nowhere" in err
    found = states(out)
    assert [name for name, state in found.items() if state == "failed"] == ["worse"]
    waiting = ["lost", "evaluation", "report"]
    assert [name for name, state in found.items() if state == "waiting"] == waiting
    head, *lines = run("status", out).out.splitlines()[:3]
    assert head == f"{out}: 5 of 9 cells done, 1 failed, 3 waiting"
    assert lines[0].startswith("  failed worse: ") and "nowhere" in lines[0]
    before = made(out)
    toy.write_text(toy.read_text().replace(" --set sub_goals=nowhere", ""))
    run("run", toy, "--out", out, "--resume", "-q")
    assert {*states(out).values()} == {"done"}
    assert renewed(before, out) == ["worse", *waiting]
    assert "\nlost,train-meta,lost," in (out / "evaluation" / "results.csv").read_text()


def test_a_stage_made_again(whole: Path, out: Path) -> None:
    """Spec I7: ``--only`` a stage, also with other settings; ``--from`` it all that needs it, the same bytes as before.

    A setting of what is kept is refused.
    """
    agents, closing, expected = ["agent/seed-0", "agent/seed-1"], ["evaluation", "report"], bytes_of(out)
    other = out.parent / "toy.toml"
    other.write_text((whole / "toy.toml").read_text().replace("steps=200", "steps=208"))
    before = made(out)
    refuses("began agent/seed-0 otherwise: train-meta ", "run", other, "--out", out, "--resume", "-q")
    refuses("otherwise", "run", other, "--out", out, "--from", "evaluate", "-q")
    assert renewed(before, out) == []
    for toy, given, again, waiting in (
        (other, ["--only", "train-meta"], agents, closing),
        (other, ["--resume"], closing, []),
        (whole / "toy.toml", ["--from", "train-meta"], [*agents, *closing], []),
    ):
        before = made(out)
        run("run", toy, "--out", out, "-q", *given)
        assert renewed(before, out) == again
        assert [name for name, state in states(out).items() if state != "done"] == waiting
    same = [name for name in expected if name.endswith((".csv", ".safetensors"))]
    assert [name for name in same if bytes_of(out)[name] != expected[name]] == []


def test_force_makes_all_again(tmp_path: Path) -> None:
    """And what was made by a cell that is none any more is gone."""
    toy, out, head = tmp_path / "toy.toml", tmp_path / "out", "format = 1\nevaluate = false\n"
    data, other = (f'[[cells]]\nname = "{name}"\ncommand = "{DATA}"\n' for name in ("data", "other"))
    toy.write_text(head + data + other)
    run("run", toy, "--out", out, "-q")
    before = made(out)
    toy.write_text(head + data)
    run("run", toy, "--out", out, "-q", "--force")
    assert renewed(before, out) == ["data"] and not (out / "other.h5").exists()


def test_what_a_run_refuses(whole: Path, out: Path, tmp_path: Path) -> None:
    """Spec G2: one line each, and nothing is changed."""
    toy, there, before = whole / "toy.toml", tmp_path / "there", made(out)
    there.write_text("mine")
    for words, told in (
        (["--out", out], "the run exists already"),
        (["--out", out, "--resume", "--seed", "0"], "began ensemble/seed-1 otherwise"),
        (["--out", out, "--resume", "--set", "seed=x"], "seed"),
        (["--out", out, "--from", "train-option"], "needs one stage of the run: train-option. Choose one of collect,"),
        (["--out", out, "--from", "collect", "--only", "evaluate"], "needs one stage of the run"),
        (["--out", out, "--resume", "--engine", "cloud"], "'cloud' is not one of 'local', 'slurm'"),
        (["--out", there], "exists already"),
    ):
        refuses(told, "run", toy, "-q", *words)
    assert "what they need is not made" in fails("run", toy, "-q", "--out", tmp_path / "new", "--only", "report").err
    refuses("unknown experiment", "run", "figure7", "--out", out, "-q")
    assert renewed(before, out) == []


@pytest.mark.parametrize("damage", ["", '{"format": 3, "cells": []}', '[{"name": "../x", "words": ["report"]}]'])
def test_a_damaged_plan_is_told(whole: Path, tmp_path: Path, damage: str) -> None:
    """Spec G2: by whatever reads it; without it the same command goes on with what is there."""
    (tmp_path / "sweep.json").write_text(damage)
    for words in (["run", whole / "toy.toml", "--out", tmp_path, "--resume", "-q"], ["status", tmp_path]):
        refuses("the plan cannot be read", *words)


def test_what_another_process_makes_is_waited_for(out: Path) -> None:
    """Spec G4: a cell left over by a run that was killed holds its lock; neither made twice nor removed meanwhile."""
    cells, place = read_plan(out), out / "agent/seed-1"
    place.rename(out / "aside")
    with Draft(place).locked():
        assert states(out)["agent/seed-1"] == "running"
        assert "1 running" in status_lines(out)[0]
        said: list[str] = []
        thread = threading.Thread(target=run_local, args=(cells,), kwargs={"workers": 1, "say": said.append})
        thread.start()
        time.sleep(1.0)
        assert thread.is_alive() and said == []
        (out / "aside").rename(place)
    thread.join(WAIT_SECONDS)
    assert not thread.is_alive() and said == [] and status_lines(out) == []
