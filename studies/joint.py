"""What proposals=joint hangs on: each part of its features left out, fewer and more restarts, on its choosing seeds.

python -m studies.joint docs/results/which-feature-parts.csv            run what the file lacks
python -m studies.joint docs/results/which-feature-random.csv --random  random filters on seeds 410 to 419
python -m studies.joint docs/results/which-feature-parts.csv --tables   print the table
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hypogoal.core.files import write_table
from hypogoal.core.progress import Progress
from hypogoal.hypotheses import patterns, proposals
from hypogoal.which_feature.run import COLUMNS, JOINT, parse_entry, read_cells, resolved, rows_of, run_cell
from hypogoal.which_feature.states import FACTORS
from hypogoal.which_feature.table import summary
from studies.cells import table
from studies.which_feature import HIGH, LOW, covered

SEEDS, MIXES = (200, 201, 202, 203, 204), (1.0,)


class RandomPatterns(patterns.Patterns):
    """Filters that are noise instead of patches of the pictures."""

    def __init__(self, pictures: NDArray[np.uint8], stride: int, rng: np.random.Generator):
        super().__init__(pictures, stride, rng)
        shape = tuple(self.weight.shape)
        self.weight = torch.from_numpy(rng.normal(0.0, 1.0 / patterns.SIDE, shape).astype(np.float32))
        centre = float(pictures.mean()) / 255.0
        offsets = torch.from_numpy(rng.normal(0.0, 0.3, len(self.bias)).astype(np.float32))
        self.bias = offsets - centre * self.weight.sum((1, 2, 3))


class WholePatterns(patterns.Patterns):
    """Sums over the picture alone."""

    def of(self, pictures: NDArray[np.uint8]) -> Tensor:
        features = super().of(pictures)
        return features[:, : features.shape[1] // 3]


def alike(features: Tensor, labels: Tensor) -> Tensor:
    """The same relevance for every feature that varies."""
    return (features.std(0) > 0).float()


VARIANTS: Mapping[str, tuple[Mapping[str, Any], Mapping[str, Any]]] = {  # settings, and what stands in for parts
    "as it is": ({}, {}),
    "random filters": ({}, {"Patterns": RandomPatterns}),
    "no halves": ({}, {"Patterns": WholePatterns}),
    "no relevance": ({}, {"relevance": alike}),
    "32 restarts": ({"restarts": 32}, {}),
    "300 restarts": ({"restarts": 300}, {}),
}


def run(path: Path, cells_wanted: Iterable[tuple[str, float, int]], agreement: str | None = None) -> None:
    """Run the cells (variant, mix, seed) that the file lacks; the agreement is 1 - mix where it is not given."""
    cells = read_cells(path) if path.exists() else []
    complete = {(cell.entry, cell.mix, cell.seed) for cell in cells}
    wanted = [cell for cell in cells_wanted if cell not in complete]
    with Progress(path.stem, len(wanted)) as progress:
        for variant, mix, seed in wanted:
            settings, parts = VARIANTS[variant]
            config = replace(resolved({}), agreement=agreement or f"{1.0 - mix:g}", **settings)
            with mock.patch.multiple(proposals, **{"Patterns": patterns.Patterns, **parts}):
                cells.append(replace(run_cell(parse_entry(JOINT), mix, seed, config), entry=variant))
            write_table(path, COLUMNS, rows_of(cells, FACTORS))
            progress.advance()


def tables(path: Path) -> Iterator[str]:
    """Coverage (best) of each variant, by mix."""
    lines = {(line.entry, line.mix): line for line in summary(read_cells(path), HIGH, LOW)}
    mixes = sorted({mix for _, mix in lines})
    yield "Coverage with Student's 95 % interval over seeds (best)."
    yield ""
    yield from table(
        ["", *(f"mix {mix:g}" for mix in mixes)],
        (
            [variant, *(covered(lines[variant, mix]) for mix in mixes)]
            for variant in VARIANTS
            if all((variant, mix) in lines for mix in mixes)
        ),
    )


def main() -> None:
    """Run, or print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("csv", type=Path, help="the file of all cells; made where there is none")
    parser.add_argument("--tables", action="store_true", help="print the table and run nothing")
    parser.add_argument("--random", action="store_true", help="test random filters, with the agreement found")
    arguments = parser.parse_args()
    if arguments.tables:
        print("\n".join(tables(arguments.csv)))
        return
    torch.set_num_threads(1)
    if arguments.random:
        run(arguments.csv, product(["random filters"], (0.5, 1.0), range(410, 420)), "auto")
    else:
        run(arguments.csv, product(VARIANTS, MIXES, SEEDS))


if __name__ == "__main__":
    main()
