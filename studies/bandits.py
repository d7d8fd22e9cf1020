"""How soon is the right member known? Choosers on the rooms of WhichFeature, a few hundred episodes each.

    python -m studies.bandits runs/which-feature docs/results/which-feature-bandits.csv
    python -m studies.bandits --tables docs/results/which-feature-bandits.csv

The first path is the folder of ``hypogoal run which-feature``, whose ensembles are played with.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np

from hypogoal.cli import main as hypogoal
from studies.cells import Jobs, Row, interval, parser_of, read_rows, run_cells, table

CHOOSERS = {"thompson": "Thompson sampling", "ppo": "PPO", "random": "uniform-random"}
# By name as in the CSV; Exp3 is gone, since it was slower than Thompson sampling: for the rows that were made with it.
TITLES = {"thompson": CHOOSERS["thompson"], "exp3": "Exp3", **CHOOSERS}
METHODS = {"dbat": "D-BAT, K = 3", "one": "one classifier, K = 1"}
TRUTHS = ("shape", "place")
ENDS, WINDOW = (50, 100, 200, 400), 50  # episodes so far, of which the last are looked at
KEYS = ("method", "truth", "chooser", "seed")
COLUMNS = (*KEYS, "step", "success")


def run_cell(run: Path, method: str, truth: str, chooser: str, seed: str) -> list[Row]:
    """One agent, and the share of solved episodes before each of ``ENDS``."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "agent"
        settings = [f"chooser={chooser}", f"world=truth={truth}", f"steps={ENDS[-1]}", "random_episodes=0"]
        command = ["train-meta", str(run / "ensemble" / f"method-{method}-seed-{seed}"), "--out", str(out), "--quiet"]
        command += [
            "--seed",
            seed,
            "--layout-seed",
            seed,
            *(word for setting in settings for word in ("--set", setting)),
        ]
        if hypogoal(command):
            raise SystemExit(f"failed: {' '.join(command)}")
        solved = np.array([float(row["reward"]) > 0 for row in read_rows(out / "episodes.csv")])
    place = {"method": method, "truth": truth, "chooser": chooser, "seed": seed}
    return [place | {"step": end, "success": float(solved[end - WINDOW : end].mean())} for end in ENDS]


def tables(path: Path) -> Iterator[str]:
    """What the cells say, as lines of Markdown."""
    rows = read_rows(path)
    yield f"Share of the last {WINDOW} episodes solved, by episodes so far: mean with a 95 % interval."
    yield ""
    lines = []
    for method, title in METHODS.items():
        for truth in TRUTHS:
            for chooser, name in TITLES.items():
                cells = [r for r in rows if (r["method"], r["truth"], r["chooser"]) == (method, truth, chooser)]
                if cells:
                    shares = {
                        end: np.array([float(r["success"]) for r in cells if int(r["step"]) == end]) for end in ENDS
                    }
                    good = f"{(shares[200] >= 0.9).sum()} of {len(shares[200])}"
                    lines.append([truth, title, name, *(interval(shares[end], 2) for end in ENDS[1:]), good])
    yield from table(["rewarded", "members", "chooser", *map(str, ENDS[1:]), "90 % at 200 on"], lines)


def main() -> None:
    """Run the cells that are not in the file yet, or draw the tables."""
    arguments = parser_of(__doc__, run="the folder of hypogoal run which-feature").parse_args()
    if not arguments.tables:
        seeds = sorted(path.name.rpartition("-")[2] for path in (arguments.run / "ensemble").glob("method-dbat-seed-*"))
        jobs: Jobs = {
            (method, truth, chooser, seed): partial(run_cell, arguments.run, method, truth, chooser, seed)
            for seed in seeds
            for method in METHODS
            for truth in TRUTHS
            for chooser in (CHOOSERS if method == "dbat" else ("thompson",))
        }
        run_cells(arguments.csv, COLUMNS, KEYS, jobs, lambda _: ENDS, 1)
    print("\n".join(tables(arguments.csv)))


if __name__ == "__main__":
    main()
