"""What 'the last 100 episodes that ended' say, where failures last longer than successes: episodes with a known share.

python -m studies.finished docs/results/finished-episodes.csv             simulate, and print the tables
python -m studies.finished docs/results/finished-episodes.csv --tables    print the tables
"""

from __future__ import annotations

import csv
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hypogoal.learners.episodes import LAST
from studies.cells import parser_of, read_rows, table

ENVIRONMENTS, REPETITIONS, CHANGE = 16, 400, 40_000  # steps, of all environments together, like all steps here
CAPS = (57, 500)  # steps of a failed episode; a solved one takes 20 to 40
LOOKS = (500, 2_000, 8_000, 16_000, 32_000, 100_000)
AFTER = (500, 2_000, 8_000, 16_000, 32_000, 60_000)  # the change
SHARES = ((0.9, 0.9), (0.7, 0.7), (0.3, 0.3), (0.3, 0.9), (0.9, 0.3))  # solved, of episodes begun before and after it
COLUMNS = ("cap", "before", "after", "step", "episodes", "finished", "begun")


def episodes(before: float, after: float, cap: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """Episodes in the order in which they ended: where each began and ended, and whether it was solved, (n, 3)."""
    shape = (ENVIRONMENTS, (CHANGE + AFTER[-1]) // ENVIRONMENTS // 20 + 1)
    draws, solved = rng.random(shape), np.zeros(shape, np.bool_)
    length, ends = rng.integers(20, 41, shape), np.zeros(shape, np.int64)
    began = np.zeros(ENVIRONMENTS, np.int64)
    for turn in range(shape[1]):
        solved[:, turn] = draws[:, turn] < np.where(began < CHANGE, before, after)
        length[:, turn] = np.where(solved[:, turn], length[:, turn], cap)
        ends[:, turn] = began = began + ENVIRONMENTS * length[:, turn]
    rows = np.stack([ends - ENVIRONMENTS * length, ends, solved], axis=-1).reshape(-1, 3).astype(np.float64)
    return rows[np.argsort(rows[:, 1], kind="stable")]


def simulate() -> Iterator[tuple[str, ...]]:
    """Means over repetitions: of the last 100 that ended, and of the last 100 begun a cap ago or longer."""
    rng = np.random.default_rng(0)
    for cap in CAPS:
        for before, after in SHARES:
            played = [episodes(before, after, cap, rng) for _ in range(REPETITIONS)]
            for step in LOOKS if before == after else [CHANGE + since for since in AFTER]:
                counts, finished, begun = [], [], []
                for rows in played:
                    ended = rows[rows[:, 1] <= step]
                    counts.append(min(len(ended), LAST))
                    finished += [ended[-LAST:, 2].mean()] if len(ended) else []
                    old = ended[ended[:, 0] <= step - ENVIRONMENTS * cap]
                    old = old[np.argsort(old[:, 0], kind="stable")][-LAST:]
                    begun += [old[:, 2].mean()] if len(old) else []
                shares = (f"{np.mean(values):.4f}" if values else "" for values in (counts, finished, begun))
                yield str(cap), str(before), str(after), str(step), *shares


def tables(path: Path) -> Iterator[str]:
    """What the rows say, as lines of Markdown."""
    rows = read_rows(path)
    for changes, steps in ((False, LOOKS), (True, AFTER)):
        axis = f"steps after the share changed, at {CHANGE:,}" if changes else "steps since the beginning"
        yield f"Share solved of the last {LAST} that ended / of the last {LAST} begun a cap ago or longer, by {axis}:"
        yield ""
        lines = []
        for cap in CAPS:
            for before, after in SHARES:
                cells = [
                    f"{float(row['finished']):.2f} / {float(row['begun']):.2f}" if row["begun"] else row["finished"][:4]
                    for row in rows
                    if (row["cap"], row["before"], row["after"]) == (str(cap), str(before), str(after))
                ]
                share = f"{before} then {after}" if changes else str(before)
                lines += [[str(cap), share, *cells]] if changes == (before != after) else []
        yield from table(["cap", "solved", *(f"{step:,}" for step in steps)], lines)


def main() -> None:
    """Simulate, or print the tables only."""
    arguments = parser_of(__doc__).parse_args()
    if not arguments.tables:
        with arguments.csv.open("w", encoding="utf-8", newline="") as file:
            csv.writer(file, lineterminator="\n").writerows([COLUMNS, *simulate()])
    print("\n".join(tables(arguments.csv)))


if __name__ == "__main__":
    main()
