"""Goal misgeneralisation in MiniGrid as released: do members own both features, and does an agent find the right one?

    PYTHONPATH=examples HYPOGOAL_TRUST=1 python -m studies.misgeneralise runs/misgeneralise \
        docs/results/misgeneralise.csv
    python -m studies.misgeneralise --tables docs/results/misgeneralise.csv

A cell is a world (Fetch or GoToObject, see ``examples/misgeneralise.py``), a method and a seed, which has its own
labelled, unlabelled, held-out and new levels. ``owned``: the best member's balanced accuracy by a feature on the ends
of episodes in held-out levels, in which no thing has both features. ``solved``: the share of training episodes in
thirty new levels that an agent over planned options solves, rewarded for that feature, each episode in a level drawn
anew. ``random``: the same by uniform-random choice among the options of the first method.

All methods have the settings of the example but those that name them; the weight of diversity and the share of
positives are ``auto`` throughout.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from functools import partial
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
from torch import nn

import hypogoal
from hypogoal.core.artefacts import open_artefact
from hypogoal.data import open_dataset
from hypogoal.evaluation.curves import run_numbers
from hypogoal.hypotheses.scores import member_scores
from hypogoal.options.tables import Episodes
from studies.cells import Floats, Jobs, Row, amount, parser_of, printed, read_rows, run_cells, share, table, won

WORLDS = {"fetch": "misgeneralise:FETCH", "goto": "misgeneralise_goto:GOTO"}
FEATURES = ("colour", "shape")
NO_DIVERSITY = {"diversity": "none"}
ONE = {**NO_DIVERSITY, "members": 1}
METHODS: dict[str, dict[str, Any]] = {  # settings of train-ensemble, beside the example's
    "independent": {},
    "one classifier": ONE,
    "no diversity": NO_DIVERSITY,
    "true sub-goals": ONE,
    "D-BAT": {"diversity": "dbat"},
    "DivDis": {"diversity": "divdis"},
    "DivDis, share 1/3": {"diversity": "divdis", "share": 1 / 3},
    "D-BAT, unpaired": {"diversity": "dbat-unpaired"},
    "K = 3": {"members": 3},
    "whole episodes": {},
    "one start": {"restarts": 1},
    "K = 5": {"members": 5},
    "a hidden layer": {"network": "studies.misgeneralise:shallow", "l2_weight": 1e-4},
    "1,000 unlabelled levels": {},
    "no diversity, K = 16": {**NO_DIVERSITY, "members": 16},
}
TITLES = {  # of methods whose name does not say all; the others are called as they are
    "D-BAT, unpaired": "control that pairs nobody",
    "K = 3": "independent, three members",
    "1,000 unlabelled levels": "independent, 1,000 unlabelled levels",
}
PLAYED = 8  # of these methods, the first, have agents
FIRST, ORACLE = "independent", "true sub-goals"
LEVELS = {"labelled": 160, "unlabelled": 300, "heldout": 60, "new": 30}
MANY = 1_000
STEPS = 10_000  # of an agent: at least 100 episodes
WINDOWS = ("solved_11_20", "solved_51_100")
KEYS = ("world", "method", "seed")
COLUMNS = (
    *KEYS,
    "step",
    "weight",
    "share",
    *(f"owned_{feature}" for feature in FEATURES),
    *(f"{window}_{feature}" for feature, window in product(FEATURES, WINDOWS)),
    *(f"random_{feature}" for feature in FEATURES),
    "seconds",
)
OWNED = 0.9


def shallow(channels: int) -> Any:
    """A member network with a hidden layer: what each tile of 8x8 pixels shows."""
    return [nn.Conv2d(channels, 16, kernel_size=8, stride=8, bias=False), nn.BatchNorm2d(16), nn.ReLU()], ()


def levels(seed: int, kind: str, count: int) -> tuple[int, ...]:
    """Layout seeds of a kind of level, of which no two seeds share any."""
    first = seed * 10_000 + 1_000 * [*LEVELS].index(kind)
    return tuple(range(first, first + count))


def data_of(folder: Path, world: str, method: str, seed: int) -> Path:
    """The states of a seed, collected unless they are there."""
    kind = method if method in ("whole episodes", "1,000 unlabelled levels") else "ends"
    path = folder / f"{world}-{kind.split()[0]}-{seed}.h5"
    counts = LEVELS | ({"unlabelled": MANY} if kind.endswith("levels") else {})
    if not path.exists():
        sets: Any = {f"{split}_seeds": levels(seed, split, counts[split]) for split in [*LEVELS][:3]}
        ends = not kind.startswith("whole")
        hypogoal.collect(WORLDS[world], path, seed=seed, quiet=True, resume=True, ends=ends, **sets)
    return path


def run_cell(folder: Path, world: str, method: str, seed: int) -> list[Row]:
    """Train the ensemble, and, where the method has agents, one for each feature."""
    torch.set_num_threads(1)
    begun = time.process_time()
    data = data_of(folder, world, method, seed)
    row: Row = {"world": world, "method": method, "seed": seed, "step": 0}
    with TemporaryDirectory() as name:
        ensemble = Path(name) / "ensemble"
        hypogoal.train_ensemble(data, ensemble, seed=seed, workers=1, quiet=True, **METHODS[method])
        chosen = open_artefact(ensemble).config.get("chosen", {}).get("target", {})
        row |= {"weight": chosen.get("diversity_weight", ""), "share": chosen.get("share", "")}
        states = open_dataset(data).heldout("target")
        ends = states.where(states.origins["over"] == 1)
        predictions = hypogoal.load_ensemble(ensemble, "target").predictions(ends.observations)
        for feature in FEATURES:
            truth = ends.origins[f"planted_{feature}"] == 1
            row[f"owned_{feature}"] = float(member_scores(predictions, truth)["balanced_accuracy"].max())
        if method in [*METHODS][:PLAYED]:
            for feature in FEATURES:
                row |= solved(ensemble, method, feature, seed)
    row["seconds"] = time.process_time() - begun
    return [row]


def solved(ensemble: Path, method: str, feature: str, seed: int) -> Row:
    """What an agent solves that is rewarded for a feature, and what random choice does."""
    first, *_, last = levels(seed, "new", LEVELS["new"])
    row: Row = {}
    for chooser in ("symbols", "random"):
        settings: dict[str, Any] = {"world": (f"task={feature}",), "layouts": f"{first}-{last}", "steps": STEPS}
        if method == ORACLE:
            settings["termination"] = "oracle"
        out = ensemble.with_name(f"{feature}-{chooser}")
        hypogoal.train_meta(ensemble, out, seed=seed, quiet=True, chooser=chooser, **settings)
        numbers = run_numbers(Episodes.read(out / Episodes.FILE), None)
        if chooser == "random":
            row[f"random_{feature}"] = numbers["solved_51_100"]
        else:
            row |= {f"{window}_{feature}": numbers[window] for window in WINDOWS}
        if method != FIRST:
            break
    return row


def tables(path: Path) -> Iterator[str]:
    """What the rows say, as lines of Markdown: for each world a table of members and one of agents."""
    rows = read_rows(path)
    for world in WORLDS:
        numbers: dict[str, Numbers] = {}
        for method in METHODS:
            own = [row for row in rows if (row["world"], row["method"]) == (world, method)]
            if own:
                numbers[method] = numbers_of(own)
        yield ""
        yield from table(OF_MEMBERS, members_of(numbers))
        yield from table(OF_AGENTS, agents_of(numbers))


Numbers = dict[str, dict[int, float]]  # by column and seed
OF_MEMBERS = (
    "members",
    "weights",
    "seeds with both features owned",
    "best member's balanced accuracy by colour",
    "best member's balanced accuracy by shape",
)
OF_AGENTS = (
    "members",
    "colour, episodes 11-20",
    "shape, episodes 11-20",
    "colour, episodes 51-100",
    "shape, episodes 51-100",
    "worse task, episodes 51-100",
    "random choice, mean of both tasks",
    "independent solves more by, median",
    "seeds on which independent solves more",
)


def numbers_of(rows: list[dict[str, str]]) -> Numbers:
    """The numbers that rows of one method have."""
    found: Numbers = {}
    for row, column in product(rows, COLUMNS[4:]):
        if row[column] not in ("", "labels"):
            found.setdefault(column, {})[int(row["seed"])] = float(row[column])
    return found


def in_order(numbers: Numbers, column: str) -> Floats:
    """A column's numbers by seed."""
    by_seed = numbers.get(column, {})
    return np.array([by_seed[seed] for seed in sorted(by_seed)])


def members_of(numbers: dict[str, Numbers]) -> Iterator[list[str]]:
    """A row for each method: what its best members know."""
    for method, own in numbers.items():
        if method == ORACLE:
            continue
        accuracies = [in_order(own, f"owned_{feature}") for feature in FEATURES]
        both = np.minimum(*accuracies) >= OWNED
        weights = ", ".join(f"{weight:g}" for weight in np.unique(in_order(own, "weight")))
        yield [TITLES.get(method, method), weights, f"{both.sum()} of {len(both)}", *map(share, accuracies)]


def agents_of(numbers: dict[str, Numbers]) -> Iterator[list[str]]:
    """A row for each method that has agents: what they solve."""
    for method, own in numbers.items():
        if "solved_51_100_colour" not in own:
            continue
        solved = [in_order(own, f"{window}_{feature}") for window in WINDOWS for feature in FEATURES]
        worse = np.minimum(*solved[2:])
        by_chance = [in_order(own, f"random_{feature}") for feature in FEATURES]
        chance = share(np.mean(by_chance, axis=0)) if len(by_chance[0]) else "-"
        lead = lead_of(numbers[FIRST], own)
        versus = ["-", "-"] if method == FIRST else [amount(lead), won(lead)]
        yield [TITLES.get(method, method), *map(share, solved), share(worse), chance, *versus]


def lead_of(first: Numbers, other: Numbers) -> Floats:
    """The mean of both tasks minus another method's, by seed."""
    means = []
    for numbers in (first, other):
        by_seed = [numbers[f"solved_51_100_{feature}"] for feature in FEATURES]
        means.append({seed: (by_seed[0][seed] + by_seed[1][seed]) / 2 for seed in by_seed[0]})
    return np.array([means[0][seed] - means[1][seed] for seed in sorted(means[1])])


def main() -> None:
    """Run the cells that are missing."""
    parser = parser_of(__doc__, "100-109", run="the folder of collected states; made where there is none")
    parser.add_argument("--methods", help=f"some alone, separated by semicolons: {'; '.join(METHODS)}")
    arguments = parser.parse_args()
    if printed(arguments, tables):
        return
    arguments.run.mkdir(parents=True, exist_ok=True)
    methods = arguments.methods.split("; ") if arguments.methods else [*METHODS]
    jobs: Jobs = {}
    for method, seed, world in product(methods, arguments.seeds, WORLDS):
        jobs[world, method, str(seed)] = partial(run_cell, arguments.run, world, method, seed)
    run_cells(arguments.csv, COLUMNS, KEYS, jobs, lambda _: [0], arguments.workers)


if __name__ == "__main__":
    main()
