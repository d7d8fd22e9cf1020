"""What the benchmarks share: alternate the candidates, take medians, print ratios, write JSON."""

from __future__ import annotations

import argparse
import json
import os
import platform
import statistics
import subprocess
import time
from collections.abc import Callable, Mapping, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any


def alone() -> None:
    """One thread, as in the tables of the documentation: set before torch is imported."""
    os.environ["OMP_NUM_THREADS"] = "1"


def machine(*packages: str) -> dict[str, str]:
    """Where it is measured, of which commit (with a + where files differ from it), with which versions; printed."""
    model = platform.processor() or "unknown"
    info = Path("/proc/cpuinfo")
    if info.exists():
        names = [line.split(":")[1].strip() for line in info.read_text().splitlines() if line.startswith("model name")]
        model = f"{names[0]}, {len(os.sched_getaffinity(0))} cores" if names else model
    versions = {name: metadata.version(name) for name in packages}
    told = subprocess.run(["git", "describe", "--always", "--dirty=+"], capture_output=True, text=True, check=False)
    commit = {"commit": told.stdout.strip()} if told.returncode == 0 else {}
    about = {"processor": model, **commit, "python": platform.python_version(), **versions}
    print(", ".join(f"{name} {value}" for name, value in about.items()))
    return about


def arguments(doc: str | None, name: str) -> argparse.Namespace:
    """``--short`` and ``--json PATH``, which every benchmark has."""
    parser = argparse.ArgumentParser(prog=f"python -m benchmarks.{name}", description=(doc or "").split("\n")[0])
    parser.add_argument("--short", action="store_true", help="a few seconds, for continuous integration")
    parser.add_argument("--json", type=Path, help="also write the figures here")
    return parser.parse_args()


def cpu_seconds(work: Callable[[], object]) -> float:
    """CPU time of this process, so that a busy machine matters little."""
    begin = time.process_time()
    work()
    return time.process_time() - begin


def alternated(candidates: Mapping[str, Callable[[], float]], repeats: int) -> dict[str, list[float]]:
    """Every candidate's figure in every repeat; they take turns, so that a busy machine slows all alike."""
    found: dict[str, list[float]] = {name: [] for name in candidates}
    for _ in range(repeats):
        for name, measure in candidates.items():
            found[name].append(measure())
    return found


def rows_of(found: Mapping[str, Sequence[float]], reference: str, wanted: Mapping[str, float]) -> list[dict[str, Any]]:
    """Per candidate its median seconds and how many times faster than ``reference`` it is in the same repeat."""
    rows = []
    for name, seconds in found.items():
        ratios = [slow / fast for slow, fast in zip(found[reference], seconds, strict=True)]
        row = {"name": name, "seconds": statistics.median(seconds), "lowest": min(seconds), "highest": max(seconds)}
        row |= {"ratio": statistics.median(ratios), "ratios": ratios, "wanted": wanted.get(name)}
        rows.append(row)
    return rows


def show(title: str, rows: Sequence[Mapping[str, Any]]) -> None:
    """A table that fits 80 columns."""
    print(f"{title}\n{'':44}{'median':>11}{'ratio':>9}{'wanted':>9}")
    for row in rows:
        wanted = f"{row['wanted']:.1f}x" if row["wanted"] else ""
        print(f"{row['name'][:43]:44}{1e3 * row['seconds']:8.3g} ms{row['ratio']:8.2f}x{wanted:>9}")


def write(path: Path | None, about: Mapping[str, str], results: Mapping[str, Any]) -> None:
    """The figures as JSON, where asked for."""
    if path:
        path.write_text(json.dumps({"machine": about, **results}, indent=2) + "\n", encoding="utf-8")
