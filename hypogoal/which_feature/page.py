"""Spec H1: the benchmark's table, and a page that shows what each member owns and the states it is surest of."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from hypogoal import __version__
from hypogoal.core.files import replace_text
from hypogoal.evaluation import page
from hypogoal.evaluation.numbers import grouped
from hypogoal.evaluation.pictures import image_png
from hypogoal.evaluation.plots import drawing
from hypogoal.which_feature import scores
from hypogoal.which_feature.run import COPIES, Cell, Protocol
from hypogoal.which_feature.states import crossed_states, names_of

if TYPE_CHECKING:
    from rich.table import Table

TITLE = "WhichFeature"


@dataclasses.dataclass(frozen=True)
class Line:
    """What the seeds of one entry at one mix came to; each number as a float (seeds,).

    Attributes:
        entry, mix: which.
        coverage, best, same, gap, labels: see :func:`summary`.
    """

    entry: str
    mix: float
    coverage: NDArray[np.float64]
    best: NDArray[np.float64]
    same: NDArray[np.float64]
    gap: NDArray[np.float64]
    labels: NDArray[np.float64]


def summary(cells: Iterable[Cell], high: float, low: float) -> list[Line]:
    """Entries, mix by mix, those that cover most first.

    Args:
        cells: any.
        high, low: of ``scores.owned``.

    Returns:
        For each entry and mix, by seed: coverage; the highest ranking of a factor by any member, mean over factors;
        redundancy; calibration gap; labels needed, mean over the factors that are covered (NaN without any).
    """
    lines = []
    for (mix, entry), some in grouped(cells, lambda cell: (cell.mix, cell.entry)).items():
        by_seed = []
        for cell in sorted(some, key=lambda cell: cell.seed):
            ranked, covered = cell.ranking, scores.owned(cell.ranking, high, low).any(axis=0)
            gap = scores.calibration_gap(ranked, cell.balanced_accuracy, cell.at_best)
            labels = float(cell.labels[covered].mean()) if covered.any() else np.nan
            by_seed.append((covered.mean(), ranked.max(axis=0).mean(), scores.redundancy(ranked), gap, labels))
        lines.append(Line(entry, mix, *np.array(by_seed, dtype=np.float64).T))
    return sorted(lines, key=lambda line: (line.mix, -line.coverage.mean(), -line.best.mean(), line.entry))
