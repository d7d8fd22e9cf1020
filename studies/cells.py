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
from hypogoal.evaluation.house import BOOTSTRAP_FROM, RESAMPLES, student_interval
from hypogoal.stages.collect import collect

T = TypeVar("T")
Row = dict[str, Any]
Cell = tuple[str, ...]
Jobs: TypeAlias = dict[Cell, Callable[[], list[Row]]]  # what makes a cell's rows


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


def interval(values: NDArray[np.float64], digits: int = 3) -> str:
    """A mean with a bootstrap's 95 % interval over seeds or layouts; of fewer than eight with the lowest and highest.

    A percentile bootstrap of the mean stays within what the values can be, a share's within 0 and 1.
    """
    if len(values) < 2:
        return f"{values.mean():.{digits}f}" if len(values) else "-"
    if len(values) < BOOTSTRAP_FROM:
        return f"{values.mean():.{digits}f} ({values.min():.{digits}f} to {values.max():.{digits}f})"
    drawn = np.random.default_rng(0).integers(len(values), size=(RESAMPLES, len(values)))
    low, high = np.percentile(values[drawn].mean(axis=1), (2.5, 97.5))
    return f"{values.mean():.{digits}f} [{low:.{digits}f}, {high:.{digits}f}]"


def difference(values: NDArray[np.float64], digits: int = 3) -> str:
    """A mean difference, which may have any sign, with Student's 95 % interval over seeds or layouts."""
    if len(values) < 2:
        return f"{values.mean():.{digits}f}" if len(values) else "-"
    low, high = student_interval(values)
    return f"{values.mean():.{digits}f} [{low:.{digits}f}, {high:.{digits}f}]"


def table(titles: Sequence[str], rows: Iterable[Sequence[str]]) -> Iterator[str]:
    """Lines of Markdown, and an empty one."""
    yield f"| {' | '.join(titles)} |"
    yield f"|{'---|' * len(titles)}"
    yield from (f"| {' | '.join(cells)} |" for cells in rows)
    yield ""
