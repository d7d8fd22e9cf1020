"""Spec G2: every stage under limits of the system, then resumed without them, against the same stage unbroken.

``python -m tests.attacks.limits [--stages train-meta ...] [--folder DIR]`` prints a table by stage and limit: tried,
ended within the limit, refused (one line, and nothing but a draft left), died (of a signal: a library that has no
memory aborts, which no program can catch; resumed it must be the same all the same), bad. Bad is whatever else: a
traceback, several lines, an output that is there and not whole, files that differ once it was resumed.
"""

from __future__ import annotations

import argparse
import os
import resource
import shutil
import sys
import tempfile
from collections import Counter
from pathlib import Path

from hypogoal.inspection import faults_of
from tests.attacks.kills import STAGES, begin, differences, needed, unbroken

KB, MB = 2**10, 2**20
OUTCOMES = ("ended", "refused", "died")
LIMITS: dict[str, tuple[int, tuple[int, ...]]] = {
    "file size (ulimit -f)": (resource.RLIMIT_FSIZE, (KB, 5 * KB, 10 * KB, 50 * KB, 200 * KB, MB)),
    "descriptors (ulimit -n)": (resource.RLIMIT_NOFILE, (5, 6, 7, 8, 10, 12)),
    "memory (ulimit -v)": (
        resource.RLIMIT_AS,
        (MB, 8 * MB, 32 * MB, 64 * MB, 128 * MB, 256 * MB),
    ),  # beyond what it has
}


def limited(name: str, folder: Path, kind: int, limit: int) -> str:
    """What became of one stage under one limit: ended, refused, or what was bad about it."""
    stage = STAGES[name]
    out, log = folder / f"limited-{name}{stage.suffix}", folder / f"limited-{name}.log"
    log.unlink(missing_ok=True)
    words = [*stage.arguments(folder), "--out", str(out), "--resume", "-q"]
    process = os.fork()
    if not process:  # the limit is its own, and goes on to the stage
        resource.setrlimit(kind, (limit, resource.getrlimit(kind)[1]))
        os._exit(os.waitstatus_to_exitcode(os.waitpid(begin(words, log, "0"), 0)[1]) & 0xFF)
    code = os.waitstatus_to_exitcode(os.waitpid(process, 0)[1])
    said = log.read_text(encoding="utf-8", errors="replace") if log.exists() else ""
    bad = []
    if code == 0:
        bad += faults_of(out)
    elif code < 128 and (code != 2 or said.count("\n") != 1 or "internal error" in said or out.exists()):
        bad.append(f"exit code {code}, {out.exists() and 'an output, '}said {said[-600:]!r}")
    if code:
        again = os.waitstatus_to_exitcode(os.waitpid(begin(words, log, "1e9"), 0)[1])
        bad += [f"resumed: exit code {again}, {log.read_text(encoding='utf-8')[-600:]!r}"] if again else []
    if out.exists():
        bad += differences(folder / out.name.removeprefix("limited-"), out)
        shutil.rmtree(out) if out.is_dir() else out.unlink()
    return "; ".join(bad) or ("died" if code >= 128 else "refused" if code else "ended")


def main() -> int:
    """Each stage under each limit."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--stages", nargs="*", choices=[*STAGES], default=["data", "ensemble", "options", "meta", "ppo"]
    )
    parser.add_argument("--folder", type=Path, help="where to work; a temporary one where not given")
    given = parser.parse_args()
    import torch

    import hypogoal.stages.train_baseline
    import hypogoal.stages.train_meta  # noqa: F401

    torch.set_num_threads(1)
    folder = given.folder or Path(tempfile.mkdtemp(prefix="limits-"))
    folder.mkdir(parents=True, exist_ok=True)
    print(f"{'stage':12s} {'limit':26s} {'tried':>6s} {'ended':>6s} {'refused':>8s} {'died':>5s} {'bad':>4s}")
    worst = 0
    for name in needed(given.stages):
        unbroken(STAGES[name], folder)
        for what, (kind, limits) in LIMITS.items():
            had = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
            found: Counter[str] = Counter()
            for limit in limits:
                told = limited(name, folder, kind, limit + (had if kind == resource.RLIMIT_AS else 0))
                found[told if told in OUTCOMES else "bad"] += 1
                if told not in OUTCOMES:
                    print(f"{name}, {what} {limit}: {told}", file=sys.stderr, flush=True)
            row = (len(limits), found["ended"], found["refused"], found["died"], found["bad"])
            print("{:12s} {:26s} {:6d} {:6d} {:8d} {:5d} {:4d}".format(name, what, *row), flush=True)
            worst += found["bad"]
    return worst > 0


if __name__ == "__main__":
    sys.exit(main())
