"""Ensembles of Montezuma's Revenge trained in bf16, beside the float32 cells of Figure 3.

    python -m studies.precision docs/results/precision.csv

A cell is N (labelled ladder groups), a method, a precision and a seed: one training as in ``studies.ladders``, of 450
steps. ``rounded`` is the control: float32 that computes the same from whole images instead of distinct patches, so that
only rounding differs. ``--tables`` draws the cells; float32 is read from ``figure3-ladders.csv`` beside the file.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from unittest.mock import patch

import numpy as np
from numpy.typing import NDArray

from hypogoal.hypotheses import patches
from studies import ladders
from studies.cells import Row, interval, parser_of, run_cells, table
from studies.ladders import LOOKS, Seeds, crossed, read

UNTIL = 450
CELLS = (("dbat", "bf16"), ("none", "bf16"), ("dbat", "rounded"))
SCORES: dict[str, Callable[[Seeds], NDArray[np.float64]]] = {
    "ranking": partial(crossed, name="ranking"),
    "balanced accuracy at 0.5": partial(crossed, name="balanced_accuracy"),
    f"mean member's ranking after {UNTIL} steps": lambda seeds: np.array(
        [looks[UNTIL]["ranking_unseen"].mean() for looks in seeds.values()]
    ),
}


def run_cell(groups: int, method: str, precision: str, seed: int, looks: tuple[int, ...]) -> list[Row]:
    """One training; its method is named with its precision."""
    if precision == "rounded":
        with patch.object(patches, "WORTHWHILE", 0.0):
            rows = ladders.run_cell(groups, method, seed, looks)
    else:
        rows = ladders.run_cell(groups, method, seed, looks, precision=precision)
    return [{**row, "method": f"{method} {precision}"} for row in rows]


def tables(path: Path) -> Iterator[str]:
    """What the cells say, as lines of Markdown."""
    rows = []
    for groups in (1, 2):
        float32, others = read(path.with_name("figure3-ladders.csv"), groups), read(path, groups)
        for name, seeds in others.items():
            before = _until(float32[name.split()[0]], seeds)
            for score, measure in SCORES.items():
                values, reference = measure(seeds), measure(before)
                numbers = map(interval, (reference, values, values - reference))
                rows.append([str(groups), name, score, str(len(values)), *numbers])
    yield from table(["N", "", "on unseen rooms", "seeds", "float32", "it", "it minus float32"], rows)


def _until(float32: Seeds, seeds: Seeds) -> Seeds:
    """Of the float32 cells the same seeds and looks."""
    return {seed: {step: float32[seed][step] for step in looks} for seed, looks in seeds.items()}


def main() -> None:
    """Run the cells that are not in the file yet."""
    parser = parser_of(__doc__, "0-9")
    arguments = parser.parse_args()
    if arguments.tables:
        print("\n".join(tables(arguments.csv)))
        return
    looks = tuple(step for step in LOOKS if step <= UNTIL)
    jobs: dict[tuple[str, ...], Callable[[], list[Row]]] = {
        (str(groups), f"{method} {precision}", str(seed)): partial(run_cell, groups, method, precision, seed, looks)
        for method, precision in CELLS
        for groups in ((1, 2) if precision == "bf16" else (1,))
        for seed in arguments.seeds
    }
    run_cells(arguments.csv, ladders.COLUMNS, ladders.KEYS[:3], jobs, lambda _: looks, arguments.workers)


if __name__ == "__main__":
    main()
