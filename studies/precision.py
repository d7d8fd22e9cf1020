"""Ensembles of Montezuma's Revenge trained in bf16 and in float32.

    python -m studies.precision docs/results/precision.csv

A cell is N (labelled ladder groups), a method, a precision and a seed: one training as in ``studies.ladders``, of 450
steps. ``--tables`` draws the cells, beside those of ``figure3-ladders.csv``: float32 that rounds otherwise.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from studies import ladders
from studies.cells import Jobs, Row, difference, interval, parser_of, printed, run_cells, table
from studies.ladders import LOOKS, Seeds, crossed, read

UNTIL = 450
METHODS = ("dbat", "none")
PRECISIONS = ("float32", "bf16")
SCORES: dict[str, Callable[[Seeds], NDArray[np.float64]]] = {
    "ranking": partial(crossed, name="ranking"),
    "balanced accuracy at 0.5": partial(crossed, name="balanced_accuracy"),
    f"mean member's ranking after {UNTIL} steps": lambda seeds: np.array(
        [looks[UNTIL]["ranking_unseen"].mean() for looks in seeds.values()]
    ),
}


def run_cell(groups: int, method: str, precision: str, seed: int, looks: tuple[int, ...]) -> list[Row]:
    """One training; its method is named with its precision."""
    rows = ladders.run_cell(groups, method, seed, looks, precision=precision)
    return [{**row, "method": f"{method} {precision}"} for row in rows]


def tables(path: Path) -> Iterator[str]:
    """What the cells say, as lines of Markdown."""
    rows = []
    for groups in (1, 2):
        cells, published = read(path, groups), read(path.with_name("figure3-ladders.csv"), groups)
        for method in METHODS:
            if f"{method} float32" in cells:
                float32, bf16 = (cells[f"{method} {precision}"] for precision in PRECISIONS)
                before = {seed: {step: published[method][seed][step] for step in float32[seed]} for seed in float32}
                for name, measure in SCORES.items():
                    usual, new, other = map(measure, (float32, bf16, before))
                    numbers = (interval(usual), difference(new - usual), difference(other - usual))
                    rows.append([str(groups), method, name, str(len(usual)), *numbers])
    titles = ["N", "", "on unseen rooms", "seeds", "float32", "bf16 minus it", "float32 as published minus it"]
    yield from table(titles, rows)


def main() -> None:
    """Run the cells that are not in the file yet."""
    parser = parser_of(__doc__, "0-9")
    parser.add_argument("--methods", default=",".join(METHODS), help="comma-separated; all by default")
    arguments = parser.parse_args()
    if printed(arguments, tables):
        return
    looks = tuple(step for step in LOOKS if step <= UNTIL)
    jobs: Jobs = {
        (str(groups), f"{method} {precision}", str(seed)): partial(run_cell, groups, method, precision, seed, looks)
        for method in arguments.methods.split(",")
        for groups in (1, 2)
        for seed in arguments.seeds
        for precision in PRECISIONS
    }
    run_cells(arguments.csv, ladders.COLUMNS, ladders.KEYS[:3], jobs, lambda _: looks, arguments.workers)


if __name__ == "__main__":
    main()
