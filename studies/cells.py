"""Experiments made of cells: one training each, its rows in a CSV as soon as it is done; what a table shows of them."""

from __future__ import annotations

import argparse
import csv
import sys
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

from hypogoal.core.config import integers
from hypogoal.core.processes import in_processes
from hypogoal.core.progress import Progress
from hypogoal.domains.base import Domain
from hypogoal.evaluation.statistics import MEDIANS_FROM, ROUNDING, SHARES_FROM, TAILS, bounded, median_bounds, sign_test
from hypogoal.stages.collect import collect

T = TypeVar("T")
Row = dict[str, Any]
Floats: TypeAlias = NDArray[np.float64]
Bounds: TypeAlias = Callable[[Floats], tuple[float, float]]
Cell = tuple[str, ...]
Jobs: TypeAlias = dict[Cell, Callable[[], list[Row]]]  # what makes a cell's rows
# How many values an interval takes: ``studies.coverage`` chose method and number for each kind of value.
SCORES_FROM = 4
RESAMPLES = 20_000
TITLES = {  # what pages call the methods of ensembles
    "dbat": "D-BAT",
    "none": "no diversity",
    "dbat-unpaired": "control that pairs nobody",
    "cnn": "one classifier",
}


def parser_of(doc: str | None, seeds: str = "", *, run: str = "") -> argparse.ArgumentParser:
    """The arguments that such experiments share; ``doc`` is the module's, ``seeds`` the default of those that train.

    ``run`` is the help of an argument before the CSV, for those that gather.
    """
    parser = argparse.ArgumentParser(description=(doc or "").partition("\n")[0])
    if run:
        parser.add_argument("run", type=Path, nargs="?", help=run)
    parser.add_argument("csv", type=Path, help="the file of all cells; made where there is none")
    if seeds:
        parser.add_argument("--seeds", type=integers, default=integers(seeds), help="0-9 or 0,2,5")
        parser.add_argument("--workers", type=int, default=1, help="processes")
    parser.add_argument("--tables", action="store_true", help="print the tables and run nothing")
    return parser


def printed(arguments: argparse.Namespace, tables: Callable[[Path], Iterable[str]]) -> bool:
    """Print the tables where ``--tables`` asks for nothing else; whether it does."""
    if arguments.tables:
        print("\n".join(tables(arguments.csv)))
    return bool(arguments.tables)


def read_rows(path: Path) -> list[dict[str, str]]:
    """The rows of a CSV with a header."""
    with path.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def write_rows(path: Path, columns: Sequence[str], rows: Iterable[Mapping[str, Any]]) -> None:
    """Write a CSV with a header."""
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, columns, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def collect_once(domain: Domain, config: Any, path: Path) -> None:
    """Collect into ``path``: go on where a killed study stopped, keep what is complete."""
    collect(domain, path, resume=True, quiet=True, **config.model_dump())


def run_cells(
    path: Path,
    columns: Sequence[str],
    keys: Sequence[str],
    jobs: Jobs,
    steps: Callable[[Cell], Sequence[int]],
    workers: int,
) -> None:
    """Run the jobs whose rows are not in the file, in their order; a run that was cut goes on where it stopped.

    Args:
        path: the CSV; made where there is none.
        columns: of its rows, ``step`` among them.
        keys: the columns that name a cell.
        jobs: by cell what makes its rows.
        steps: the numbers of steps that a cell is wanted at. Rows of others are kept as they are.
        workers: processes.
    """
    if not path.exists():
        path.write_text(",".join(columns) + "\n", encoding="utf-8")
    finished: dict[Cell, set[int]] = defaultdict(set)
    for row in read_rows(path):
        finished[tuple(row[key] for key in keys)].add(int(row["step"]))
    cells = [cell for cell in jobs if not finished[cell].issuperset(steps(cell))]
    with Progress(path.stem, len(cells)) as progress:

        def keep(number: int, rows: list[Row]) -> None:
            new = [row for row in rows if row["step"] not in finished[cells[number]]]
            with path.open("a", encoding="utf-8", newline="") as file:
                csv.DictWriter(file, columns, lineterminator="\n").writerows({**row, **_short(row)} for row in new)
            progress.advance()

        in_processes([importable(jobs[cell]) for cell in cells], workers, keep)


def importable(job: Callable[[], T]) -> Callable[[], T]:
    """The same job, of the module that a study is, not of ``__main__``, which other processes do not have."""
    study = sys.modules["__main__"].__spec__
    if not isinstance(job, partial) or job.func.__module__ != "__main__" or study is None:
        return job
    function = getattr(import_module(study.name), job.func.__name__)
    return partial(function, *job.args, **job.keywords)


def _short(row: Row) -> dict[str, str]:
    return {name: f"{value:.4f}" for name, value in row.items() if isinstance(value, float)}


def interval(values: Floats, digits: int = 3) -> str:
    """Write the mean of scores, or of differences of scores, with the interval of :func:`bootstrap_t`."""
    return _shown(values, digits, np.mean, bootstrap_t, SCORES_FROM)


def share(values: Floats, digits: int = 2, least: float = 0.0) -> str:
    """Write the mean of what lies between ``least`` and 1 and may lie there, with the interval of :func:`bounded`."""
    return _shown(values, digits, np.mean, partial(bounded, least=least), SHARES_FROM)


def amount(values: Floats, digits: int = 2) -> str:
    """Write the median of amounts, or of differences of shares, with the interval of :func:`median_bounds`."""
    return _shown(values, digits, np.median, median_bounds, MEDIANS_FROM)


def _shown(values: Floats, digits: int, middle: Any, bounds: Bounds, least: int) -> str:
    """Write a middle with its interval; the mean with the lowest and the highest value below ``least`` values."""
    if not len(values):
        return "-"
    if len(values) == 1:
        return _number(values[0], digits)
    if len(values) < least:
        low, high = _number(values.min(), digits), _number(values.max(), digits)
        return f"{_number(values.mean(), digits)} ({low} to {high})"
    low, high = (_number(bound, digits) for bound in bounds(values))
    return f"{_number(middle(values), digits)} [{low}, {high}]"


def _number(value: float, digits: int) -> str:
    text = f"{value:.{digits}f}"
    return "never" if np.isinf(value) else text


def won(values: Floats) -> str:
    """Write how many of n differences are above 0, with the sign test's p, ties left out."""
    above = int((values > ROUNDING).sum())
    below = int((values < -ROUNDING).sum())
    count, p = f"{above} of {len(values)}", sign_test(above, below)
    if np.isnan(p):
        return count
    return f"{count}, p = {p:.3f}" if p >= 0.001 else f"{count}, p < 0.001"


def bootstrap_t(values: Floats) -> tuple[float, float]:
    """Bound the mean of (n,) values: the bootstrap's 95 % interval of Student's t (Efron 1981).

    Resamples whose values are all alike have no t and are left out.
    """
    n = len(values)
    mean, error = values.mean(), values.std(ddof=1) / np.sqrt(n)
    resamples = values[np.random.default_rng(0).integers(n, size=(RESAMPLES, n))]
    errors = resamples.std(axis=1, ddof=1) / np.sqrt(n)
    differ = errors > ROUNDING
    if not differ.any():
        return mean, mean
    ratios = (resamples.mean(axis=1)[differ] - mean) / errors[differ]
    low, high = np.quantile(ratios, TAILS)
    return float(mean - high * error), float(mean - low * error)


def table(titles: Sequence[str], rows: Iterable[Sequence[str]]) -> Iterator[str]:
    """Lines of Markdown, and an empty one."""
    yield f"| {' | '.join(titles)} |"
    yield f"|{'---|' * len(titles)}"
    yield from (f"| {' | '.join(cells)} |" for cells in rows)
    yield ""
