"""Whole commands of this checkout and of another one's, in turn: what one waits for.

    python -m benchmarks.commands OTHER [--only start report demo test] [--repeats N] [--json PATH]

OTHER is a checkout of another version; ``make setup`` has run in both, and nothing else runs. Each must have a virtual
environment of its own, because a linked one would run the same version twice. Each time is a wall time unless it says
CPU time.

- ``start``: one step of ``train-meta`` in a room, CPU time;
- ``report``: of the checkout's own ``runs/demo``, which ``make demo`` must have made, CPU time;
- ``demo``: ``make demo`` from nothing;
- ``test``: ``make test``, CPU time, without what a fork server's children take.
"""

from __future__ import annotations

import argparse
import os
import resource
import subprocess
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

from benchmarks import timing

HERE = Path(__file__).parents[1]
BEFORE = "which-feature"  # what 0.23 called the rooms
# Without this, each process compiles all modules anew, which takes as long as everything else in a command's start.
COMPILED = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
WANTED = {"start": 1 / 0.65, "demo": 1 / 0.40, "test": 1 / 0.35}


def require_own(checkout: Path) -> None:
    """End the program if the checkout's commands run the package of another checkout."""
    ask = [str(checkout / ".venv/bin/python"), "-I", "-c", "import hypogoal; print(hypogoal.__file__)"]
    told = subprocess.run(ask, capture_output=True, text=True, check=True)
    place = Path(told.stdout.strip())
    if checkout not in place.parents:
        raise SystemExit(f"{checkout} runs {place.parent}: remove its .venv and run 'make setup' there")


def timed(*words: object) -> tuple[float, float]:
    """Wall and CPU seconds of a command that must succeed."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    with tempfile.TemporaryFile("w+") as printed:  # a pipe would wait for what outlives the command
        begin = time.perf_counter()
        done = subprocess.run([*map(str, words)], stdout=printed, stderr=subprocess.STDOUT, env=COMPILED, check=False)
        waited = time.perf_counter() - begin
        printed.seek(0)
        if done.returncode:
            raise SystemExit(f"failed: {words}\n{printed.read()}")
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return waited, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def start(checkout: Path) -> float:
    """CPU seconds of a stage that does next to nothing."""
    command = checkout / ".venv/bin/hypogoal"
    domain = "rooms" if (checkout / "hypogoal/domains/rooms").exists() else BEFORE
    with tempfile.TemporaryDirectory() as name:
        data, ensemble = Path(name, "data.h5"), Path(name, "ensemble")
        timed(command, "collect", domain, "--out", data)
        timed(command, "train-ensemble", data, "--out", ensemble, "--set", "steps=2")
        _waited, seconds = timed(command, "train-meta", ensemble, "--out", Path(name, "meta"), "--set", "steps=1")
    return seconds


def report(checkout: Path) -> float:
    """CPU seconds of the report of the run that ``make demo`` leaves in the checkout."""
    with tempfile.TemporaryDirectory() as name:
        page = Path(name, "report")
        _waited, seconds = timed(checkout / ".venv/bin/hypogoal", "report", checkout / "runs/demo", "--out", page)
    return seconds


def demo(checkout: Path) -> float:
    """Seconds until both reports are there."""
    with tempfile.TemporaryDirectory() as name:
        waited, _seconds = timed("make", "-C", checkout, "demo", f"DEMO={name}/demo", f"ROOMS={name}/rooms")
    return waited


def test(checkout: Path) -> float:
    """CPU seconds of the tests."""
    _waited, seconds = timed("make", "-C", checkout, "test")
    return seconds


MEASURES: dict[str, Callable[[Path], float]] = {"start": start, "report": report, "demo": demo, "test": test}


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.commands", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("other", type=Path, help="a checkout of another version")
    parser.add_argument("--only", nargs="+", choices=MEASURES, default=[*MEASURES])
    parser.add_argument("--repeats", type=int, default=2)
    parser.add_argument("--json", type=Path, help="also write the figures here")
    given = parser.parse_args()
    for checkout in (HERE, given.other.resolve()):
        require_own(checkout)
    about = timing.machine()
    results = {}
    for name in given.only:
        checkouts = {"other": given.other.resolve(), name: HERE}
        candidates = {key: partial(MEASURES[name], checkout) for key, checkout in checkouts.items()}
        rows = timing.rows_of(timing.alternated(candidates, given.repeats), "other", WANTED)
        timing.show(f"\n{name}", rows)
        results[name] = rows
    timing.write(given.json, about, {"repeats": given.repeats, **results})


if __name__ == "__main__":
    main()
