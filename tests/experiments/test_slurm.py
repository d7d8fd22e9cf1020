"""Spec G4: a sweep as Slurm job arrays; the scripts everywhere, the rest on a real Slurm where there is one."""

import contextlib
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from functools import reduce
from operator import or_
from pathlib import Path

import pytest
from slurm import MISSING, cluster, told
from toy import write_toy

from hypogoal.core import own_code
from hypogoal.core.checkpoints import FOLDER
from hypogoal.core.drafts import draft_folder, unfinished
from hypogoal.core.errors import UserError
from hypogoal.experiments.cells import Cell, Plan
from hypogoal.experiments.records import read_plan, read_record
from hypogoal.experiments.runners.slurm import MOST_ELEMENTS, Options, arrays, submit
from hypogoal.experiments.status import read_status
from hypogoal.stages import sweep as sweeping

ROOT = Path(__file__).resolve().parents[2]
WAIT_SECONDS = 300.0
OUT = Path("runs/x")


def some_plan(seeds: int = 3) -> Plan:
    data = Cell("data", ("collect", "doorkey"), OUT / "data.h5")
    ensembles = [Cell(f"e-{n}", ("train-ensemble",), OUT / f"e-{n}", (data.out,), 2) for n in range(seeds)]
    ppo = [Cell(f"ppo-{n}", ("train-baseline",), OUT / f"ppo-{n}") for n in range(seeds)]
    end = Cell("evaluate", ("evaluate",), OUT / "evaluation", tuple(cell.out for cell in [*ensembles, *ppo]))
    return Plan("x", [data, *ensembles, *ppo, end], 2)


def test_arrays_are_stages_and_wait_for_what_they_need_only() -> None:
    """Spec G4: the elements are the cells; baselines do not wait for data; what is done is in no array."""
    plan = some_plan()
    found = {array.name: (len(array.cells), array.after) for array in arrays(plan, plan.cells)}
    assert found == {
        "00-collect": (1, []),
        "00-train-baseline": (3, []),
        "01-train-ensemble": (3, ["00-collect"]),
        "02-evaluate": (1, ["00-train-baseline", "01-train-ensemble"]),
    }
    rest = {array.name: (len(array.cells), array.after) for array in arrays(plan, plan.cells[2:])}
    assert rest["01-train-ensemble"] == (2, []) and "00-collect" not in rest
    many = some_plan(MOST_ELEMENTS + 5)
    parts = [array for array in arrays(many, many.cells) if "baseline" in array.name]
    assert [(array.name, len(array.cells)) for array in parts] == [
        ("00-train-baseline", MOST_ELEMENTS),
        ("00-train-baseline-1", 5),
    ]


COMMAND = """#!/bin/sh
echo "$(basename "$0") $*" >> "$(dirname "$0")/asked"
case "$(tail -n 1 "$(dirname "$0")/asked")" in
*evaluate.sh) test -e "$(dirname "$0")/full" && { echo "sbatch: error: queue is full" >&2; exit 1; } ;;
esac
wc -l < "$(dirname "$0")/asked"
"""


def test_scripts_are_plain_and_say_what_was_asked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Spec G4: partition, time, memory, GPUs, cap, warning; a stand-in for sbatch takes them down."""
    for name in ("sbatch", "scancel"):
        (tmp_path / name).write_text(COMMAND)
        (tmp_path / name).chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:/usr/bin:/bin")
    plan, out = some_plan(), tmp_path / "a run"
    asked = Options("long", "4:00:00", "2G", 1, 0, 7, 90, ("--account=x",))
    own_code.allow(["network=mine:net"])
    jobs = submit(plan, out, plan.cells, asked)
    assert [job["name"] for job in jobs] == [
        *("00-collect", "00-train-baseline", "01-train-ensemble", "02-evaluate", "gather")
    ]
    script = (out / "slurm" / "01-train-ensemble.sh").read_text()
    for line in (
        "#SBATCH --job-name=a-run-01-train-ensemble",
        "#SBATCH --array=0-2%7",
        "#SBATCH --partition=long",
        "#SBATCH --time=4:00:00",
        "#SBATCH --gres=gpu:1",
        "#SBATCH --cpus-per-task=2",
        "#SBATCH --mem=2G",
        "#SBATCH --signal=B:USR2@90",
        "#SBATCH --requeue",
        "#SBATCH --account=x",
        "set -- e-0 e-1 e-2",
        "export HYPOGOAL_TRUST=1",
        f"exec {sys.executable} -P -m hypogoal sweep --out '{out}' --cell \"$1\"",
    ):
        assert f"\n{line}\n" in script, line
    percent = submit(plan, tmp_path / "50%A", plan.cells[:1], Options())
    text = (tmp_path / "50%A" / "slurm" / f"{percent[0]['name']}.sh").read_text()
    assert "/50%%A/slurm/%x-%A-%a.out\n" in text or "/50%%A/slurm'/%x-%A-%a.out\n" in text
    with pytest.raises(UserError, match="a batch script cannot hold a path"):
        sweeping.submit(plan, tmp_path / "a\\b", Options(), quiet=True)
    assert not list(tmp_path.glob("*\\*"))
    lines = (tmp_path / "asked").read_text().splitlines()
    assert "--dependency=afterany:1 " in lines[2] and "--dependency=afterany:2:3 " in lines[3]
    (tmp_path / "full").touch()
    with pytest.raises(UserError, match="queue is full"):
        submit(plan, out, plan.cells, asked)
    (ended,) = [line for line in (tmp_path / "asked").read_text().splitlines() if line.startswith("scancel")]
    assert len(ended.split()) == 4  # what was submitted before
    subprocess.run(["sh", "-n", str(out / "slurm" / "01-train-ensemble.sh")], check=True)


def test_without_slurm_that_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Spec G2: one line, nothing written."""
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(UserError, match="there is no Slurm here"):
        sweeping.submit(some_plan(), tmp_path / "out", Options(), quiet=True)
    assert list(tmp_path.iterdir()) == []


@pytest.fixture(scope="module")
def slurm(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, str]]:
    """The environment in which Slurm's commands find a cluster of two processors."""
    with cluster(tmp_path_factory.mktemp("slurm") / "cluster", cpus=2) as configuration:
        yield {**os.environ, "SLURM_CONF": str(configuration)}


LONG = """
[[cells]]
name = "more"
axes = ["seed"]
command = "collect doorkey --seed {{seed}} --set heldout_layouts=1 --set unlabelled_seeds=1"

[[cells]]
name = "long"
command = "train-ensemble {{data}} --set members=2 --set sub_goals=open-red-door --set steps={steps}"
"""
STEPS = 150
TERM = 1 << (signal.SIGTERM - 1)


def wait_for(what: Callable[[], object], told_at_last: Callable[[], str] = str) -> None:
    until = time.monotonic() + WAIT_SECONDS
    while not what():
        assert time.monotonic() < until, told_at_last()
        time.sleep(0.1)


def element(out: Path, cell: str) -> int:
    """The process that is the job of a cell."""
    wanted = [str(out), "--cell", cell]
    for folder in Path("/proc").iterdir():
        if folder.name.isdigit():
            with contextlib.suppress(OSError):
                if (folder / "cmdline").read_text().rstrip("\0").split("\0")[-3:] == wanted:
                    return int(folder.name)
    raise AssertionError(f"no job runs {cell}")


def waiting(process: int) -> int:
    """The signals that a stopped process has not heard yet, a bit for each."""
    lines = dict(line.split(":\t") for line in Path(f"/proc/{process}/status").read_text().splitlines())
    return reduce(or_, (int(lines[kind], 16) for kind in ("SigPnd", "ShdPnd")))


def hold(out: Path, cell: Cell, seen: int = 0) -> int:
    """Stop the stage that a job runs, once it has trained for some steps: however fast the machine, it does not end.

    ``seen``: when its metrics were last written to, for one that was begun before.
    """
    wait_for(lambda: written(cell) > seen)
    job = element(out, cell.name)
    stage = int(Path(f"/proc/{job}/task/{job}/children").read_text().split()[0])
    os.kill(stage, signal.SIGSTOP)
    return stage


def written(cell: Cell) -> int:
    """When an ensemble's draft last had something to tell, in ns; 0: not yet."""
    logs = [path.stat() for path in (draft_folder(cell.out) / FOLDER).glob("*.jsonl")]
    return max((log.st_mtime_ns for log in logs if log.st_size), default=0)


def release(stage: int) -> None:
    """Let it go on when its job has told it to stop."""
    wait_for(lambda: waiting(stage) & TERM)
    os.kill(stage, signal.SIGCONT)


@pytest.mark.slurm
@pytest.mark.skipif(MISSING, reason="needs slurmctld and slurmd")
def test_a_sweep_on_slurm_killed_timed_out_cancelled_and_resumed(slurm: dict[str, str], tmp_path: Path) -> None:
    """Spec G1, G4: eight cells; one job killed, one warned before its limit and queued again, all cancelled and begun
    again: the results of an unbroken sweep on this machine. Nothing hangs on how fast the machine is: the cell that
    is to reach its limit is held."""
    begun = time.monotonic()
    toy = write_toy(tmp_path / "toy.toml", "0-2", LONG.format(steps=STEPS))
    out = tmp_path / "out"

    def hypogoal(*arguments: str) -> str:
        command = [sys.executable, "-m", "hypogoal", "sweep", *arguments]
        done = subprocess.run(command, cwd=ROOT, env=slurm, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        return done.stdout + done.stderr

    def start(limit: str) -> None:
        hypogoal(str(toy), "--out", str(out), "--engine", "slurm", "--time", limit, "--warn", "5", "--cap", "2")

    def queue() -> str:
        return told("squeue", "--noheader", "--format=%i %j %T", env=slurm)

    def states() -> dict[str, str]:
        return {one.cell.name: one.state for one in read_status(out).states}

    def attempts(name: str) -> int:
        return next(read_record(out, cell).attempts for cell in read_plan(out).cells if cell.name == name)

    def story() -> str:
        logs = [path.read_text()[-2000:] for path in sorted([*out.glob("slurm/*.out"), *out.glob("logs/long*")])]
        return "\n".join([queue(), str(states()), *logs])

    start("1")
    # A cell runs from when it holds its log; killed before it has written its record, it counts as never started.
    wait_for(lambda: attempts("ensemble-seed-0") == 1 and states()["ensemble-seed-0"] == "running", story)
    os.kill(element(out, "ensemble-seed-0"), signal.SIGKILL)

    wait_for(lambda: states()["long"] == "running", story)
    long = next(cell for cell in read_plan(out).cells if cell.name == "long")
    held = hold(out, long)
    seen = written(long)
    release(held)
    wait_for(lambda: attempts("long") == 2 and states()["long"] == "running", story)
    hold(out, long, seen)
    assert unfinished(long.out) and not long.out.exists()
    assert attempts("ensemble-seed-1") == 1 and [line for line in queue().splitlines() if "gather" not in line]
    assert states()["ensemble-seed-0"] == "stopped"  # the killed one is not queued again with it
    hypogoal("--out", str(out), "--cancel")  # upon which Slurm itself lets what is held go on
    assert queue() == "" and unfinished(long.out) and read_status(out).count("running", "failed") == 0
    assert states()["long"] == "stopped" and "1 done" not in hypogoal("--out", str(out), "--status")

    start("20")
    wait_for(lambda: queue() == "")
    status = read_status(out)
    assert status.count("done") == len(status.states) == 8, hypogoal("--out", str(out), "--status")
    assert attempts("long") >= 3 and attempts("ensemble-seed-0") >= 2 and attempts("data") == 1
    on_slurm = time.monotonic() - begun
    shutil.copy(toy, tmp_path / "here.toml")
    hypogoal(str(tmp_path / "here.toml"), "--out", str(tmp_path / "here"), "-q")
    assert (out / "results.csv").read_bytes() == (tmp_path / "here" / "results.csv").read_bytes()
    tries = {cell.name: read_record(out, cell).attempts for cell in read_plan(out).cells}
    print(f"\non Slurm {on_slurm:.0f} s, here {time.monotonic() - begun - on_slurm:.0f} s; attempts {tries}")
