"""Where did the last executions of the best member stop? Figure 5.

python -m studies.ladder_stops docs/results/figure5-ladders.csv --gather runs/ladder-options/executions
python -m studies.ladder_stops docs/results/figure5-ladders.csv --picture docs/results/figure5-ladders.png --seed 10
python -m studies.ladder_stops docs/results/figure5-ladders.csv --tables

The executions are those that ``studies.ladder_options`` kept. A row of the CSV is a place where the member stopped
whose distance to a true base is lowest (the paper's choice), and how often. Rule: a claim is reproduced where all three
seeds agree in sign. Commit 4f87b6a.
"""

from __future__ import annotations

import argparse
import csv
import re
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from hypogoal.domains.montezuma.domain import DOMAIN
from hypogoal.evaluation.distance import BEGAN_INSIDE, HIT, last_executions, stops_over_rooms
from hypogoal.evaluation.plots import styled
from hypogoal.options.tables import Executions
from studies.cells import table

GROUPS, LADDER = 2, "3-9"
METHODS = {"dbat": "D-BAT", "none": "no diversity", "cnn": "one classifier"}
NAME = re.compile(rf"options-{GROUPS}-(\w+)-(\d+)-{LADDER}-\d+\.csv")
COLUMNS = ("method", "seed", "member", "room", "x", "y", "fate", "count")
Stops = dict[tuple[str, int], NDArray[np.int64]]  # by method and seed: (n, 4), room, x, y and fate of each execution


def gather(executions: Path, path: Path) -> None:
    """Write the stops of the best members into a CSV."""
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(COLUMNS)
        for kept in sorted(executions.iterdir()):
            if (match := NAME.fullmatch(kept.name)) and match[1] in METHODS:
                every = Executions.read(kept)
                last = last_executions(every)
                best = last.groupby("option")["counted"].mean().idxmin()
                places = last.loc[last["option"] == best, ["room", "x", "y", "fate"]].to_numpy().tolist()
                for place, count in sorted(Counter(map(tuple, places)).items()):
                    writer.writerow([match[1], match[2], best, *place, count])


def read(path: Path) -> Stops:
    """The stops in a CSV."""
    places: dict[tuple[str, int], list[list[int]]] = {}
    with path.open(encoding="utf-8", newline="") as file:
        for row in csv.DictReader(file):
            place = [int(row[name]) for name in ("room", "x", "y", "fate")]
            places.setdefault((row["method"], int(row["seed"])), []).extend([place] * int(row["count"]))
    return {key: np.array(stops) for key, stops in places.items()}


def spread(stops: NDArray[np.int64]) -> float:
    """How far executions stop from the middle of their set, RAM units.

    The mean Manhattan distance to the median place of the room in which most stop, over the stops there.
    """
    rooms, counts = np.unique(stops[:, 0], return_counts=True)
    places = stops[stops[:, 0] == rooms[counts.argmax()], 1:3]
    return float(np.abs(places - np.median(places, axis=0)).sum(axis=1).mean())


def tables(path: Path) -> Iterator[str]:
    """What the stops say, as lines of Markdown, a row for each seed."""
    every = read(path)
    rows = []
    for method, title in METHODS.items():
        for seed in sorted(seed for name, seed in every if name == method):
            stops = every[method, seed]
            at_base = f"{(stops[:, 3] == HIT).mean():.2f}"
            inside = f"{(stops[:, 3] == BEGAN_INSIDE).mean():.2f}"
            rows.append([title, str(seed), at_base, inside, f"{spread(stops):.1f}"])
    yield from table(["members", "seed", "ended at a base", "positive starts", "spread, units"], rows)


def draw(path: Path, seed: int, picture: Path) -> None:
    """One seed's stops over the rooms, as in the paper."""
    stops = read(path)
    shown = [(title, stops[method, seed]) for method, title in METHODS.items() if (method, seed) in stops]
    options = {}
    for title, places in shown:
        options[title] = pd.DataFrame(places, columns=["room", "x", "y", "fate"])
        options[title][["column", "row"]] = DOMAIN.pixel(places[:, :3])
    rooms = {int(room) for _, places in shown for room in places[:, 0]}
    with styled():
        stops_over_rooms({str(room): DOMAIN.picture(room) for room in rooms}, options).savefig(picture, dpi=100)


def main() -> None:
    """Gather, draw or print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("csv", type=Path, help="the file of all stops")
    parser.add_argument("--gather", type=Path, help="the folder of kept executions")
    parser.add_argument("--picture", type=Path, help="a .png file to draw")
    parser.add_argument("--seed", type=int, default=10, help="of the picture")
    parser.add_argument("--tables", action="store_true", help="print the table")
    arguments = parser.parse_args()
    if arguments.gather:
        gather(arguments.gather, arguments.csv)
    if arguments.picture:
        draw(arguments.csv, arguments.seed, arguments.picture)
    if arguments.tables:
        print("\n".join(tables(arguments.csv)))


if __name__ == "__main__":
    main()
