"""Spec G1: every command killed at random moments and resumed, against the same command unbroken, byte by byte.

``python -m tests.attacks.kills [--kills 20] [--commands run/meta ...]`` prints for each command: kills, how many of
them after its first checkpoint, faults. A fault is a run that fails, a file that differs (but for ``took``), an output
that is not whole, or anything left over.

A command runs in a process group of its own, forked from this process so that it need not load its libraries again, in
a folder that has what it reads; the whole group gets SIGKILL.
"""

import argparse
import json
import os
import random
import shutil
import signal
import sys
import tempfile
import time
from importlib import import_module
from pathlib import Path

from hypogoal.core.artefacts import Artefact
from hypogoal.core.checkpoints import PACE
from hypogoal.core.drafts import Draft

PACES = ("0", "0.02", "0.2")  # seconds between two checkpoints; 0: at every step
QUICK = "--set warm_up=100 --set max_episode_steps=60 --set environments=8"
TOY = """
format = 1
evaluate = false
axes = { seed = "0-1" }
[[cells]]
name = "data"
command = "collect rooms --set labelled=64 --set unlabelled=128"
[[cells]]
name = "ensemble"
axes = ["seed"]
command = "train-ensemble {data} --seed {seed} --set steps=20 --set members=2"
"""
# Output -> the command that makes it from those before it.
COMMANDS = {
    "sweep": "run toy.toml --out sweep",
    "run/data.h5": "collect doorkey --set heldout_layouts=1 --set unlabelled_seeds=1 --out run/data.h5",
    "run/ensemble": "train-ensemble run/data.h5 --set steps=12 --set members=2 --set workers=2"
    " --set sub_goals=open-red-door,go-to-goal --out run/ensemble",
    "run/options": f"train-options run/ensemble --set steps=1000 --set save_visited=50 {QUICK} --out run/options",
    "run/meta": f"train-meta run/ensemble --options run/options --set steps=1000 --set decisions=32 {QUICK}"
    " --out run/meta",
    "run/ppo": "train-baseline doorkey --set agent=ppo --set steps=2560 --set max_episode_steps=60 --out run/ppo",
    "run/evaluation": "evaluate run",
    "run/report": "report run",
}
SAVING = ("run/ensemble", "run/options", "run/meta", "run/ppo", "sweep")  # with checkpoints


def begin(command: str, folder: Path, pace: str) -> int:
    """Start a command in ``folder``, its words into a log beside; returns its process."""
    process = os.fork()
    if process:
        return process
    code = 70
    try:
        os.setsid()
        os.chdir(folder)
        os.environ[PACE] = pace
        log = os.open(folder.with_suffix(".log"), os.O_WRONLY | os.O_CREAT | os.O_APPEND)
        os.dup2(log, 1)
        os.dup2(log, 2)
        sys.argv = ["hypogoal", *command.split()]
        code = import_module("hypogoal.cli").main()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


def ended(process: int, *, wait: bool = False) -> int | None:
    """The exit code of a process, minus the signal that ended it; None while it runs."""
    found, status = os.waitpid(process, 0 if wait else os.WNOHANG)
    return os.waitstatus_to_exitcode(status) if found else None


def is_resumable(out: Path) -> bool:
    """Whether an output, or one below it, has a checkpoint."""
    return Draft(out).is_resumable or any(out.rglob(".*.partial/checkpoint/*.safetensors"))


def contents(folder: Path) -> dict[str, object]:
    """All files by their place, hidden ones too; manifests without ``took`` and the place of the folder.

    Logs of cells are left out: they say when they ran. What the unbroken run has made is copied, its place with it.
    """
    found: dict[str, object] = {}
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder).as_posix()
        if path.is_file() and not name.startswith("sweep/logs"):
            found[name] = path.read_bytes()
            if path.name == "manifest.json":
                text = path.read_text().replace(str(folder), "").replace(str(folder.with_name("whole")), "")
                found[name] = {**json.loads(text), "took": 0}
    return found


def broken(out: str, whole: Path, kills: int, seconds: float, rng: random.Random) -> tuple[int, list[str]]:
    """Kill a command ``kills`` times, half of them after a checkpoint; how many those were, and the faults."""
    folder, expected = whole.with_name("broken"), contents(whole)
    killed = after = 0
    faults: list[str] = []
    while killed < kills or folder.exists():
        if not folder.exists():
            shutil.copytree(whole, folder)
            _remove(folder / out)
        process = begin(f"{COMMANDS[out]} --resume -q", folder, rng.choice(PACES))
        awaits_checkpoint = killed % 2 == 1 and out in SAVING
        moment = time.monotonic() + rng.uniform(0, seconds)
        while (code := ended(process)) is None:
            if awaits_checkpoint and is_resumable(folder / out):
                awaits_checkpoint = False
                moment = time.monotonic() + rng.uniform(0, seconds / 4)
            if killed < kills and not awaits_checkpoint and time.monotonic() > moment:
                break
            time.sleep(0.002)
        if code is None:
            after += is_resumable(folder / out)
            os.killpg(process, signal.SIGKILL)
            ended(process, wait=True)
            killed += 1
            manifest = folder / out / "manifest.json"
            if manifest.exists() and Artefact(folder / out).faults():
                faults.append(f"{out} is not whole after kill {killed}")
            continue
        if code:
            faults.append(folder.with_suffix(".log").read_text(encoding="utf-8")[-500:])
        found = contents(folder)
        faults += [name for name in {*found, *expected} if found.get(name) != expected.get(name)]
        _remove(folder)
    return after, faults


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def main() -> int:
    """The table; exit code 1 if there are faults."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=20, help="of each command")
    parser.add_argument("--commands", nargs="*", choices=[*COMMANDS], default=[*COMMANDS])
    given = parser.parse_args()
    for name in ("torch._dynamo", "hypogoal.baselines.agents", "hypogoal.meta.training"):
        import_module(name)  # what every process would load
    root = Path(tempfile.mkdtemp(prefix="kills-"))
    whole = root / "whole"
    whole.mkdir()
    (whole / "toy.toml").write_text(TOY, encoding="utf-8")
    last = max([*COMMANDS].index(out) for out in given.commands)
    faults: list[str] = []
    print(f"{'output':16s} {'kills':>6s} {'after a checkpoint':>19s} {'faults':>7s}")
    for out in [*COMMANDS][: last + 1]:
        started = time.monotonic()
        if ended(begin(f"{COMMANDS[out]} -q", whole, "1e9"), wait=True):
            raise SystemExit(whole.with_suffix(".log").read_text(encoding="utf-8"))
        seconds = time.monotonic() - started
        if out not in given.commands:
            continue
        after, found = broken(out, whole, given.kills, seconds, random.Random(out))
        print(f"{out:16s} {given.kills:6d} {after:19d} {len(found):7d}", *found[:3], flush=True)
        faults += found
    shutil.rmtree(root)
    return bool(faults)


if __name__ == "__main__":
    sys.exit(main())
