"""Spec H1: the benchmark's table."""

import dataclasses
from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray
from rich.table import Table

from hypogoal.evaluation import page
from hypogoal.evaluation.numbers import grouped, student_interval
from hypogoal.which_feature import scores
from hypogoal.which_feature.run import Scored, WhichFeatureConfig

TITLE = "WhichFeature"


@dataclasses.dataclass(frozen=True)
class Line:
    """The numbers of an entry at a mix, each a float (seeds,), see :func:`summary`."""

    entry: str
    mix: float
    coverage: NDArray[np.float64]
    best: NDArray[np.float64]
    same: NDArray[np.float64]
    gap: NDArray[np.float64]
    labels: NDArray[np.float64]


def summary(cells: Iterable[Scored], high: float, low: float) -> list[Line]:
    """Entries, mix by mix, highest coverage first; ``high`` and ``low`` are those of ``scores.owned``.

    For each entry and mix, by seed: coverage; the highest ranking of a factor by any member, mean over factors;
    redundancy; calibration gap; labels needed, mean over covered factors (NaN without any).
    """
    lines = []
    for (mix, entry), group in grouped(cells, lambda cell: (cell.mix, cell.entry)).items():
        by_seed = []
        for cell in sorted(group, key=lambda cell: cell.seed):
            ranked, covered = cell.ranking, scores.owned(cell.ranking, high, low).any(axis=0)
            gap = scores.calibration_gap(ranked, cell.balanced_accuracy, cell.at_best)
            labels = float(cell.labels[covered].mean()) if covered.any() else np.nan
            by_seed.append((covered.mean(), ranked.max(axis=0).mean(), scores.redundancy(ranked), gap, labels))
        lines.append(Line(entry, mix, *np.array(by_seed, dtype=np.float64).T))
    return sorted(lines, key=lambda line: (line.mix, -line.coverage.mean(), -line.best.mean(), line.entry))


def with_interval(values: NDArray[np.float64]) -> str:
    """Mean and Student's 95 % interval over seeds; fewer than three are shown one by one; a dash for none."""
    values = values[~np.isnan(values)]
    if len(values) < 3:
        return ", ".join(f"{value:.2f}" for value in values) or "–"
    low, high = student_interval(values)
    return f"{values.mean():.2f} ± {(high - low) / 2:.2f}"


def _mean(values: NDArray[np.float64]) -> str:
    values = values[~np.isnan(values)]
    return f"{values.mean():.2f}" if len(values) else "–"


COLUMNS = (
    page.label("entry", lambda line: line.entry),
    page.number("mix", lambda line: line.mix, "{:g}".format),
    page.number("seeds", lambda line: len(line.coverage)),
    page.number("coverage", lambda line: line.coverage, with_interval),
    page.number("best", lambda line: line.best, _mean),
    page.number("same", lambda line: line.same, _mean),
    page.number("gap", lambda line: line.gap, _mean),
    page.number("labels", lambda line: line.labels, _mean),
)


def table_of(cells: Iterable[Scored], config: WhichFeatureConfig) -> Table:
    """The table for a terminal."""
    return page.terminal(TITLE, COLUMNS, summary(cells, config.high, config.low))
