"""What a newcomer waits for first: ``hypogoal --help`` and the collection of DoorKey's states, whole processes.

python -m benchmarks startup [--short] [--json PATH]
"""

from __future__ import annotations

import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from benchmarks import timing

WANTED = {"--help": 0.4, "collect doorkey": 10.0}  # seconds


def seconds(*command: str) -> float:
    """Wall-clock seconds of a command in a process of its own."""
    begin = time.perf_counter()
    subprocess.run([sys.executable, "-m", "hypogoal", *command], check=True, capture_output=True)
    return time.perf_counter() - begin


def main() -> None:
    """Measure, print, write."""
    given = timing.arguments(__doc__, "startup")
    repeats = 2 if given.short else 7
    about = timing.machine("typer", "h5py")
    print(", ".join(f"{name} {value}" for name, value in about.items()))
    with tempfile.TemporaryDirectory() as folder:
        data = str(Path(folder) / "data.h5")
        helped = [seconds("--help") for _ in range(repeats)]
        collected = [seconds("collect", "doorkey", "--out", data, "--force", "-q") for _ in range(repeats)]
    results = {}
    for name, times in (("--help", helped), ("collect doorkey", collected)):
        results[name] = {"seconds": statistics.median(times), "highest": max(times), "wanted": WANTED[name]}
        print(f"{name:20}{statistics.median(times):8.2f} s (wanted: under {WANTED[name]} s)")
    timing.write(given.json, about, {"repeats": repeats, "results": results})


if __name__ == "__main__":
    main()
