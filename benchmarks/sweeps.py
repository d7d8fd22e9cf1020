"""Spec G1, G4: a toy sweep killed at random moments and started again, against an unbroken one, byte by byte.

``python -m benchmarks.sweeps [--kills 20] [--seed 0] [--folder DIR]`` prints how often it was killed, how many sweeps
ended, and how many of their ``results.csv`` differ. The sweep gets SIGKILL; its cells die with it.
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


@dataclass
class Tally:
    """What became of the sweeps."""

    kills: int = 0
    ended: int = 0
    differences: int = 0


def begin(toy: Path, out: Path) -> subprocess.Popen[bytes]:
    """The sweep as a process of its own, its words beside ``out``."""
    command = [sys.executable, "-m", "hypogoal", "sweep", str(toy), "--out", str(out), "-q"]
    with out.with_suffix(".log").open("ab") as log:
        return subprocess.Popen(command, stdout=log, stderr=log, env={**os.environ, PACE: "0.02"})


def sweeps(folder: Path, kills: int, rng: random.Random) -> Tally:
    """Sweep again and again, killed ``kills`` times in all; each sweep's last start ends by itself.

    Raises:
        RuntimeError: a sweep failed.
    """
    toy, whole = folder / "toy.toml", folder / "whole"
    toy.write_text(TOY, encoding="utf-8")
    started = time.monotonic()
    if begin(toy, whole).wait():
        raise RuntimeError(whole.with_suffix(".log").read_text(encoding="utf-8"))
    seconds = time.monotonic() - started
    tally = Tally()
    while tally.kills < kills:
        out = folder / f"broken-{tally.ended}"
        code: int | None = None
        while code != 0:
            process = begin(toy, out)
            # So that it gets on: a start may come as far as two thirds of the way in one go.
            patience = rng.uniform(0, 0.7 * seconds) if tally.kills < kills else None
            try:
                code = process.wait(patience)
            except subprocess.TimeoutExpired:
                process.kill()
                code = process.wait()
                tally.kills += 1
            if code not in (0, -signal.SIGKILL):
                raise RuntimeError(out.with_suffix(".log").read_text(encoding="utf-8"))
        tally.ended += 1
        tally.differences += (out / "results.csv").read_bytes() != (whole / "results.csv").read_bytes()
    return tally


def main() -> int:
    """Run it; exit code 1 when results differ."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--folder", type=Path, help="where to work; a temporary one where not given")
    given = parser.parse_args()
    folder = given.folder or Path(tempfile.mkdtemp(prefix="sweeps-"))
    folder.mkdir(parents=True, exist_ok=True)
    tally = sweeps(folder, given.kills, random.Random(given.seed))
    print(f"kills {tally.kills}, sweeps ended {tally.ended}, results that differ {tally.differences}")
    if given.folder is None and not tally.differences:
        shutil.rmtree(folder)
    return tally.differences > 0


if __name__ == "__main__":
    sys.exit(main())
