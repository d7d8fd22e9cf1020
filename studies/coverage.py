"""How often 95 % intervals hold what they are intervals of, on shapes that our cells have.

    python -m studies.coverage docs/results/coverage.csv
    python -m studies.coverage docs/results/coverage.csv --tables

``SHAPES`` and the rule were fixed before the first run. A shape is one of a kind of number, and the kind, not the
values at hand, decides which interval a table shows:

- *score*: a member's ranking or accuracy, a mean over sub-goals or states. It spreads, also where it is near 1.
- *solved*: a share of episodes. It may lie at 0 or 1, and most seeds may be alike where a few fail.
- *pair of scores*, *pair of shares*: the difference of two of these with one seed or layout.
- *amount*: steps, distances, lengths in shortest paths, which are skewed or of two lumps.
- *count*: how many of n.

The rule: a method's coverage at some n is that of its worst shape. It is admitted from the least n on from which its
coverage is never below ``WANTED``. Of a kind's methods the one that is admitted soonest is chosen; of those that are
admitted at once, the one that is narrowest at n = 10, in the mean over shapes. Below that n a table shows the mean and
the range. ``bounded`` and ``median`` ask for nothing but independent values, and so were left out where Student's is
narrower by far: the first is of shares alone, the second, which is an interval of the median, of what has lumps.

Percentile and BCa are SciPy's, with 1,000 resamples; 2,000 experiments a shape and n.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from studies.cells import Row, parser_of, printed, read_rows, table, write_rows

Values = NDArray[np.float64]
Draw = Callable[[np.random.Generator, tuple[int, int]], Values]
Bounds = tuple[Values, Values]

WANTED = 0.93
SIZES = (3, 4, 5, 6, 8, 10, 15, 20, 40)
WIDTH_AT = 10
EXPERIMENTS, RESAMPLES, WEIGHTS = 2_000, 1_000, 2_000
TRUTH_FROM = 400_000  # values from which a shape's mean and median are taken
COLUMNS = ("kind", "shape", "method", "n", "coverage", "width")


def mostly(high: Draw, low: Draw, share: float) -> Draw:
    """Draw from two lumps, this share of the values from the first."""

    def draw(rng: np.random.Generator, size: tuple[int, int]) -> Values:
        first = rng.random(size) < share
        return np.where(first, high(rng, size), low(rng, size))

    return draw


def uniform(low: float, high: float) -> Draw:
    """Draw evenly."""
    return lambda rng, size: rng.uniform(low, high, size)


def beta(first: float, second: float) -> Draw:
    """Draw from a beta distribution."""
    return lambda rng, size: rng.beta(first, second, size)


def normal(mean: float, deviation: float) -> Draw:
    """Draw from a normal distribution."""
    return lambda rng, size: rng.normal(mean, deviation, size)


def skewed(sigma: float) -> Draw:
    """Draw from a log-normal distribution of median 1."""
    return lambda rng, size: rng.lognormal(0, sigma, size)


def minus(first: Draw, second: Draw) -> Draw:
    """Draw the differences of pairs."""
    return lambda rng, size: first(rng, size) - second(rng, size)


def won(chance: float) -> Draw:
    """Draw 0 or 1."""
    return lambda rng, size: (rng.random(size) < chance).astype(np.float64)


ONE = uniform(1, 1)
SOLVED = mostly(ONE, uniform(0.94, 1), 0.6)
A_FEW_FAIL = mostly(uniform(0.95, 1), uniform(0, 0.3), 0.8)
SHAPES: dict[str, dict[str, Draw]] = {
    "score": {
        "normal": normal(0.9, 0.02),
        "even": uniform(0.4, 0.9),
        "near 1": beta(60, 2),
    },
    "solved": {
        "near 1": SOLVED,
        "near 0": beta(2, 9),
        "even": uniform(0.15, 0.7),
        "half at 1": mostly(ONE, uniform(0.6, 1), 0.5),
        "one in five fails": A_FEW_FAIL,
        "one in ten fails": mostly(ONE, uniform(0, 0.65), 0.9),
    },
    "pair of scores": {
        "normal": normal(0.02, 0.03),
        "near 1": minus(beta(60, 2), beta(60, 2)),
        "near 1, from spread": minus(beta(60, 2), uniform(0.4, 0.9)),
    },
    "pair of shares": {
        "near 1, from spread": minus(SOLVED, uniform(0.15, 0.7)),
        "a few fail in both": minus(A_FEW_FAIL, A_FEW_FAIL),
        "alike but for one in seven": mostly(normal(0, 0.01), uniform(-1, 0), 6 / 7),
    },
    "amount": {
        "skewed": skewed(0.6),
        "very skewed": skewed(1.0),
        "two lumps": mostly(normal(1.1, 0.03), uniform(5, 30), 0.75),
    },
    "count": {f"{chance:g}": won(chance) for chance in (0.02, 0.1, 0.3, 0.5, 0.8, 0.95)},
}
OF_THE_MEDIAN = ("median",)


def student(values: Values) -> Bounds:
    """Student's interval of the mean of (experiments, n)."""
    n = values.shape[1]
    mean = values.mean(1)
    error = values.std(1, ddof=1) / np.sqrt(n)
    wide = stats.t.ppf(0.975, n - 1) * error
    return mean - wide, mean + wide


def percentile(values: Values) -> Bounds:
    """The percentile bootstrap's."""
    return _by_scipy(values, "percentile")


def bca(values: Values) -> Bounds:
    """The bias-corrected and accelerated bootstrap's."""
    return _by_scipy(values, "BCa")


def _by_scipy(values: Values, method: str) -> Bounds:
    rng = np.random.default_rng(0)
    with np.errstate(all="ignore"):
        drawn = stats.bootstrap((values,), np.mean, n_resamples=RESAMPLES, batch=50, axis=1, method=method, rng=rng)
    low, high = drawn.confidence_interval
    alike = np.ptp(values, axis=1) == 0
    return np.where(alike, values[:, 0], low), np.where(alike, values[:, 0], high)


def bootstrap_t(values: Values) -> Bounds:
    """The bootstrap's of Student's t; of resamples whose values are all alike t is left out."""
    n = values.shape[1]
    rng = np.random.default_rng(0)
    mean = values.mean(1)
    error = values.std(1, ddof=1) / np.sqrt(n)
    ratios = np.empty((RESAMPLES, len(values)))
    for number in range(RESAMPLES):
        resample = values[:, rng.integers(n, size=n)]
        error_of_it = resample.std(1, ddof=1) / np.sqrt(n)
        alike = error_of_it < 1e-12
        ratios[number] = (resample.mean(1) - mean) / np.where(alike, np.nan, error_of_it)
    low, high = np.nanquantile(ratios, (0.025, 0.975), axis=0)
    return mean - high * error, mean - low * error


def bounded(values: Values) -> Bounds:
    """Gaffke's interval of the mean of shares, see ``studies.cells.share_bounds``."""
    n = values.shape[1]
    weights = np.random.default_rng(0).dirichlet(np.ones(n + 1), WEIGHTS)
    ordered = np.sort(values, 1)
    known = ordered @ weights[:, 1:].T
    low = np.quantile(known, 0.025, axis=1)
    high = np.quantile(known + weights[:, 0], 0.975, axis=1)
    return low, high


def median(values: Values) -> Bounds:
    """The interval of the median between two of the values, see ``hypogoal.evaluation.statistics``; NaN below six."""
    n = values.shape[1]
    ordered = np.sort(values, 1)
    outside = int(stats.binom.ppf(0.025, n, 0.5))
    if not outside:
        nothing = np.full(len(values), np.nan)
        return nothing, nothing
    return ordered[:, outside - 1], ordered[:, n - outside]


def wilson(values: Values) -> Bounds:
    """Wilson's interval of a chance."""
    return _of_counts(values, "wilson")


def exact(values: Values) -> Bounds:
    """Clopper and Pearson's interval of a chance."""
    return _of_counts(values, "exact")


def _of_counts(values: Values, method: str) -> Bounds:
    n = values.shape[1]
    by_count = []
    for count in range(n + 1):
        found = stats.binomtest(count, n).proportion_ci(0.95, method)
        by_count.append([found.low, found.high])
    low, high = np.array(by_count)[values.sum(1).astype(int)].T
    return low, high


Method = Callable[[Values], Bounds]
OF_MEANS: dict[str, Method] = {
    "student": student,
    "percentile": percentile,
    "bca": bca,
    "bootstrap-t": bootstrap_t,
}
METHODS: dict[str, dict[str, Method]] = {
    "score": OF_MEANS,
    "solved": OF_MEANS | {"bounded": bounded},
    "pair of scores": OF_MEANS,
    "pair of shares": OF_MEANS | {"median": median},
    "amount": OF_MEANS | {"median": median},
    "count": {"wilson": wilson, "exact": exact},
}


def truth_of(draw: Draw, method: str) -> float:
    """The mean of a shape, or its median where the interval is of that."""
    values = draw(np.random.default_rng(1), (1, TRUTH_FROM))
    return float(np.median(values) if method in OF_THE_MEDIAN else values.mean())


def cells_of(kind: str) -> Iterator[Row]:
    """The coverage and the mean width of each method at each n, on each shape of a kind."""
    for shape, draw in SHAPES[kind].items():
        for n in SIZES:
            values = draw(np.random.default_rng(n), (EXPERIMENTS, n))
            for name, method in METHODS[kind].items():
                low, high = method(values)
                truth = truth_of(draw, name)
                held = (low - 1e-9 <= truth) & (truth <= high + 1e-9)
                place = dict(zip(COLUMNS, (kind, shape, name, n), strict=False))
                yield place | {"coverage": f"{held.mean():.4f}", "width": f"{(high - low).mean():.4f}"}


def worst(rows: list[dict[str, str]], kind: str, method: str) -> dict[int, float]:
    """By n the coverage of a method on its worst shape."""
    coverages: dict[int, float] = {}
    for row in rows:
        if (row["kind"], row["method"]) == (kind, method):
            n = int(row["n"])
            coverages[n] = min(float(row["coverage"]), coverages.get(n, 1.0))
    return coverages


def admitted_from(rows: list[dict[str, str]], kind: str, method: str) -> int | None:
    """The least n from which the coverage is never below ``WANTED``; None if it is at the largest."""
    least = None
    for n, coverage in sorted(worst(rows, kind, method).items(), reverse=True):
        if coverage < WANTED:
            break
        least = n
    return least


def width(rows: list[dict[str, str]], kind: str, method: str) -> float:
    """The mean width over shapes at ``WIDTH_AT``."""
    wanted = (kind, method, str(WIDTH_AT))
    widths = [float(row["width"]) for row in rows if (row["kind"], row["method"], row["n"]) == wanted]
    return float(np.mean(widths))


def chosen(rows: list[dict[str, str]], kind: str) -> tuple[str, int] | None:
    """The method of a kind by the rule, and the n that it is shown from."""
    admitted = []
    for method in METHODS[kind]:
        least = admitted_from(rows, kind, method)
        if least is not None:
            admitted.append((least, width(rows, kind, method), method))
    if not admitted:
        return None
    least, _, method = min(admitted)
    return method, least


def tables(path: Path) -> Iterator[str]:
    """What the cells say, as lines of Markdown."""
    rows = read_rows(path)
    lines = []
    for kind, methods in METHODS.items():
        found = chosen(rows, kind)
        for method in methods:
            coverages = worst(rows, kind, method)
            cells = [f"{coverages[n]:.2f}" for n in SIZES]
            is_chosen = found is not None and found[0] == method
            shown = f"from {found[1]} on" if found and is_chosen else ""
            lines.append([kind, method, *cells, f"{width(rows, kind, method):.2f}", shown])
    yield "Coverage on the worst shape of a kind, by n; the mean width at ten; what tables show.\n"
    yield from table(["kind", "method", *(f"n = {n}" for n in SIZES), "width", "on our pages"], lines)


def main() -> None:
    """Simulate all shapes."""
    arguments = parser_of(__doc__).parse_args()
    if printed(arguments, tables):
        return
    rows: list[Row] = []
    for kind in SHAPES:
        rows += cells_of(kind)
        write_rows(arguments.csv, COLUMNS, rows)
    print("\n".join(tables(arguments.csv)))


if __name__ == "__main__":
    main()
