"""What ``diversity_weight=auto`` chooses where labels are bad or leave little to disagree about, and what members are.

    python -m studies.weight_elsewhere docs/results/weight-elsewhere.csv --seeds 1300-1304
    python -m studies.weight_elsewhere docs/results/weight-elsewhere.csv --tables

A cell is a case, a method and a seed: data and an ensemble. ``first`` and ``second`` are the best member's balanced
accuracy on held-out states by each of two planted features: shape and place in rooms, colour and shape in Fetch.
DoorKey and ladders have none, so there they are the best and the mean member's balanced accuracy, over all sub-goals.
``idle``: members that are none of their own. Fetch is run where its module ``misgeneralise`` can be imported.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from importlib.util import find_spec
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import h5py
import numpy as np

import hypogoal
from hypogoal.core.artefacts import open_artefact
from hypogoal.core.seeding import rng_for
from hypogoal.data import open_dataset
from hypogoal.domains.rooms.states import crossed_states
from hypogoal.hypotheses.scores import member_scores
from studies.cells import Jobs, Row, interval, parser_of, printed, read_rows, run_cells, table
from studies.weight import CROSSED, FEATURES

AUTO: dict[str, Any] = {"diversity_weight": "auto", "schedule": "sequential"}
PAPER: dict[str, Any] = {"diversity_weight": 1e-4, "schedule": "simultaneous", "restarts": 1}
BOTH: dict[str, dict[str, Any]] = {"auto": AUTO, "the paper's": PAPER}
FETCH = {"network": "studies.misgeneralise:shallow", "learning_rate": 1e-3, "steps": 500}
KEYS = ("case", "method", "seed")
COLUMNS = (*KEYS, "step", "weight", "first", "second", "idle")
Spoil = Callable[[h5py.Group, np.random.Generator], None]
Judge = Callable[[Path, Path, int], tuple[float, float]]


def wrong(share: float, labelled: h5py.Group, rng: np.random.Generator) -> None:
    """Give a share of the labelled states the other label."""
    labels = labelled["labels"][:]
    rows = rng.permutation(len(labels))[: round(share * len(labels))]
    labels[rows] = ~labels[rows]
    labelled["labels"][:] = labels


def repeated(labelled: h5py.Group, rng: np.random.Generator) -> None:
    """Replace the labelled states of each class by copies of one of them."""
    observations, labels = labelled["observations"][:], labelled["labels"][:]
    for inside in (labels, ~labels):
        observations[inside] = observations[rng.choice(np.flatnonzero(inside))]
    labelled["observations"][:] = observations


def by_features(data: Path, ensemble: Path, seed: int) -> tuple[float, float]:
    """The best member by each feature of rooms."""
    states = crossed_states(CROSSED, seed, FEATURES)
    predictions = hypogoal.load_ensemble(ensemble, "right-room").predictions(states.observations)
    first, second = [best_of(predictions, truth) for truth in states.factors.T]
    return first, second


def by_colour_and_shape(data: Path, ensemble: Path, seed: int) -> tuple[float, float]:
    """The best member by each feature of Fetch, in levels where they part."""
    states = open_dataset(data).heldout("target")
    predictions = hypogoal.load_ensemble(ensemble, "target").predictions(states.observations)
    code = states.origins["features"]
    return best_of(predictions, code >= 2), best_of(predictions, code % 2 == 1)


def by_labels(data: Path, ensemble: Path, seed: int) -> tuple[float, float]:
    """The best and the mean member by held-out labels, over sub-goals."""
    dataset = open_dataset(data)
    best, mean = [], []
    for sub_goal in dataset.sub_goals:
        states = dataset.heldout(sub_goal)
        predictions = hypogoal.load_ensemble(ensemble, sub_goal).predictions(states.observations)
        accuracies = member_scores(predictions, states.labels)["balanced_accuracy"]
        best.append(accuracies.max())
        mean.append(accuracies.mean())
    return float(np.mean(best)), float(np.mean(mean))


def best_of(predictions: Any, truth: Any) -> float:
    """The best member's balanced accuracy by this truth."""
    return float(member_scores(predictions, truth)["balanced_accuracy"].max())


@dataclass(frozen=True)
class Case:
    """Where an ensemble is trained, by which methods, and how it is judged."""

    domain: str = "rooms"
    collect: dict[str, Any] = field(default_factory=dict)
    train: dict[str, Any] = field(default_factory=dict)
    methods: dict[str, dict[str, Any]] = field(default_factory=lambda: {"auto": AUTO})
    spoil: Spoil | None = None
    judge: Judge = by_features
    columns: tuple[str, str] = ("first", "second")  # as the table has them


CASES = {
    "rooms": Case(),
    "rooms, 5 % of labels wrong": Case(spoil=partial(wrong, 0.05)),
    "rooms, 10 % of labels wrong": Case(spoil=partial(wrong, 0.1)),
    "rooms, no conflict": Case(collect={"mix": 0.0}),
    "rooms, one picture a class": Case(spoil=repeated),
    "doorkey": Case("doorkey", {"heldout_layouts": 5}, {}, BOTH, judge=by_labels),
    "ladders, N = 1": Case("montezuma", {"groups": 1}, {}, BOTH, judge=by_labels),
    "ladders, N = 2": Case("montezuma", {"groups": 2}, {}, BOTH, judge=by_labels),
    "fetch": Case(
        "misgeneralise:FETCH",
        {"labelled": 160, "unlabelled": 300},
        FETCH,
        {
            **BOTH,
            "by hand": {"diversity_weight": 0.01, "schedule": "sequential", "restarts": 1},
            "auto, divdis": {**AUTO, "diversity": "divdis", "schedule": "simultaneous", "restarts": 1},
            "divdis, share 1/3, weight 1": {
                **PAPER,
                "diversity": "divdis",
                "diversity_weight": 1.0,
                "share": 1 / 3,
            },
        },
        judge=by_colour_and_shape,
        columns=("second", "first"),
    ),
}


def run_cell(name: str, method: str, seed: int) -> list[Row]:
    """Collect, spoil the labels, train and judge."""
    case = CASES[name]
    with TemporaryDirectory() as folder:
        data, ensemble = Path(folder, "data.h5"), Path(folder, "ensemble")
        hypogoal.collect(case.domain, data, seed=seed, quiet=True, **case.collect)
        if case.spoil:
            with h5py.File(data, "r+") as file:
                for labelled in file["labelled"].values():
                    case.spoil(labelled, rng_for(seed, "spoil"))
        settings = {**case.train, **case.methods[method]}
        hypogoal.train_ensemble(data, ensemble, seed=seed, workers=1, quiet=True, **settings)
        chosen = open_artefact(ensemble).config["chosen"].values()
        first, second = case.judge(data, ensemble, seed)
    row: Row = {"case": name, "method": method, "seed": seed, "step": 0, "first": first, "second": second}
    row["weight"] = " ".join(sorted({f"{each['diversity_weight']:g}" for each in chosen}))
    row["idle"] = sum(len(each["idle"]) for each in chosen)
    return [row]


def tables(path: Path) -> Iterator[str]:
    """What the rows say, as lines of Markdown: a table of data with planted features, and one of those without."""
    rows = read_rows(path)
    planted: list[list[str]] = []
    others: list[list[str]] = []
    for name, case in CASES.items():
        for method in case.methods:
            cells = [row for row in rows if (row["case"], row["method"]) == (name, method)]
            if not cells:
                continue
            weights = sorted({float(weight) for row in cells for weight in row["weight"].split()})
            numbers = [np.array([float(row[column]) for row in cells]) for column in case.columns]
            idle = sum(int(row["idle"]) for row in cells)
            told = ", ".join(f"{weight:g}" for weight in weights)
            line = [name, method, told, *map(interval, numbers), str(idle), str(len(cells))]
            (others if case.judge == by_labels else planted).append(line)
    first, last = ["data", "method", "weights"], ["useless members, of all seeds", "seeds"]
    yield ""
    yield from table([*first, "best member, by shape", "best member, by the other feature", *last], planted)
    yield from table([*first, "best member", "mean member", *last], others)


def main() -> None:
    parser = parser_of(__doc__, "1300-1304")
    parser.add_argument("--cases", nargs="*", choices=CASES, default=[*CASES], help="some of them")
    arguments = parser.parse_args()
    if printed(arguments, tables):
        return
    jobs: Jobs = {}
    for name, seed in product(arguments.cases, arguments.seeds):
        module, _, _ = CASES[name].domain.partition(":")
        if module == CASES[name].domain or find_spec(module):
            for method in CASES[name].methods:
                jobs[name, method, str(seed)] = partial(run_cell, name, method, seed)
    run_cells(arguments.csv, COLUMNS, KEYS, jobs, lambda _: [0], arguments.workers)


if __name__ == "__main__":
    main()
