"""Spec I7: ``--from`` and ``--only``: a stage and what needs it made again, in a real run of some seconds."""

import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest
from command_line import refuses, run
from forked import forked
from toy import write_toy

from hypogoal.core.drafts import unfinished
from hypogoal.experiments.records import read_plan
from hypogoal.experiments.status import read_status

ROOT = Path(__file__).resolve().parents[2]
PLAY = "--set option_timeout=5 --set warm_up=100 --set max_episode_steps=20 --set random_episodes=1"
AGENT = f"""
[[cells]]
name = "options"
command = "train-options {{ensemble}} --steps 60 --set layout_seed=101 {PLAY}"

[[cells]]
name = "meta"
command = "train-meta {{ensemble}} --options {{options}} --steps 60 --set layout_seed=101 {PLAY}"
"""
CELLS = {"data": "data.h5", "ensemble": "ensemble", "options": "options", "meta": "meta", "evaluate": "evaluation"}


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with ``toy.toml`` and its complete run ``out``."""
    folder = tmp_path_factory.mktemp("again")
    toy = write_toy(folder / "toy.toml", "0", AGENT)
    text = toy.read_text().replace('evaluate = false\naxes = { seed = "0" }', "evaluate = true")
    toy.write_text(text.replace('axes = ["seed"]\n', "").replace("--seed {seed} ", ""))
    with forked():
        run("run", toy, "--out", folder / "out", "-q")
    return folder


@pytest.fixture
def out(whole: Path, tmp_path: Path) -> Path:
    """A copy of that run."""
    return Path(shutil.copytree(whole / "out", tmp_path / "out"))


def made(out: Path) -> dict[str, int]:
    """When each output was written, in ns."""
    places = {name: out / place for name, place in CELLS.items()}
    files = {name: place if place.is_file() else place / "manifest.json" for name, place in places.items()}
    return {name: file.stat().st_mtime_ns for name, file in files.items()}


def renewed(before: dict[str, int], out: Path) -> list[str]:
    return [name for name, moment in made(out).items() if moment != before[name]]


def states(out: Path) -> dict[str, str]:
    return {one.cell.name: one.state for one in read_status(out).states}


@pytest.mark.usefixtures("forked_cells")
def test_from_makes_a_stage_and_all_that_needs_it_again(whole: Path, out: Path) -> None:
    """And no more; from the same settings the same bytes; then everything is done."""
    before, weights = made(out), (out / "meta" / "meta.safetensors").read_bytes()
    run("run", whole / "toy.toml", "--out", out, "--from", "train-options", "-q")
    assert renewed(before, out) == ["options", "meta", "evaluate"]
    assert (out / "meta" / "meta.safetensors").read_bytes() == weights
    assert {*states(out).values()} == {"done"} and (out / "run.json").is_file() and not read_plan(out).anew


@pytest.mark.usefixtures("forked_cells")
def test_only_makes_a_stage_again_and_the_rest_later(whole: Path, out: Path) -> None:
    """What needs it is out of date, is in no results, and is made when the run is resumed."""
    before, words = made(out), ["run", str(whole / "toy.toml"), "--out", str(out)]
    told = run(*words, "--only", "train-options")
    assert "1 cell made anew; 3 out of date, which are made without --only\n" in told.err
    assert told.out.splitlines() == [str(out / "results.csv")]
    assert renewed(before, out) == ["options"]
    assert [name for name, state in states(out).items() if state != "done"] == ["meta", "evaluate", "report"]
    assert "meta," not in (out / "results.csv").read_text() and not (out / "run.json").exists()
    run(*words, "--resume", "-q")
    assert renewed(before, out) == ["options", "meta", "evaluate"]


@pytest.mark.usefixtures("forked_cells")
def test_a_stage_made_again_may_have_other_settings(whole: Path, out: Path) -> None:
    """As a user of Make expects: change a setting, keep what is before it; a setting of what is kept is refused."""
    toy = out.parent / "toy.toml"
    toy.write_text((whole / "toy.toml").read_text().replace("train-meta {ensemble}", "train-meta {ensemble} --seed 1"))
    before = made(out)
    refuses("--from STAGE", "run", toy, "--out", out, "--resume", "-q")
    refuses("meta of the sweep here was begun with", "sweep", toy, "--out", out, "--from", "evaluate", "-q")
    assert renewed(before, out) == []
    run("sweep", toy, "--out", out, "--from", "train-meta", "-q")
    assert renewed(before, out) == ["meta", "evaluate"]
    assert {*states(out).values()} == {"done"}


def test_killed_halfway_it_resumes(whole: Path, out: Path) -> None:
    """Spec G1: SIGKILL within the stage: the same command with --resume makes the rest, and what is made stays."""
    before, weights = made(out), (out / "meta" / "meta.safetensors").read_bytes()
    words = ["run", str(whole / "toy.toml"), "--out", str(out), "--from", "train-options", "-q"]
    environment = {**os.environ, "HYPOGOAL_CHECKPOINT_SECONDS": "0"}
    with subprocess.Popen([sys.executable, "-m", "hypogoal", *words], cwd=ROOT, env=environment) as process:
        until = time.monotonic() + 300.0
        while not unfinished(out / "meta"):
            assert process.poll() is None and time.monotonic() < until
            time.sleep(0.01)
        process.kill()
    between = made(out)
    assert renewed(before, out) == ["options"]
    assert states(out)["meta"] != "done"
    with forked():
        run(*words, "--resume")
    assert renewed(between, out) == ["meta", "evaluate"]
    assert (out / "meta" / "meta.safetensors").read_bytes() == weights
    assert {*states(out).values()} == {"done"}


def test_a_dry_run_shows_what_would_run(whole: Path, out: Path) -> None:
    """Nothing is written."""
    before = sorted(path for path in out.rglob("*"))
    words = ["run", str(whole / "toy.toml"), "--out", str(out), "--dry-run"]
    for given, stages in (
        (["--from", "train-meta"], ["train-meta", "evaluate", "report"]),
        (["--only", "train-ensemble"], ["train-ensemble"]),
        (["--from", "collect"], ["collect", "train-ensemble", "train-options", "train-meta", "evaluate", "report"]),
    ):
        printed = run(*words, *given)
        assert [line.split()[1] for line in printed.out.splitlines()] == stages
    assert sorted(path for path in out.rglob("*")) == before


def test_what_cannot_be_made_again_is_one_line(whole: Path, out: Path) -> None:
    """Spec G2: an unknown stage, both options, and a stage whose inputs are not there."""
    before, toy = made(out), str(whole / "toy.toml")
    for command in ("run", "sweep"):
        for given, words in (
            (["--from", "train-option"], "Choose one of collect, train-ensemble, train-options, train-meta, evaluate"),
            (["--only", "audit"], "this run has no such stage: audit"),
            (["--from", "collect", "--only", "evaluate"], "cannot both be given"),
        ):
            refuses(words, command, toy, "--out", out, "-q", *given)
    assert renewed(before, out) == []
    nowhere = out.parent / "nowhere"
    words_of_command = ["run", toy, "--out", nowhere, "--only", "train-options", "-q"]
    refuses(f"options needs what is not made yet: {nowhere / 'ensemble'}", *words_of_command)
    assert not nowhere.exists() or not any(nowhere.iterdir())
