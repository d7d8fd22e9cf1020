"""Spec G1: killed, interrupted and resumed as a user does it, in processes of their own."""

import os
import signal
import subprocess
import sys
import time
import tomllib
from pathlib import Path

import pytest

from hypogoal.cli import main
from hypogoal.core.artefacts import Draft
from hypogoal.core.checkpoints import Checkpoints
from tests.attacks.kills import STAGES, needed

ROOT = Path(__file__).resolve().parents[1]
WAIT_SECONDS = 300.0


def killed(kills: int, stages: list[str], folder: Path) -> dict[str, list[int]]:
    """The rows of the kill harness: stage -> kills, while writing, ended, differences, losses."""
    command = [sys.executable, "-m", "tests.attacks.kills", "--kills", str(kills), "--folder", str(folder)]
    done = subprocess.run([*command, "--stages", *stages], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    rows = [line.split() for line in done.stdout.splitlines()[1:]]
    return {row[0]: [int(number) for number in row[1:]] for row in rows}


def test_killed_stages_end_with_the_same_bytes(tmp_path: Path) -> None:
    """Spec G1: SIGKILL at random moments, a few of them, of an ensemble and of options."""
    rows = killed(3, ["ensemble", "options"], tmp_path)
    assert rows.keys() == {"ensemble", "options"}
    for kills, _writing, ended, differences, losses in rows.values():
        assert kills >= 3 and ended >= 1 and (differences, losses) == (0, 0)


@pytest.mark.slow
def test_every_killed_stage_ends_with_the_same_bytes(tmp_path: Path) -> None:
    """Spec G1: all of them; ``python -m tests.attacks.kills`` is the long version."""
    rows = killed(5, list(STAGES), tmp_path)
    assert rows.keys() == STAGES.keys()
    assert all(row[3:] == [0, 0] for row in rows.values()), rows


def test_the_harness_runs_what_a_stage_needs_first() -> None:
    """The order of the stages is one in which they can run."""
    assert needed(["meta"]) == ["data", "ensemble", "options", "meta"]
    for name, stage in STAGES.items():
        order = needed([name])
        assert order[-1] == name and set(stage.needs) <= set(order)


def test_ctrl_c_saves_and_says_how_to_go_on(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Spec G1, G2: one line and 128 + the signal; then neither flag, or another seed, is refused in one line."""
    out = tmp_path / "ppo"
    arguments = ["train-baseline", "doorkey", "--out", str(out), "--set", "random_episodes=5", "-q"]
    for number, resume in ((signal.SIGINT, []), (signal.SIGTERM, ["--resume"])):
        log = Draft(out).folder / "files" / "metrics.jsonl"
        before = log.stat().st_size if log.exists() else 0
        command = [sys.executable, "-m", "hypogoal", *arguments, *resume]
        with subprocess.Popen(command, cwd=ROOT, stderr=subprocess.PIPE, text=True) as process:
            until = time.monotonic() + WAIT_SECONDS
            while not (log.exists() and log.stat().st_size > before):
                assert process.poll() is None and time.monotonic() < until
                time.sleep(0.05)
            process.send_signal(number)
            _, words = process.communicate()
        assert process.returncode == 128 + number
        assert words == (
            "hypogoal: stopped; the last checkpoint is kept: give the same command with --resume to continue\n"
        )
        assert Draft(out).is_resumable and not out.exists()
    for given, line in (([], "an unfinished output exists"), (["--resume", "--seed", "1"], "begun with seed=0, not 1")):
        assert main([*arguments, *given]) == 2
        err = capsys.readouterr().err
        assert line in err and err.count("\n") == 1


@pytest.mark.slow
def test_workers_save_when_their_stage_is_stopped(tmp_path: Path) -> None:
    """Spec G1: SIGTERM goes on to the processes that train a sub-goal each, and each of them saves."""
    data, out = tmp_path / "data.h5", tmp_path / "ensemble"
    small = ["--set", "heldout_layouts=1", "--set", "unlabelled_seeds=1", "-q"]
    assert main(["collect", "doorkey", "--out", str(data), *small]) == 0
    long = ["--set", "steps=1000000", "--set", "workers=2", "--set", "sub_goals=open-red-door,go-to-goal"]
    command = [sys.executable, "-m", "hypogoal", "train-ensemble", str(data), "--out", str(out), *long]
    with subprocess.Popen(command, cwd=ROOT, stderr=subprocess.PIPE, text=True) as process:
        until = time.monotonic() + WAIT_SECONDS
        logs = [Draft(out).folder / "checkpoint" / f"{name}.jsonl" for name in ("open-red-door", "go-to-goal")]
        while not all(log.exists() and log.stat().st_size for log in logs):
            assert process.poll() is None and time.monotonic() < until
            time.sleep(0.05)
        process.terminate()
        _, words = process.communicate()
    assert process.returncode == 128 + signal.SIGTERM
    assert words.count("hypogoal: stopped; the last checkpoint is kept") == 1 and "Traceback" not in words
    saved = [Checkpoints(log.with_suffix(".safetensors")).load() for log in logs]
    assert all(state and state["part"]["watch"]["done"] > 0 for state in saved)


def test_ctrl_c_while_it_starts_says_nothing(tmp_path: Path) -> None:
    """Spec G2: no traceback out of the middle of an import; the process dies of the signal, as the shell expects."""
    (tmp_path / "typer.py").write_text("import os, signal\nos.kill(os.getpid(), signal.SIGINT)\n")
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(tmp_path), str(ROOT)])}
    command = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["scripts"]["hypogoal"]
    installed = f"from {command.replace(':', ' import ')}"
    for how in (["-m", "hypogoal"], ["-c", installed]):
        done = subprocess.run([sys.executable, *how], env=environment, cwd=tmp_path, capture_output=True, text=True)
        assert (done.returncode, done.stderr) == (-signal.SIGINT, "")


TWICE = """
import os, signal, sys
import hypogoal.cli

said = hypogoal.cli.notes_of
hypogoal.cli._called = lambda words: os.kill(os.getpid(), signal.SIGINT)
hypogoal.cli.notes_of = lambda error: os.kill(os.getpid(), signal.SIGINT) or said(error)
sys.exit(hypogoal.cli.main())
"""


def test_ctrl_c_while_it_says_that_it_stops() -> None:
    """Spec G2: who is in such a hurry gets no traceback either."""
    done = subprocess.run([sys.executable, "-c", TWICE], cwd=ROOT, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (-signal.SIGINT, "")


SLEEPERS = """
import functools, os, pathlib, sys, time
from hypogoal.core.processes import in_processes

def sleep(folder, number):
    (folder / f"{number}.new").write_text(str(os.getpid()))
    (folder / f"{number}.new").rename(folder / f"{number}.pid")
    time.sleep(600)

if __name__ == "__main__":
    in_processes([functools.partial(sleep, pathlib.Path(sys.argv[1]), number) for number in range(2)], 2, print)
"""


STOPPED_AT_ONCE = """
import os, signal, sys
import hypogoal.cli

hypogoal.cli._called = lambda words: os.kill(os.getpid(), signal.SIGTERM)
sys.exit(hypogoal.cli.main())
"""


STOPPED_WHILE_PARSING = """
import os, signal, sys
import hypogoal.cli
from typer.core import TyperGroup

TyperGroup.parse_args = lambda *_: os.kill(os.getpid(), signal.SIGTERM)
sys.exit(hypogoal.cli.main())
"""


@pytest.mark.parametrize("code", [STOPPED_AT_ONCE, STOPPED_WHILE_PARSING])
def test_stopped_before_a_command_is_reached(code: str) -> None:
    """Spec G1, G2: one line and 128 + the signal, as later."""
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 128 + signal.SIGTERM
    assert done.stderr == "hypogoal: stopped; nothing was half-written\n"


def test_a_stage_dies_with_all_its_processes(tmp_path: Path) -> None:
    """Spec G1: no orphan goes on writing beside its successor."""
    (tmp_path / "script.py").write_text(SLEEPERS)
    command = [sys.executable, str(tmp_path / "script.py"), str(tmp_path)]
    until = time.monotonic() + WAIT_SECONDS
    with subprocess.Popen(command, env={**os.environ, "PYTHONPATH": str(ROOT)}) as parent:
        while len(list(tmp_path.glob("*.pid"))) < 2:
            assert parent.poll() is None and time.monotonic() < until
            time.sleep(0.05)
        parent.kill()
    workers = [int(path.read_text()) for path in tmp_path.glob("*.pid")]
    while any(alive(worker) for worker in workers):
        assert time.monotonic() < until
        time.sleep(0.05)


def alive(process: int) -> bool:
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False
