"""Every benchmark of this checkout and of another one's, in turn: which figures changed, and by how much.

    python -m benchmarks.beside OTHER [--only doorkey loop] [--repeats N] [--short] [--json PATH]

OTHER is a checkout of another version; ``make setup`` has run in both. Each runs its own benchmarks by its own Python.
Figures are paired by name: what one version alone has is left out.
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from benchmarks import timing

HERE = Path(__file__).parents[1]
NAMES = ("doorkey", "training", "options", "loop", "limits")


def seconds_of(checkout: Path, name: str, short: bool) -> dict[str, float]:
    """A benchmark's figures by what they are of."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "figures.json")
        words = [str(checkout / ".venv/bin/python"), "-m", f"benchmarks.{name}", "--json", str(path)]
        words += ["--short"] if short else []
        subprocess.run(words, cwd=checkout, stdout=subprocess.DEVNULL, check=True)
        figures = json.loads(path.read_text(encoding="utf-8"))
    return dict(timed(figures, name))


def timed(figures: Any, place: str) -> Iterator[tuple[str, float]]:
    """Each row that has a name and seconds, below the place where its table stands."""
    if isinstance(figures, list):
        for row in figures:
            yield f"{place}: {row['name']}", row["seconds"]
    elif isinstance(figures, dict):
        for key, value in figures.items():
            yield from timed(value, f"{place} {key}")


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.beside", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("other", type=Path, help="a checkout of another version")
    parser.add_argument("--only", nargs="+", choices=NAMES, default=NAMES)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--short", action="store_true", help="a few seconds each")
    parser.add_argument("--json", type=Path, help="also write the figures here")
    given = parser.parse_args()
    about, rows = timing.machine(), []
    print(f"{'':60}{'other':>10}{'this':>10}{'this / other':>22}")
    for name in given.only:
        pairs = []
        for _ in range(given.repeats):
            pairs.append([seconds_of(checkout, name, given.short) for checkout in (given.other.resolve(), HERE)])
        others, ours = zip(*pairs, strict=True)
        for what in filter(ours[0].__contains__, others[0]):
            ratios = [this[what] / other[what] for other, this in pairs]
            least, middle, most = min(ratios), statistics.median(ratios), max(ratios)
            before, now = (1e3 * statistics.median(each[what] for each in found) for found in (others, ours))
            print(f"{what[:59]:60}{before:7.3g} ms{now:7.3g} ms{least:8.2f} /{middle:5.2f} /{most:5.2f}")
            rows.append({"name": what, "other": before, "this": now, "ratios": ratios})
    timing.write(given.json, about, {"repeats": given.repeats, "results": rows})


if __name__ == "__main__":
    main()
