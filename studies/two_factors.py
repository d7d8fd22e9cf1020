"""How often intervals over two factors hold what they are intervals of: seeds and ladders, each drawn anew.

    python -m studies.two_factors docs/results/two-factors.csv
    python -m studies.two_factors docs/results/two-factors.csv --tables

A table of seeds by ladders has two things that another run would draw anew. An interval over seeds alone says what
other ensembles would do on these ladders; one over both says what they would do on other ladders, too.

``SHAPES`` and the rule were fixed before the first run. A value is an effect of its seed, plus one of its ladder, plus
one of its own; a shape says how each of these three is drawn, all around 0. The rule is that of ``studies.coverage``:
a method is admitted from the least number of seeds on from which its coverage on the worst shape is never below .93.
Of admitted methods the one that is admitted soonest is shown, of two at once the narrower. There are six ladders.

- *pigeonhole*: seeds and ladders are drawn again, each with replacement and independently; the middle 95 % of the means
  (Owen 2007).
- *student*: Student's interval, from the variance of the seeds' means plus that of the ladders' means less what both
  count twice (Cameron et al. 2011), with the degrees of freedom of the smaller factor.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from studies.cells import Row, parser_of, printed, read_rows, table, write_rows
from studies.coverage import WANTED, Draw, mostly, normal, skewed

Values = NDArray[np.float64]
Bounds = tuple[Values, Values]

SEEDS = (3, 4, 5, 6, 7, 8, 10, 15, 20)
LADDERS = 6
EXPERIMENTS, RESAMPLES = 2_000, 1_000
COLUMNS = ("shape", "method", "seeds", "coverage", "width")
LUMPS = mostly(normal(250, 20), normal(-62.5, 20), 0.2)  # a fifth of them far off


def long_tail(rng: np.random.Generator, size: tuple[int, int]) -> Values:
    """Draw what is mostly a little below 0 and sometimes far above."""
    sigma = 0.8
    values = skewed(sigma)(rng, size)
    return 60 * (values - np.exp(sigma**2 / 2))


SHAPES: dict[str, tuple[Draw, Draw, Draw]] = {  # seeds, ladders, both
    "seeds differ": (normal(0, 80), normal(0, 10), normal(0, 40)),
    "ladders differ": (normal(0, 10), normal(0, 80), normal(0, 40)),
    "both differ": (normal(0, 60), normal(0, 60), normal(0, 60)),
    "neither differs": (normal(0, 1), normal(0, 1), normal(0, 80)),
    "a fifth of seeds far off": (LUMPS, normal(0, 30), normal(0, 40)),
    "a fifth of ladders far off": (normal(0, 30), LUMPS, normal(0, 40)),
    "skewed": (long_tail, long_tail, long_tail),
}


def drawn(shape: str, rng: np.random.Generator, seeds: int) -> Values:
    """Draw experiments of a shape: (EXPERIMENTS, seeds, LADDERS), of mean 0."""
    of_seed, of_ladder, own = SHAPES[shape]
    by_seed = of_seed(rng, (EXPERIMENTS, seeds))[:, :, None]
    by_ladder = of_ladder(rng, (EXPERIMENTS, LADDERS))[:, None, :]
    alone = own(rng, (EXPERIMENTS * seeds, LADDERS)).reshape(EXPERIMENTS, seeds, LADDERS)
    return by_seed + by_ladder + alone


def pigeonhole(values: Values) -> Bounds:
    """Bound the mean of (experiments, seeds, ladders) by drawing both factors again."""
    _, seeds, ladders = values.shape
    rng = np.random.default_rng(0)
    means = np.empty((RESAMPLES, len(values)))
    for number in range(RESAMPLES):
        of_seeds = np.bincount(rng.integers(seeds, size=seeds), minlength=seeds) / seeds
        of_ladders = np.bincount(rng.integers(ladders, size=ladders), minlength=ladders) / ladders
        means[number] = (values @ of_ladders) @ of_seeds
    low, high = np.quantile(means, (0.025, 0.975), axis=0)
    return low, high


def student(values: Values) -> Bounds:
    """Bound the mean of (experiments, seeds, ladders) by Student's interval over both factors."""
    _, seeds, ladders = values.shape
    mean = values.mean((1, 2))
    by_seed, by_ladder = values.mean(2), values.mean(1)
    of_seeds = by_seed.var(1, ddof=1) / seeds
    of_ladders = by_ladder.var(1, ddof=1) / ladders
    expected = by_seed[:, :, None] + by_ladder[:, None, :] - mean[:, None, None]
    freedom = (seeds - 1) * (ladders - 1)
    twice = ((values - expected) ** 2).sum((1, 2)) / freedom / (seeds * ladders)
    variance = np.maximum(of_seeds + of_ladders - twice, np.maximum(of_seeds, of_ladders))
    wide = stats.t.ppf(0.975, min(seeds, ladders) - 1) * np.sqrt(variance)
    return mean - wide, mean + wide


METHODS: dict[str, Callable[[Values], Bounds]] = {"pigeonhole": pigeonhole, "student": student}


def cells() -> Iterator[Row]:
    """The coverage and the mean width of each method at each number of seeds, on each shape."""
    for shape in SHAPES:
        for seeds in SEEDS:
            values = drawn(shape, np.random.default_rng(seeds), seeds)
            for name, method in METHODS.items():
                low, high = method(values)
                coverage = np.mean((low <= 0) & (high >= 0))
                width = np.mean(high - low)
                numbers = (shape, name, seeds, f"{coverage:.4f}", f"{width:.1f}")
                yield dict(zip(COLUMNS, numbers, strict=True))


def worst(rows: list[dict[str, str]], method: str) -> dict[int, float]:
    """By the number of seeds, the coverage of a method on its worst shape."""
    coverages: dict[int, float] = {}
    for row in rows:
        if row["method"] == method:
            seeds = int(row["seeds"])
            coverages[seeds] = min(float(row["coverage"]), coverages.get(seeds, 1.0))
    return coverages


def admitted_from(rows: list[dict[str, str]], method: str) -> int | None:
    """The least number of seeds from which a method's coverage is never below ``WANTED``."""
    least = None
    for seeds, coverage in sorted(worst(rows, method).items(), reverse=True):
        if coverage < WANTED:
            break
        least = seeds
    return least


def tables(path: Path) -> Iterator[str]:
    """What the cells say, as lines of Markdown."""
    rows = read_rows(path)
    lines = []
    for method in METHODS:
        coverages = worst(rows, method)
        least = admitted_from(rows, method)
        shown = "never" if least is None else f"from {least} seeds on"
        lines.append([method, *(f"{coverages[seeds]:.2f}" for seeds in SEEDS), shown])
    yield f"Coverage on the worst shape, by the number of seeds, with {LADDERS} ladders.\n"
    yield from table(["method", *(f"{seeds} seeds" for seeds in SEEDS), "reaches .93"], lines)


def main() -> None:
    """Simulate all shapes."""
    arguments = parser_of(__doc__).parse_args()
    if printed(arguments, tables):
        return
    write_rows(arguments.csv, COLUMNS, cells())
    print("\n".join(tables(arguments.csv)))


if __name__ == "__main__":
    main()
