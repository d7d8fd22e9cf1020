"""Spec G4: cells as Slurm job arrays; the scripts everywhere, the rest on a real Slurm where there is one."""

import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from command_line import fails, refuses, run
from slurm import MISSING, cluster, told
from test_sweep import bytes_of, states
from toy import SMALL, write_toy

ROOT = Path(__file__).resolve().parents[2]
WAIT_SECONDS = 400.0
COMMAND = """#!/bin/sh
here=$(dirname "$0")
echo "$(basename "$0") $*" >> "$here/asked"
case "$*" in *train-meta.sh) test -e "$here/full" && { echo "sbatch: error: queue is full" >&2; exit 1; } ;; esac
echo "Welcome to the supercomputer
No reservation 4711 for this job
$(wc -l < "$here/asked");nautilus"
"""


def test_scripts_and_what_is_asked_of_sbatch(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Spec G4: an array for each stage, after those that it reads; the number is a line of its own."""
    (tmp_path / "sbatch").write_text(COMMAND)
    (tmp_path / "sbatch").chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:/usr/bin:/bin")
    more = '[[cells]]\nname = "ppo"\naxes = ["seed"]\ncommand = "train-baseline rooms --seed {seed}"'
    toy, out = write_toy(tmp_path / "toy.toml", "0-2", more, evaluate=True), tmp_path / "50%A run"
    words = ["run", toy, "--engine", "slurm", "--set", "workers=7", "--sbatch", "--time=4:00:00 --mem=2G", "--out"]
    told = run(*words, out).err.splitlines()
    arrays = ["collect", "train-ensemble", "train-meta", "train-baseline", "evaluate", "report"]
    assert [line.split(": ")[1].split(",")[0] for line in told] == arrays
    asked = (tmp_path / "asked").read_text().splitlines()
    waits = [line.partition("--dependency=afterany:")[2].partition(" ")[0] for line in asked]
    assert waits == ["", "1", "2", "", "1:2:3:4", "5"]
    for words_asked in ("--array=0-2%7", "--time=4:00:00 --mem=2G", "/50%%A run/slurm/%x-%A-%a.out"):
        assert words_asked in asked[3]
    assert (out / "slurm" / "jobs").read_text().split() == ["--clusters=nautilus", "6", "5", "4", "3", "2", "1"]
    for script in (out / "slurm").glob("*.sh"):
        subprocess.run(["sh", "-n", str(script)], check=True)
    (tmp_path / "full").touch()
    line = fails(*words, tmp_path / "other").err.splitlines()[-1]
    assert "queue is full" in line and "Queued are 8 7: end them with scancel" in line


@pytest.fixture
def commands(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Writes commands into PATH: each runs a line of the shell."""
    folder = tmp_path / "bin"
    folder.mkdir()
    monkeypatch.setenv("PATH", f"{folder}:/usr/bin:/bin")

    def write(**lines: str) -> None:
        for name, line in lines.items():
            (folder / name).write_text(f"#!/bin/sh\n{line}\n")
            (folder / name).chmod(0o755)

    return write


@pytest.mark.parametrize(
    ("answer", "jobs"),
    [
        (r"71\n\n", "71"),
        (r"71\nThank you for using this cluster, 2 nodes are down.\n", "71"),
        (r"\033[32m71\033[0m\n", "71"),
        (r"Welcome\r\nSubmitted batch job 71\r\n", "71"),
        (r"Submitted batch job 71 on cluster far\n", "--clusters=far 71"),
        (r"71;far\nM\374nchen\n", "--clusters=far 71"),
    ],
)
def test_what_sbatch_says_beside_the_number(
    tmp_path: Path, commands: Callable[..., None], answer: str, jobs: str
) -> None:
    """Spec G4: the job is remembered, whatever a cluster says around it; and asked for where it waits."""
    toy, out = write_toy(tmp_path / "toy.toml"), tmp_path / "out"
    commands(sbatch=f"printf '{answer}'", squeue="case $* in *--clusters=far*) ;; *) exit;; esac; echo 71")
    words = ["run", toy, "--out", out, "--engine", "slurm"]
    assert run(*words).err.startswith("job 71: collect, 1 cells\n")
    first, *others = (out / "slurm/jobs").read_text().split()
    assert " ".join([first, *others]).startswith(jobs)
    assert f"{out}: 0 of 5 cells done, 5 waiting" in run("status", out).out
    if "far" in jobs:
        assert "in Slurm's queue" in refuses("scancel --clusters=far 71", *words, "--resume")


@pytest.mark.parametrize("answer", ["", "Thank you", "71\n72"])
def test_a_job_without_a_number_is_told(tmp_path: Path, commands: Callable[..., None], answer: str) -> None:
    """Spec G2: it is queued, so nobody is told that Slurm refuses it."""
    commands(sbatch=f"printf '{answer}'")
    words = ["run", write_toy(tmp_path / "toy.toml"), "--out", tmp_path / "out", "--engine", "slurm"]
    line = fails(*words).err
    assert "sbatch does not say one number" in line and "squeue --me, end it with scancel. Then" in line


@pytest.mark.parametrize("down", ["exit 1", "echo 'slurm_load_jobs error: Unable to contact slurm controller' >&2"])
@pytest.mark.parametrize("given", [["--resume"], ["--force"], ["--resume", "--engine", "local"]])
def test_a_queue_that_does_not_answer_is_not_empty(
    tmp_path: Path, commands: Callable[..., None], down: str, given: list[str]
) -> None:
    """Spec G4: nothing is submitted again, or made here, while the jobs may wait."""
    words = ["run", write_toy(tmp_path / "toy.toml"), "--out", tmp_path / "out", "--engine", "slurm"]
    commands(sbatch="echo 71", squeue=down)
    run(*words)
    commands(sbatch="echo 81", squeue=down)
    refuses("squeue does not say whether this run's jobs are done", *words, *given)
    assert {*(tmp_path / "out/slurm/jobs").read_text().split()} == {"71"}


def test_without_slurm_that_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Spec G2: one line, nothing written."""
    toy = write_toy(tmp_path / "toy.toml")
    monkeypatch.setenv("PATH", str(tmp_path))
    refuses("there is no Slurm here", "run", toy, "--out", tmp_path / "out", "--engine", "slurm")


@pytest.fixture(scope="module")
def slurm(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, str]]:
    """The environment in which Slurm's commands find a cluster of two processors."""
    with cluster(tmp_path_factory.mktemp("slurm") / "cluster", cpus=2) as configuration:
        yield {**os.environ, "SLURM_CONF": str(configuration), "HYPOGOAL_CHECKPOINT_SECONDS": "1"}


MORE = f"""
[[cells]]
name = "worse"
command = "train-ensemble {{data}} {SMALL} --set sub_goals=nowhere"

[[cells]]
name = "lost"
command = "train-meta {{worse}}"

[[cells]]
name = "long"
command = "train-baseline rooms --set steps=100000000 --set max_episode_steps=20"
"""


def wait_for(what: Callable[[], object], story: Callable[[], str]) -> None:
    until = time.monotonic() + WAIT_SECONDS
    while not what():
        assert time.monotonic() < until, story()
        time.sleep(0.2)


@pytest.mark.slurm
@pytest.mark.skipif(MISSING, reason="needs slurmctld and slurmd")
def test_cells_on_slurm_fail_reach_their_limit_are_cancelled_and_resumed(slurm: dict[str, str], tmp_path: Path) -> None:
    """Spec G1, G4: the bytes of a run on this machine; a failing cell holds its own; one that never ends is warned,
    saves and is queued again; cancelled, it saves; the same command submits what is left."""
    toy, out = write_toy(tmp_path / "toy.toml", "0-1", MORE), tmp_path / "a run"

    def submit(*more: str) -> subprocess.CompletedProcess[str]:
        words = ["run", str(toy), "--out", str(out), "--engine", "slurm", "--sbatch"]
        command = [sys.executable, "-m", "hypogoal", *words, "--time=2 --signal=B:USR2@45", *more]
        return subprocess.run(command, cwd=ROOT, env=slurm, capture_output=True, text=True, check=False)

    def queue() -> str:
        return told("squeue", "--noheader", "--array", "--format=%i %j %T", env=slurm)

    def story() -> str:
        logs = [path.read_text()[-1000:] for path in sorted([*out.glob("slurm/*.out"), *out.glob("logs/**/*.log")])]
        return "\n".join([queue(), str(states(out)), *logs])

    first = submit()
    assert first.returncode == 0, first.stderr
    assert "this run is in Slurm's queue" in submit("--resume").stderr
    log, checkpoint = out / "logs/long.log", out / ".long.partial/checkpoint"
    done = ["data", "ensemble/seed-0", "ensemble/seed-1", "agent/seed-0", "agent/seed-1"]
    wait_for(lambda: log.exists() and "the last checkpoint is kept" in log.read_text(), story)  # it was warned
    wait_for(lambda: states(out)["long"] == "running", story)  # and runs again
    wait_for(lambda: {states(out)[name] for name in done} == {"done"}, story)
    job = next(line.split()[0] for line in queue().splitlines() if "train-baseline" in line)
    assert "Restarts=0" not in told("scontrol", "show", "job", job, env=slurm)
    told("scancel", *(out / "slurm/jobs").read_text().split(), env=slurm)
    wait_for(lambda: queue() == "", story)
    expected = dict.fromkeys(done, "done") | {"worse": "failed", "lost": "waiting", "long": "waiting"}
    assert {**states(out), "lost": "waiting"} == expected, story()  # it failed, since what it needs is not there
    assert checkpoint.exists() and "nowhere" in (out / "logs/worse.log").read_text()
    run("run", write_toy(tmp_path / "here.toml"), "--out", tmp_path / "here", "-q")
    here, there = bytes_of(tmp_path / "here"), bytes_of(out)
    assert here == {name: there[name] for name in here}
