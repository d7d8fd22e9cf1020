"""The leaderboard of WhichFeature: each objective's weight by one rule, and the tables of its page.

    python -m studies.which_feature --grid     every objective at every weight, for hypogoal benchmark --diversity
    python -m studies.which_feature --gather docs/results/which-feature.csv runs/which-choice/results.csv ...
    python -m studies.which_feature --chosen   the entries at the weights that the rule chose
    python -m studies.which_feature            the tables of docs/results/which-feature.md
    python -m studies.which_feature --two      those of docs/results/which-feature-two.md

With ``--two`` the grid and the chosen entries are those of two features, too. ``--gather`` makes the first file of the
others, which the benchmark wrote.
"""

from __future__ import annotations

import argparse
import csv
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from hypogoal.evaluation.numbers import grouped
from hypogoal.evaluation.page import number
from hypogoal.which_feature.run import Scored, read_cells
from hypogoal.which_feature.scores import owned
from hypogoal.which_feature.states import FACTORS
from hypogoal.which_feature.table import COLUMNS, Line, summary, with_interval
from studies.cells import table

WEIGHTS = (1.0, 0.1, 0.01, 0.001, 0.0001)
OBJECTIVES = (  # in the order in which they are run
    "dbat", "divdis", "mutual-information", "ace", "repulsive", "hsic", "dbat-unpaired", "weak-negatives",
    "input-gradients",
)  # fmt: skip
OF_TWO = OBJECTIVES[:6]
UNWEIGHTED = ("none", "cnn", "oracle", "joint")
CHOICE_SEEDS, CHOICE_MIX, CHOICE_MIX_OF_TWO = (100,), 0.5, 1.0
HIGH, LOW = 0.95, 0.6
CSV = Path(__file__).resolve().parents[1] / "docs" / "results" / "which-feature.csv"
TEN = CSV.with_name("which-feature-ten.csv")  # seeds 400 to 409
TEXTURES = CSV.with_name("which-feature-textures.csv")  # the same, other scenes, joint with the agreement given
AUTO = CSV.with_name("which-feature-textures-auto.csv")  # joint alone, with the agreement that its loss finds
TWO = CSV.with_name("which-feature-two.csv")
SEQUENTIAL = CSV.with_name("which-feature-two-sequential.csv")  # members one after the other
TWO_TEN = CSV.with_name("which-feature-two-ten.csv")  # seeds 400 to 409
GIVEN = CSV.with_name("which-feature-two-given.csv")  # the same, joint with the agreement given
LONG = CSV.with_name("which-feature-long.csv")  # cells of 600 steps instead of 150


def gather(target: Path, paths: Iterable[Path]) -> None:
    """Lines of several ``results.csv`` as one file; a cell that is in more than one, from the first."""
    lines: dict[tuple[str, ...], list[str]] = {}
    for path in paths:
        with path.open(encoding="utf-8", newline="") as file:
            for row in csv.reader(file):
                lines.setdefault(tuple(row[:5]), row)
    with target.open("w", encoding="utf-8", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows(lines.values())


def chosen(cells: Sequence[Scored], objectives: Sequence[str] = OBJECTIVES, mix: float = CHOICE_MIX) -> dict[str, str]:
    """The rule: of each objective's weights the one with the highest coverage, ties by best; by objective its entry.

    Objectives of which a weight or a seed is still missing are left out.
    """
    lines = summary([cell for cell in cells if cell.seed in CHOICE_SEEDS and cell.mix == mix], HIGH, LOW)
    found = {}
    for objective in objectives:
        entries = _entries(objective)
        own = [line for line in lines if line.entry in entries and len(line.coverage) == len(CHOICE_SEEDS)]
        if len(own) == len(entries):
            found[objective] = max(own, key=lambda line: (line.coverage.mean(), line.best.mean())).entry
    return found


def tables(path: Path) -> Iterator[str]:
    """What the cells say, as lines of Markdown."""
    cells = read_cells(path)
    yield from _weights(
        "Coverage (best) by weight, seed 100 at mix .5; in bold what the rule chose.", cells, chosen(cells)
    )
    ten = _by_mix(read_cells(TEN))
    auto = [replace(cell, entry="joint, agreement by its loss") for cell in read_cells(AUTO)]
    ten |= {f"textures, {mix}": of for mix, of in _by_mix([*read_cells(TEXTURES), *auto]).items()}
    yield from _against("joint", ten)
    for title, cells_of in ten.items():
        yield f"Test at {title}: the share of seeds in which a member owns the feature, and the highest ranking of it."
        yield ""
        yield from table(["", *FACTORS], _by_factor(cells_of))
    yield from _side_by_side("Seeds 0 to 4", _by_mix(cell for cell in cells if cell.seed not in CHOICE_SEEDS))
    if LONG.exists():
        yield from _board("600 steps", read_cells(LONG))


def tables_of_two(path: Path) -> Iterator[str]:
    """What the cells of two features say, members trained at once and one after the other."""
    boards = {}
    for title, source in (("at once", path), ("one after the other", path.with_name(SEQUENTIAL.name))):
        cells = read_cells(source)
        what = f"{title.capitalize()}: coverage (best) by weight, seed 100 at mix 1; in bold what the rule chose."
        yield from _weights(what, cells, chosen(cells, OF_TWO, CHOICE_MIX_OF_TWO))
        for mix in (0.5, 1.0):
            test = [cell for cell in cells if cell.seed not in CHOICE_SEEDS and cell.mix == mix]
            boards[f"{title}, mix {mix:g}"] = test
    yield from _side_by_side("Test on five seeds", boards)
    given = [replace(cell, entry="joint, agreement given") for cell in read_cells(GIVEN)]
    yield from _against("joint", _by_mix([*read_cells(TWO_TEN), *given]))


def _by_mix(cells: Iterable[Scored]) -> dict[str, list[Scored]]:
    ordered = sorted(cells, key=lambda cell: cell.mix)
    return {f"mix {mix:g}": of for mix, of in grouped(ordered, lambda cell: cell.mix).items()}


def _against(entry: str, boards: Mapping[str, Sequence[Scored]]) -> Iterator[str]:
    """Coverage (best) of each entry, and what ``entry`` covers more, seed by seed; a pair of columns for each board."""
    columns = {name: {line.entry: line for line in summary(cells, HIGH, LOW)} for name, cells in boards.items()}
    names = dict.fromkeys(name for lines in columns.values() for name in lines)
    yield f"Test: coverage (best), and {entry} minus it; mean and Student's 95 % interval over seeds."
    yield ""
    heads = [part for name in columns for part in (name, f"{entry} minus it")]
    yield from table(["", *heads], ([name, *_compared(entry, name, columns.values())] for name in names))


def _compared(entry: str, name: str, boards: Iterable[Mapping[str, Line]]) -> Iterator[str]:
    for lines in boards:
        yield covered(lines.get(name))
        both = name in lines and name != entry
        yield with_interval(lines[entry].coverage - lines[name].coverage) if both else "-"


def _side_by_side(title: str, boards: Mapping[str, Sequence[Scored]]) -> Iterator[str]:
    """Coverage (best) of each objective at its chosen weight, a column for each set of cells."""
    columns = {name: {_objective(line): line for line in summary(cells, HIGH, LOW)} for name, cells in boards.items()}
    objectives = [name for name in (*OBJECTIVES, *UNWEIGHTED) if any(name in lines for lines in columns.values())]
    yield f"{title}: coverage with Student's 95 % interval over seeds (best)."
    yield ""
    yield from table(
        ["", *columns],
        ([name, *(covered(lines.get(name)) for lines in columns.values())] for name in objectives),
    )


def _objective(line: Line) -> str:
    return line.entry.partition(":")[0]


def covered(line: Line | None) -> str:
    """Coverage with its interval over seeds (best)."""
    return "-" if line is None else f"{with_interval(line.coverage)} ({line.best.mean():.2f})"


def _weights(what: str, cells: Iterable[Scored], winners: Mapping[str, str]) -> Iterator[str]:
    choice = summary([cell for cell in cells if cell.seed in CHOICE_SEEDS], HIGH, LOW)
    by_entry = {line.entry: line for line in choice}
    yield what
    yield ""
    yield from table(
        ["", *(f"{weight:g}" for weight in WEIGHTS)],
        (
            [name, *(_choice(by_entry.get(entry), entry in winners.values()) for entry in _entries(name))]
            for name in OBJECTIVES
            if any(entry in by_entry for entry in _entries(name))
        ),
    )


def _board(title: str, cells: Iterable[Scored]) -> Iterator[str]:
    """The scores of entries, a table for each mix."""
    for mix, lines in grouped(summary(cells, HIGH, LOW), lambda line: line.mix).items():
        plain = next(line.best for line in lines if line.entry == "none")  # of the same seeds as the others
        best = number("best", lambda line: line.best, with_interval)
        gain = number("best, minus none", lambda line, plain=plain: line.best - plain, with_interval)
        shown = [*(best if column.title == "best" else column for column in COLUMNS if column.title != "mix"), gain]
        yield f"{title} at mix {mix:g}, mean and Student's 95 % interval over seeds."
        yield ""
        yield from table([column.title for column in shown], ([str(c.of(line)) for c in shown] for line in lines))


def _entries(objective: str) -> list[str]:
    return [f"{objective}:{weight:g}" for weight in WEIGHTS]


def _choice(line: Line | None, best: bool) -> str:
    if line is None:
        return ""
    text = f"{line.coverage.mean():.2f} ({line.best.mean():.2f})"
    return f"**{text}**" if best else text


def _by_factor(cells: Sequence[Scored]) -> Iterator[list[str]]:
    for entry, of in grouped(cells, lambda cell: cell.entry).items():
        share = np.mean([owned(cell.ranking, HIGH, LOW).any(axis=0) for cell in of], axis=0)
        best = np.mean([cell.ranking.max(axis=0) for cell in of], axis=0)
        yield [entry, *(f"{one:.1f} ({two:.2f})" for one, two in zip(share, best, strict=True))]


def main() -> None:
    """Print, or gather."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--grid", action="store_true", help="print every objective at every weight")
    parser.add_argument("--chosen", action="store_true", help="print the entries that the rule chose, and the others")
    parser.add_argument("--gather", nargs="+", type=Path, metavar="CSV", help="make the first of the others")
    parser.add_argument("--two", action="store_true", help="of two features")
    parser.add_argument("--sequential", action="store_true", help="with --two --chosen: members one after the other")
    arguments = parser.parse_args()
    objectives = OF_TWO if arguments.two else OBJECTIVES
    if arguments.grid:
        print(",".join(entry for objective in objectives for entry in _entries(objective)))
    elif arguments.gather:
        gather(arguments.gather[0], arguments.gather[1:])
    elif arguments.chosen:
        path = CSV if not arguments.two else SEQUENTIAL if arguments.sequential else TWO
        mix = CHOICE_MIX_OF_TWO if arguments.two else CHOICE_MIX
        print(",".join([*chosen(read_cells(path), objectives, mix).values(), *UNWEIGHTED]))
    else:
        print("\n".join(tables_of_two(TWO) if arguments.two else tables(CSV)))


if __name__ == "__main__":
    main()
