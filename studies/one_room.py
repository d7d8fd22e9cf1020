"""Options that hold in rooms nobody labelled, from the labels of one: the tables of the cells.

    python -m studies.one_room docs/results/options-that-hold.csv

The cells are of commits f88cd87 (seed 20) and 5bdde7c; ``examples/one_room.py`` trains such members and options (K = 3,
600 steps, 40,000 steps an option, the light network), chosen on seeds 110 to 113 and four ladders.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from studies.cells import amount, parser_of, table
from studies.ladder_options import LADDERS, Distances, best_mean_worst, read

METHODS = {"holds-dbat": "D-BAT", "holds-none": "no diversity", "oracle": "true sub-goal"}
CONTROL = "oracle"  # whose members are alike
PARTS = {
    "holds-dbat": "D-BAT",
    "no-context": "without other surroundings",
    "no-median": "threshold .5",
    "no-patience": "without patience",
}
OF_PARTS = ("3-9", "2-6")  # ladders on which a part was left out
ON_BASES = ("4-10", "11-19", "13-21")  # their tops are bases themselves
RUN_ON = ("0-4", "5-11", "7-13")  # their bases are tops of the next ladder
END_AT_BASE = tuple(ladder for ladder in (*LADDERS, *ON_BASES) if ladder not in RUN_ON)
GROUPS = {
    "nine whose base does not run on": END_AT_BASE,
    f"of these without {', '.join(ON_BASES)}": END_AT_BASE[: -len(ON_BASES)],
    "three whose base runs on": RUN_ON,
}


def tables(path: Path) -> Iterator[str]:
    """What the cells say, as lines of Markdown."""
    distances = read(path, 1)
    yield "Distance to the nearest true base, RAM units, mean over seeds.\n"
    rows = []
    for ladder in (*LADDERS, *ON_BASES):
        stops = [stop for method in METHODS for stop in _stops(method, distances.get((method, ladder), {}))]
        rows.append([ladder, *stops])
    yield from table(["ladder", *(title for method in METHODS for title in _titles(distances, method))], rows)
    yield "Mean member, mean over ladders with a 95 % interval over the seeds that have all of these ladders.\n"
    rows = []
    for method, title in METHODS.items():
        rows.append([title, *(amount(_values(_of_group(distances, method, each)), 1) for each in GROUPS.values())])
    rows.append(["no diversity minus D-BAT, same seeds", *(_gap(distances, each) for each in GROUPS.values())])
    yield from table(["", *GROUPS], rows)
    yield "Each part left out: the mean member, mean over the same seeds.\n"
    cells = {(method, ladder): distances[method, ladder] for method in PARTS for ladder in OF_PARTS}
    shared = set.intersection(*map(set, cells.values()))
    rows = []
    for method, title in PARTS.items():
        of_method = [{seed: cells[method, ladder][seed] for seed in shared} for ladder in OF_PARTS]
        rows.append([title, *(f"{best_mean_worst(seeds)[1]:.1f}" for seeds in of_method)])
    yield from table(["", *OF_PARTS], rows)


def _stops(method: str, seeds: dict[int, NDArray[np.float64]]) -> list[str]:
    """Write a method's cells of one ladder: the best, the mean and the worst member, the mean in bold."""
    if not seeds:
        return ["-"] * (1 if method == CONTROL else 3)
    best, mean, worst = best_mean_worst(seeds)
    return [f"**{mean:.1f}**"] if method == CONTROL else [f"{best:.1f}", f"**{mean:.1f}**", f"{worst:.1f}"]


def _titles(distances: Distances, method: str) -> list[str]:
    """Name a method's columns, the first with the number of seeds that each of its ladders has."""
    counts = sorted({len(seeds) for (name, _), seeds in distances.items() if name == method})
    title = f"{METHODS[method]} ({', '.join(map(str, counts))} seed{'s' if counts != [1] else ''})"
    if method == CONTROL:
        return [title]
    return [f"{title}, best", *(f"{METHODS[method]}, {which}" for which in ("mean", "worst"))]


def _of_group(distances: Distances, method: str, ladders: tuple[str, ...]) -> dict[int, float]:
    """By seed that has all of these ladders, the mean member's mean over them."""
    cells = [distances.get((method, ladder), {}) for ladder in ladders]
    seeds = set.intersection(*map(set, cells))
    return {seed: float(np.mean([cell[seed].mean() for cell in cells])) for seed in sorted(seeds)}


def _gap(distances: Distances, ladders: tuple[str, ...]) -> str:
    with_dbat = _of_group(distances, "holds-dbat", ladders)
    without = _of_group(distances, "holds-none", ladders)
    return amount(np.array([without[seed] - with_dbat[seed] for seed in without if seed in with_dbat]), 1)


def _values(by_seed: dict[int, float]) -> NDArray[np.float64]:
    return np.array(list(by_seed.values()))


def main() -> None:
    """Print the tables."""
    print("\n".join(tables(parser_of(__doc__).parse_args().csv)))


if __name__ == "__main__":
    main()
