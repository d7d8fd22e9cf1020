"""Spec G1, G4: a toy sweep or run killed at random moments and started again, against an unbroken one, byte by byte.

``python -m tests.attacks.sweeps [--run] [--group] [--kills 20] [--pairs 0] [--seed 0] [--folder DIR]`` prints how often
it was killed, how many ended, how many of their files differ, and how many processes outlived the sweep. It gets
SIGKILL alone, and its cells die with it; with ``--group`` they all get it. With ``--pairs`` it is also started twice at
once, so many times: one of the two does it, or each is told in one line.
"""

from __future__ import annotations

import argparse
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

from hypogoal.core.checkpoints import PACE
from tests.attacks.kills import differences

SMALL = "--set members=2 --set sub_goals=open-red-door"
QUICK = "--set environments=8 --set warm_up=100 --set max_episode_steps=60 --set random_episodes=5"
TOY = f"""
format = 1
evaluate = false
axes = {{ seed = [0, 1] }}

[[cells]]
name = "data"
command = "collect doorkey --set heldout_layouts=1 --set unlabelled_seeds=1"

[[cells]]
name = "ensemble"
axes = ["seed"]
command = "train-ensemble {{data}} --seed {{seed}} --set steps=6 {SMALL}"

[[cells]]
name = "options"
axes = ["seed"]
command = "train-options {{ensemble}} --seed {{seed}} --set steps=800 {QUICK}"
"""


RUN = """
[run]
layout_seeds = [100]
controls = []
baselines = []
[collect]
heldout_layouts = 1
unlabelled_seeds = [1]
[train-ensemble]
steps = 6
members = 2
[train-options]
steps = 800
environments = 8
warm_up = 100
max_episode_steps = 60
random_episodes = 5
[train-meta]
steps = 800
decisions = 32
environments = 8
warm_up = 100
max_episode_steps = 60
random_episodes = 5
"""
TOLD = ("logs", "run.json", "sweep.json")  # when it was, and how often it was started
OUTLIVED_SECONDS = 5.0  # by which whoever dies with another has died
NAME = "HYPOGOAL_BENCHMARK"  # in the environment of all its processes


@dataclass
class Tally:
    """What became of the sweeps."""

    kills: int = 0
    ended: int = 0
    differences: int = 0
    outlived: int = 0


def begin(words: list[str], out: Path, log: Path) -> subprocess.Popen[bytes]:
    """The sweep as a process and a group of its own, its words in ``log``."""
    command = [sys.executable, "-m", "hypogoal", *words, "--out", str(out), "-q"]
    environment = {**os.environ, PACE: "0.02", NAME: str(out)}
    with log.open("ab") as file:
        return subprocess.Popen(command, stdout=file, stderr=file, env=environment, start_new_session=True)


def outlived(out: Path) -> int:
    """How many processes of a killed sweep there still are."""
    until = time.monotonic() + OUTLIVED_SECONDS
    mark = f"{NAME}={out}\0".encode()
    while alive := [path for path in Path("/proc").glob("[0-9]*/environ") if mark in _content(path)]:
        if time.monotonic() > until:
            break
        time.sleep(0.05)
    return len(alive)


def _content(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError:
        return b""


def unlike(one: Path, other: Path) -> list[str]:
    """Files of two sweeps that are not the same bytes, but for what says when it was."""
    return [name for name in differences(one, other) if name.split("/")[0] not in TOLD]


def sweeps(folder: Path, words: list[str], kills: int, rng: random.Random, *, group: bool = False) -> Tally:
    """Sweep again and again, killed ``kills`` times in all; each sweep's last start ends by itself.

    Raises:
        RuntimeError: a sweep failed.
    """
    out, whole, log = folder / "out", folder / "whole", folder / "log"
    started = time.monotonic()
    if begin(words, out, log).wait():
        raise RuntimeError(log.read_text(encoding="utf-8"))
    seconds = time.monotonic() - started
    out.rename(whole)
    tally = Tally()
    while tally.kills < kills:
        code: int | None = None
        while code != 0:
            process = begin(words, out, log)
            # So that it gets on: a start may come as far as two thirds of the way in one go.
            patience = rng.uniform(0, 0.7 * seconds) if tally.kills < kills else None
            try:
                code = process.wait(patience)
            except subprocess.TimeoutExpired:
                os.killpg(process.pid, signal.SIGKILL) if group else process.kill()
                code = process.wait()
                tally.kills += 1
                tally.outlived += outlived(out)
            if code not in (0, -signal.SIGKILL):
                raise RuntimeError(log.read_text(encoding="utf-8"))
        tally.ended += 1
        tally.differences += len(differ := unlike(whole, out))
        print("".join(f"{name} differs\n" for name in differ), end="", file=sys.stderr)
        shutil.rmtree(out)
    return tally


def paired(folder: Path, words: list[str], pairs: int, rng: random.Random) -> tuple[int, int]:
    """Start the sweep twice at once, ``pairs`` times: how many were refused, how many pairs were not as they should."""
    out, whole, logs = folder / "out", folder / "whole", [folder / f"log-{number}" for number in range(2)]
    refused = bad = 0
    for _ in range(pairs):
        processes = []
        for log in logs:
            log.unlink(missing_ok=True)
            processes.append(begin(words, out, log))
            time.sleep(rng.choice((0.0, rng.uniform(0, 5))))
        codes = [process.wait() for process in processes]
        told = [log.read_text(encoding="utf-8") for log, code in zip(logs, codes, strict=True) if code]
        fine = sorted(codes) in ([0, 0], [0, 2]) and all(text.count("\n") == 1 for text in told)
        differ = unlike(whole, out)
        if not fine or differ:
            print(codes, told, differ, file=sys.stderr)
        refused, bad = refused + len(told), bad + (not fine or bool(differ))
        shutil.rmtree(out)
    return refused, bad


def main() -> int:
    """Run it; exit code 1 when results differ."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--run", action="store_true", help="'hypogoal run', with evaluation and report, not a sweep")
    parser.add_argument("--group", action="store_true", help="kill all its processes, not the first alone")
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--pairs", type=int, default=0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--folder", type=Path, help="where to work; a temporary one where not given")
    given = parser.parse_args()
    folder = given.folder or Path(tempfile.mkdtemp(prefix="sweeps-"))
    folder.mkdir(parents=True, exist_ok=True)
    toml, rng = folder / "toy.toml", random.Random(given.seed)
    toml.write_text(RUN if given.run else TOY, encoding="utf-8")
    words = ["run", "doorkey", "--resume", "--preset", str(toml)] if given.run else ["sweep", str(toml)]
    tally = sweeps(folder, words, given.kills, rng, group=given.group)
    counts = f"files that differ {tally.differences}, processes that outlived it {tally.outlived}"
    print(f"kills {tally.kills}, ended {tally.ended}, {counts}", flush=True)
    refused, bad = paired(folder, words, given.pairs, rng)
    if given.pairs:
        print(f"pairs {given.pairs}, refused {refused}, bad {bad}")
    bad += tally.differences + tally.outlived
    if given.folder is None and not bad:
        shutil.rmtree(folder)
    return bad > 0


if __name__ == "__main__":
    sys.exit(main())
