"""Spec G4: a sweep on this machine, killed, failed, extended, looked at."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from command_line import fails, refuses, run
from forked import forked
from toy import DATA, SMALL, write_toy

from hypogoal.core.drafts import unfinished
from hypogoal.core.errors import UserError
from hypogoal.experiments.cells import Cell
from hypogoal.experiments.records import (
    GIVE,
    LostPlan,
    Record,
    is_running,
    open_log,
    read_plan,
    read_record,
    write_plan,
    write_record,
)
from hypogoal.experiments.runners.local import Running, run_cells
from hypogoal.experiments.runners.slurm import Options
from hypogoal.experiments.status import read_status
from hypogoal.stages.sweep import gather, plan, submit
from hypogoal.stages.sweep import run as run_plan

ROOT = Path(__file__).resolve().parents[2]
WAIT_SECONDS = 300.0


@pytest.fixture(scope="module")
def swept(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with ``toy.toml`` and its unbroken sweep ``whole``."""
    folder = tmp_path_factory.mktemp("sweep")
    write_toy(folder / "toy.toml")
    with forked():
        run("sweep", folder / "toy.toml", "--out", folder / "whole", "-q")
    return folder


def killed(arguments: list[str], moment: Callable[[], bool]) -> None:
    """Start a sweep as a process of its own and kill it when ``moment`` has come."""
    environment = {**os.environ, "HYPOGOAL_CHECKPOINT_SECONDS": "0"}
    command = [sys.executable, "-m", "hypogoal", *arguments]
    until = time.monotonic() + WAIT_SECONDS
    with subprocess.Popen(command, cwd=ROOT, env=environment) as process:
        while not moment():
            assert process.poll() is None and time.monotonic() < until
            time.sleep(0.01)
        process.kill()
        assert process.wait() == -signal.SIGKILL


def test_a_killed_sweep_ends_with_the_same_results(swept: Path) -> None:
    """Spec G1, G4: SIGKILL while an ensemble is trained; then the same bytes, and nothing complete is made again.

    Here cells are started as a user's are; those of ``swept`` are forked, and make the same.
    """
    out = swept / "broken"
    arguments = ["sweep", str(swept / "toy.toml"), "--out", str(out), "-q"]
    killed(arguments, lambda: unfinished(out / "ensemble/seed-0"))
    made = (out / "data.h5").stat().st_mtime_ns
    run(*arguments)
    assert (out / "data.h5").stat().st_mtime_ns == made
    assert (out / "results.csv").read_bytes() == (swept / "whole" / "results.csv").read_bytes()
    for name in ("data.h5", "ensemble/seed-0/metrics.jsonl", "ensemble/seed-1/open-red-door.safetensors"):
        assert (out / name).read_bytes() == (swept / "whole" / name).read_bytes()


def test_results_are_a_row_for_each_number_of_each_cell(swept: Path) -> None:
    """Spec G4: tidy, axes as columns, no machine, time or path in it."""
    lines = (swept / "whole" / "results.csv").read_text().splitlines()
    assert lines[0] == "cell,stage,group,seed,sub_goal,member,scope,number,value"
    rows = [dict(zip(lines[0].split(","), line.split(","), strict=True)) for line in lines[1:]]
    states = [row for row in rows if row["cell"] == "data" and row["number"] == "states"]
    assert {row["value"] for row in states if row["scope"] == "labelled"} == {"1640"}
    steps = {(row["seed"], row["sub_goal"], row["value"]) for row in rows if row["number"] == "step"}
    assert steps == {("0", "open-red-door", "6"), ("1", "open-red-door", "6")}
    assert str(swept) not in "\n".join(lines)


@pytest.fixture(scope="module")
def extended(swept: Path) -> tuple[list[str], dict[str, int]]:
    """The same sweep begun with one seed, started again, then given the other: its command, each cell's attempts."""
    out = swept / "extended"
    arguments = ["sweep", str(swept / "toy.toml"), "--out", str(out), "-q"]
    with forked():
        for seeds in ("0", "0", "0-1"):
            run(*arguments, "--seeds", seeds)
    return arguments, {cell.name: read_record(out, cell).attempts for cell in read_plan(out).cells}


def test_finished_cells_are_never_run_again_and_new_ones_are_added(
    swept: Path, extended: tuple[list[str], dict[str, int]]
) -> None:
    """Spec G4: started again nothing runs; with one more seed only that seed does; another sweep is refused."""
    assert extended[1] == {"data": 1, "ensemble-seed-0": 1, "ensemble-seed-1": 1}
    assert (swept / "extended/results.csv").read_bytes() == (swept / "whole/results.csv").read_bytes()


def test_another_sweep_is_refused(swept: Path, tmp_path: Path) -> None:
    """Spec G2: a folder is of one experiment: no cell of before may be missing or be another."""
    out = str(swept / "whole")
    other = tmp_path / "toy.toml"
    other.write_text((swept / "toy.toml").read_text().replace("steps=6", "steps=7"))
    for arguments, words in (
        (["sweep", str(other), "--out", out], "ensemble-seed-0 of the sweep here was begun with '--set steps=6'"),
        (["sweep", str(swept / "toy.toml"), "--out", out, "--seeds", "1-2"], "this one lacks: ensemble-seed-0"),
        (["sweep", "figure6", "--out", out], "data of the sweep here was begun with"),
        (["sweep", "figure7", "--out", out], "unknown experiment"),
        (["sweep", "--out", out], "which experiment?"),
        (["sweep", "figure6", "--out", out, "--engine", "cloud"], "unknown engine"),
        (["sweep", "figure6", "--out", str(tmp_path / "x"), "--status"], "no sweep here"),
        (["sweep", "--out", out, "--cancel"], "no jobs in Slurm's queue"),
    ):  # fmt: skip
        refuses(words, *arguments)


def test_a_file_is_no_folder(tmp_path: Path) -> None:
    """Spec G2: as --out of a sweep or run, or where its folder would be: one line, and the file stays."""
    there = tmp_path / "there"
    there.write_text("mine")
    for command in (["sweep"], ["run", "--force"]):
        for out, words in ((there, "this is a file"), (there / "x", "a file is in the way")):
            refuses(words, *command, "doorkey", "--preset", "demo", "--out", out, "-q")
    assert [path.name for path in tmp_path.iterdir()] == ["there"] and there.read_text() == "mine"


@pytest.mark.parametrize("damage", ["", "{", "[]", '{"format": 1}', "\ud800"])
def test_a_lost_plan_is_told_with_what_goes_on(swept: Path, tmp_path: Path, damage: str) -> None:
    """Spec G2: whatever looks at it says which command goes on and that nothing is lost."""
    (tmp_path / "sweep.json").write_bytes(damage.encode(errors="surrogatepass"))
    for words in ("--status", "--gather"):
        refuses(GIVE, "sweep", "--out", tmp_path, words)
    if not damage:  # a cell listens for signals, in a process of its own
        command = [sys.executable, "-m", "hypogoal", "sweep", "--out", str(tmp_path), "--cell", "data"]
        told = subprocess.run(command, cwd=ROOT, capture_output=True, text=True).stderr
        assert GIVE in told and told.count("\n") <= 1
    with pytest.raises(LostPlan):
        run_plan(plan(str(swept / "toy.toml"), tmp_path), tmp_path, force=True, resume=True)


@pytest.mark.usefixtures("forked_cells")
def test_a_lost_plan_is_written_anew_and_what_is_complete_is_kept(swept: Path, tmp_path: Path) -> None:
    """Spec G4: the same command goes on, nothing is made again; what another command made is refused, and stays."""
    out = tmp_path / "out"
    shutil.copytree(swept / "whole", out)
    shutil.rmtree(out / "ensemble" / "seed-1")
    kept = [out / "data.h5", out / "ensemble/seed-0/manifest.json"]
    before = [path.stat().st_mtime_ns for path in kept]
    (out / "sweep.json").write_text("")
    other = tmp_path / "toy.toml"
    other.write_text((swept / "toy.toml").read_text().replace("steps=6", "steps=7"))
    err = fails("sweep", other, "--out", out, "-q").err
    assert "not what the command of ensemble-seed-0 makes: the complete output was made with steps=6, not 7" in err
    assert (out / "sweep.json").read_text() == ""
    printed = run("sweep", swept / "toy.toml", "--out", out, "-q")
    assert "is written anew: what is complete is kept" in printed.err
    assert [path.stat().st_mtime_ns for path in kept] == before
    assert (out / "results.csv").read_bytes() == (swept / "whole" / "results.csv").read_bytes()
    plan_of = [json.loads((folder / "sweep.json").read_text())["cells"] for folder in (out, swept / "whole")]
    assert plan_of[0] == plan_of[1]


LEAVER = """
import ctypes, os
from own_domain import CorridorDomain
if os.environ.get("LEAVE"):
    ctypes.CDLL(None)._exit(0)  # in C, which nobody can tell
DOMAIN = CorridorDomain()
"""


def test_a_cell_is_done_when_its_output_is_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Spec G2: own code that leaves with 0 has made nothing: neither at first, nor in a job, nor made again."""
    monkeypatch.setenv("PYTHONPATH", f"{tmp_path}:{ROOT / 'tests'}")
    monkeypatch.setenv("HYPOGOAL_TRUST", "1")
    (tmp_path / "leaver.py").write_text(LEAVER)
    toml, out = tmp_path / "own.toml", tmp_path / "out"
    toml.write_text('format = 1\nevaluate = false\ncells = [{ name = "data", command = "collect leaver:DOMAIN" }]')
    monkeypatch.setenv("LEAVE", "1")
    words = ["sweep", str(toml), "--out", str(out), "-q"]
    err = fails(*words).err
    assert "1 of 1 cell failed" in err and "own code has left the process" in err and err.count("\n") == 1
    assert [one.state for one in read_status(out).states] == ["failed"]
    job = [sys.executable, "-m", "hypogoal", "sweep", "--out", str(out), "--cell", "data"]
    done = subprocess.run(job, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 2 and "own code has left the process" in done.stderr
    monkeypatch.delenv("LEAVE")
    run(*words)
    monkeypatch.setenv("LEAVE", "1")
    with pytest.raises(UserError, match="own code has left the process"):
        run_plan(plan(str(toml), out), out, force=True, quiet=True)
    assert (out / "data.h5").is_file() and read_plan(out).anew == {"data"}


FAILS = f"""
[[cells]]
name = "worse"
axes = ["seed"]
command = "train-ensemble {{data}} --seed {{seed}} --diversity magic {SMALL}"

[[cells]]
name = "agent"
axes = ["seed"]
command = "train-meta {{worse}} --seed {{seed}}"
"""


@pytest.mark.usefixtures("forked_cells")
def test_a_failed_cell_stops_only_those_that_need_it(tmp_path: Path) -> None:
    """Spec G4: told with its log; exit code 2 and one line at the end; the status says who waits for whom."""
    toy, out = write_toy(tmp_path / "toy.toml", "0", FAILS), tmp_path / "out"
    err = fails("sweep", toy, "--out", out, "-q").err
    assert err.count("\n") == 1 and "1 of 4 cells failed, 1 wait for them; the first is worse-seed-0" in err
    assert str(out / "logs" / "worse-seed-0.log") in err and "magic" in err
    status = read_status(out)
    states = {one.cell.name: one.state for one in status.states}
    assert states == {"data": "done", "ensemble-seed-0": "done", "worse-seed-0": "failed", "agent-seed-0": "held"}
    assert "ensemble,0,open-red-door" in (out / "results.csv").read_text()
    text = run("sweep", "--out", out, "--status").out
    assert "4 cells: 2 done, 0 running, 1 failed, 1 left (1 wait for failed ones)" in text and "magic" in text
    assert json.loads(run("sweep", "--out", out, "--status", "--json").out)["counts"]["held"] == 1


@pytest.mark.usefixtures("forked_cells")
def test_what_was_changed_by_hand_is_not_replaced(swept: Path, extended: tuple[list[str], dict[str, int]]) -> None:
    """Spec G2, G4: manifests are verified; a damaged output is told, and stays until the user moves it."""
    out, arguments = swept / "extended", extended[0]
    before = (out / "results.csv").read_bytes()
    log = out / "ensemble/seed-0/metrics.jsonl"
    log.write_text(log.read_text() + "\n")
    refuses("metrics.jsonl: changed since it was written", *arguments)
    (out / "ensemble/seed-0").rename(out / "moved")
    run(*arguments)
    assert (out / "results.csv").read_bytes() == before


@pytest.mark.usefixtures("forked_cells")
def test_an_evaluation_of_less_is_not_done(swept: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Spec G4: neither in the status nor in the results, before it is made again; one that failed is tried again."""
    out, toy = tmp_path / "out", str(swept / "toy.toml")
    shutil.copytree(swept / "whole" / "ensemble" / "seed-0", out / "ensemble" / "seed-0")
    shutil.copy(swept / "whole" / "data.h5", out)
    arguments = ["sweep", toy, "--out", str(out), "--set", "evaluate=true", "-q", "--seeds"]
    run(*arguments, "0")
    assert read_status(out).count("done") == 4 and (out / "run.json").is_file()

    def states() -> list[str]:
        return [one.state for one in read_status(out).states]

    both = plan(toy, out, assignments=["evaluate=true"])
    write_plan(out, both)
    assert states() == ["done", "done", "waiting", "stopped", "stopped"]
    shutil.copytree(swept / "whole" / "ensemble" / "seed-1", out / "ensemble" / "seed-1")
    evaluation = both.cells[-2]
    write_record(out, evaluation, Record(2, 5.0, 2))
    assert states() == ["done", "done", "done", "failed", "held"]
    (out / "run.json").unlink()
    gather(out)
    judged = [line for line in (out / "results.csv").read_text().splitlines() if ",heldout," in line]
    assert {line.split(",")[0] for line in judged} == {"data"} and not (out / "run.json").exists()
    monkeypatch.setattr("hypogoal.experiments.runners.slurm.check", lambda run, options: None)
    monkeypatch.setattr("hypogoal.experiments.runners.slurm.submit", lambda *given: [])
    submit(both, out, Options(), quiet=True)
    assert states() == ["done", "done", "done", "stopped", "stopped"]
    run(*arguments, "0-1")
    assert states() == ["done"] * 5 and (out / "run.json").is_file()


def test_status_knows_what_runs_by_its_lock(swept: Path) -> None:
    """Spec G4: from files alone: who holds the lock on a log runs the cell; when that dies, nobody does."""
    run = swept / "whole"
    plan = read_plan(run)
    cell = plan.cells[1]
    assert not is_running(run, cell) and read_status(run).count("done") == 3
    with open_log(run, cell) as log:
        child = subprocess.Popen(["sleep", "600"], stdout=log)
    try:
        assert is_running(run, cell)
        with pytest.raises(UserError, match="is being run by another process"):
            open_log(run, cell)
        assert [one.state for one in read_status(run).states] == ["done", "running", "done"]
    finally:
        child.kill()
        child.wait()
    assert not is_running(run, cell)


@pytest.mark.usefixtures("forked_cells")
def test_cells_are_run_in_the_plans_order(tmp_path: Path) -> None:
    """Spec G4: one that waits for nothing goes not before those that had to wait, nor when started again."""
    last = f'[[cells]]\nname = "more"\ncommand = "{DATA} --seed 1"'
    toy = write_toy(tmp_path / "toy.toml", "0", last)
    planned = replace(plan(str(toy), tmp_path / "out"), workers=1)

    def started() -> list[str]:
        told: list[str] = []
        run_cells(planned, tmp_path / "out", say=told.append)
        return [line.split()[1] for line in told if line.endswith(" ...")]

    assert started() == ["data", "ensemble-seed-0", "more"]
    for cell in planned.cells[1:]:
        cell.out.rename(cell.out.with_suffix(".old"))
    assert started() == ["ensemble-seed-0", "more"]


@pytest.mark.usefixtures("forked_cells")
def test_what_was_to_be_made_anew_is_so_until_it_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Spec A6, G4: ``run --force`` is interrupted: what stood there before does not pass for what it will make."""
    out = tmp_path / "out"
    planned = plan(str(write_toy(tmp_path / "toy.toml", "0")), out)
    data, ensemble = (cell.out for cell in planned.cells)
    run_plan(planned, out, quiet=True)

    def made() -> tuple[int, int]:
        return data.stat().st_mtime_ns, (ensemble / "manifest.json").stat().st_mtime_ns

    def interrupted(running: Running, code: int) -> str:
        ended(running, code)
        raise KeyboardInterrupt

    first, ended = made(), Running.ended
    with monkeypatch.context() as patch:
        patch.setattr(Running, "ended", interrupted)
        with pytest.raises(KeyboardInterrupt):
            run_plan(planned, out, force=True, quiet=True)
    second = made()
    assert second[0] > first[0] and second[1] == first[1]
    assert [one.state for one in read_status(out).states] == ["done", "waiting"] and not (out / "run.json").exists()
    gather(out)
    assert "ensemble" not in (out / "results.csv").read_text() and not (out / "run.json").exists()
    copy = tmp_path / "copy"
    shutil.copytree(out, copy)
    (copy / "sweep.json").write_text("")
    capsys.readouterr()
    again = plan(str(tmp_path / "toy.toml"), copy)
    run_plan(again, copy, resume=True, quiet=True)  # what was to be made is not known now
    told = capsys.readouterr().err
    assert "kept, though 'run --force' may have been about to make them again: ensemble-seed-0\n" in told
    monkeypatch.setattr("hypogoal.experiments.runners.slurm.check", lambda run, options: None)
    submitted: list[Cell] = []
    monkeypatch.setattr("hypogoal.experiments.runners.slurm.submit", lambda plan, run, todo, _: submitted.extend(todo))
    submit(planned, out, Options(), quiet=True)
    assert [cell.out for cell in submitted] == [ensemble]
    run_plan(planned, out, force=True, resume=True, quiet=True)
    third = made()
    assert third[0] == second[0] and third[1] > second[1] and not read_plan(out).anew
    run_plan(planned, out, resume=True, quiet=True)
    assert made() == third and (out / "run.json").is_file()


@pytest.mark.slow
def test_a_sweep_killed_at_random_ends_with_the_same_results(tmp_path: Path) -> None:
    """Spec G1, G4: ``python -m tests.attacks.sweeps`` is the long version."""
    command = [sys.executable, "-m", "tests.attacks.sweeps", "--kills", "4", "--folder", str(tmp_path)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


WARNED_AT_ONCE = """
import os, signal, sys
from hypogoal.cli import main
from hypogoal.experiments.runners import slurm

begin = slurm.start
def warned(*given, **more):
    running = begin(*given, **more)
    os.kill(os.getpid(), signal.SIGUSR2)  # the stage has hardly begun and does not listen yet
    return running
slurm.start = warned
sys.exit(main(["sweep", "--out", sys.argv[1], "--cell", "data"]))
"""


def test_a_job_warned_before_its_stage_listens_says_that_nothing_was_saved(swept: Path, tmp_path: Path) -> None:
    """Spec G4: it is not queued again, where it would come to the same end."""
    (tmp_path / "sweep.json").write_bytes((swept / "whole" / "sweep.json").read_bytes())
    command = [sys.executable, "-c", WARNED_AT_ONCE, str(tmp_path)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 2
    assert "data failed: nothing new could be saved before the time limit" in done.stderr
    assert "queued again" not in done.stderr
    data = next(cell for cell in read_plan(tmp_path).cells if cell.name == "data")
    assert read_record(tmp_path, data).code == 1
    assert not data.out.exists()
