"""What members know of DoorKey's held-out layouts, by method and length of training: the cells behind the results.

    python -m studies.hypotheses docs/results/hypotheses-doorkey.csv --layouts choice --seeds 100
    python -m studies.hypotheses docs/results/hypotheses-doorkey.csv --layouts choice --seeds 101,102 --until 600
    python -m studies.hypotheses docs/results/hypotheses-doorkey.csv --layouts test --seeds 0-9 --chosen

A cell is a method, a sub-goal and a seed: one training, looked at after each of ``LOOKS`` steps. Its rows, one a look
and member, are appended to the file as soon as it is done; a run that was cut goes on where it stopped. Layouts for
choosing a method's length of training are others than those that it is tested on, and so are the seeds. With
``--chosen`` a method is trained to its chosen length and looked at there only; without, all the way.

    python -m studies.hypotheses docs/results/hypotheses-doorkey.csv --tables

prints the tables of all cells that there are, as Markdown.

K = 3, Table 3, the same data, weights and batches for all methods; ``cnn`` is one member of ``none``. A method's length
is the one with the highest cross-fitted ranking, mean over sub-goals and seeds 100 to 102; only seed 100 trains beyond
600 steps.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hypogoal.core.processes import prepare
from hypogoal.core.progress import Progress
from hypogoal.core.seeding import seed_for
from hypogoal.data import Collected
from hypogoal.domains.doorkey.domain import DOMAIN, DoorKeyConfig
from hypogoal.evaluation.statistics import above
from hypogoal.hypotheses.config import EnsembleConfig
from hypogoal.hypotheses.ensemble import Ensemble
from hypogoal.hypotheses.scores import best_threshold, cross_fitted, halves, member_scores, ranking
from hypogoal.hypotheses.training import EnsembleTraining
from studies.cells import TITLES, Row, interval, parser_of, printed, read_rows, run_cells, table

METHODS: dict[str, dict[str, Any]] = {
    "dbat": {"diversity": "dbat"},
    "none": {"diversity": "none"},
    "dbat-unpaired": {"diversity": "dbat-unpaired"},
    "cnn": {"members": 1, "diversity": "none"},
}
LOOKS = (50, 100, 150, 200, 300, 400, 600, 800, 1000, 1300, 1600, 2000, 2600)
LONG = (150, 600, 1000, 2600)  # looks at the seed that was trained longer
LAYOUTS = {"choice": 500, "test": 1000}  # the first of twenty held-out layouts
KEYS = ("layouts", "method", "sub_goal", "seed", "step", "member")
OF_ALL = ("ranking", "balanced_accuracy", "precision", "recall", "at_q95", "at_best")
OF_HALVES = ("ranking", "balanced_accuracy", "at_q95")
COLUMNS = (*KEYS, *OF_ALL, *(f"{name}_{half}" for half in ("first", "second") for name in OF_HALVES))


@lru_cache(maxsize=1)
def states_of(layouts: str) -> Collected:
    """The labelled and unlabelled states of ``hypogoal collect doorkey``, and held-out ones of these layouts."""
    config = DoorKeyConfig(heldout_first=LAYOUTS[layouts])
    return DOMAIN.collect(config, 0, Progress("collect", 1, quiet=True))


def scores_of(
    probabilities: NDArray[np.float32], labels: NDArray[np.bool_], quantiles: NDArray[np.float32]
) -> dict[str, NDArray[np.float64]]:
    """``OF_ALL``, each (K,), of members' probabilities (N, K); ``at_q95`` is above their ``quantiles`` (K,)."""
    at_half = member_scores(probabilities > 0.5, labels)
    return {
        "ranking": ranking(probabilities, labels),
        "balanced_accuracy": at_half["balanced_accuracy"],
        "precision": at_half["precision"],
        "recall": at_half["recall"],
        "at_q95": member_scores(probabilities > quantiles, labels)["balanced_accuracy"],
        "at_best": best_threshold(probabilities, labels)[1],
    }


def run_cell(layouts: str, method: str, sub_goal: str, seed: int, looks: Sequence[int] = LOOKS) -> list[Row]:
    """Train one ensemble as ``hypogoal train-ensemble --seed`` would, and score it on the way."""
    prepare()
    data = states_of(layouts)
    column = data.sub_goals.index(sub_goal)
    labels = data.heldout.labels[:, column]
    first = halves(data.heldout.origins["layout_seed"])
    assert first is not None
    rows: list[Row] = []

    def look(step: int, ensemble: Ensemble) -> None:
        probabilities = ensemble.predict(data.heldout.observations)
        elsewhere = ensemble.predict(data.unlabelled.observations)
        quantiles = np.quantile(elsewhere, 0.95, axis=0, method="higher").astype(np.float32)
        columns = scores_of(probabilities, labels, quantiles)
        for half, inside in (("first", first), ("second", ~first)):
            of_half = scores_of(probabilities[inside], labels[inside], quantiles)
            columns |= {f"{name}_{half}": of_half[name] for name in OF_HALVES}
        for member in range(len(ensemble)):
            place = dict(zip(KEYS, (layouts, method, sub_goal, seed, step, member), strict=True))
            rows.append(place | {name: float(values[member]) for name, values in columns.items()})

    training = EnsembleTraining(
        data.labelled.observations,
        data.labelled.labels[:, column],
        data.unlabelled.observations,
        EnsembleConfig(steps=looks[-1]).model_copy(update=METHODS[method]),
        seed_for(seed, "ensemble", sub_goal),
    )
    for step, _ in training.steps():
        if step in looks:
            look(step, training.ensemble)
    return rows


Cell = tuple[str, str, int]  # method, sub-goal, seed
Numbers = dict[Cell, dict[int, dict[str, NDArray[np.float64]]]]  # by step and column (K,)


def read(path: Path, layouts: str) -> Numbers:
    """The finished seeds of some layouts: for each cell, step and column the members' numbers (K,)."""
    numbers: Numbers = {}
    for row in read_rows(path):
        if row["layouts"] != layouts:
            continue
        steps = numbers.setdefault((row["method"], row["sub_goal"], int(row["seed"])), {})
        columns = steps.setdefault(int(row["step"]), {name: np.empty(0) for name in COLUMNS[len(KEYS) :]})
        for name, values in columns.items():
            columns[name] = np.append(values, float(row[name] or "nan"))
    # A method's seed counts when all of its sub-goals are there: means over others are not comparable.
    whole = {(m, seed) for m, _, seed in numbers if all((m, goal, seed) in numbers for goal in DOMAIN.sub_goals)}
    return {cell: steps for cell, steps in numbers.items() if (cell[0], cell[2]) in whole}


def crossed(members: dict[str, NDArray[np.float64]], name: str) -> float:
    """The cross-fitted best member of one ensemble."""
    return cross_fitted(members[f"{name}_first"], members[f"{name}_second"])


def curve(numbers: Numbers, method: str, score: Callable[[dict[str, NDArray[np.float64]]], float]) -> dict[int, float]:
    """By length of training that all got to, the mean of something over a method's sub-goals and seeds."""
    cells = [steps for (name, _, _), steps in numbers.items() if name == method]
    looks = [step for step in LOOKS if cells and all(step in steps for steps in cells)]
    return {step: float(np.mean([score(steps[step]) for steps in cells])) for step in looks}


def lengths(choice: Numbers) -> dict[str, int]:
    """The rule: each method's length is the look with the highest cross-fitted ranking on the layouts for choosing."""
    curves = {method: curve(choice, method, lambda members: crossed(members, "ranking")) for method in METHODS}
    return {method: max(steps, key=lambda step: steps[step]) for method, steps in curves.items() if steps}


def by_seed(
    numbers: Numbers, method: str, step: int, score: Callable[[dict[str, NDArray[np.float64]]], float], sub_goals: Any
) -> NDArray[np.float64]:
    """The mean over sub-goals of something, for each seed of which all of these are there."""
    seeds = sorted({seed for name, _, seed in numbers if name == method})
    means = [[numbers.get((method, goal, seed)) for goal in sub_goals] for seed in seeds]
    return np.array([np.mean([score(steps[step]) for steps in cells if steps]) for cells in means if all(cells)])


SHOWN: dict[str, Callable[[dict[str, NDArray[np.float64]]], float]] = {
    "ranking, cross-fitted best": lambda members: crossed(members, "ranking"),
    "ranking, mean member": lambda members: float(members["ranking"].mean()),
    "balanced accuracy at 0.5, cross-fitted best": lambda members: crossed(members, "balanced_accuracy"),
    "balanced accuracy at 0.5, mean member": lambda members: float(members["balanced_accuracy"].mean()),
    "balanced accuracy at 0.5, worst member": lambda members: float(members["balanced_accuracy"].min()),
}
CROSSED = ("ranking, cross-fitted best", "balanced accuracy at 0.5, cross-fitted best")


def tables(path: Path) -> Iterator[str]:
    """What the cells say, as lines of Markdown."""
    choice, test = read(path, "choice"), read(path, "test")
    chosen = lengths(choice)
    scores = "ranking / balanced accuracy at 0.5 of the cross-fitted best member, by steps"
    yield f"Layouts for choosing, {_seeds(choice)}: {scores}; in bold the chosen length.\n"
    yield from _curves(choice, chosen, LOOKS)
    first = min(seed for _, _, seed in choice)
    alone = {cell: steps for cell, steps in choice.items() if cell[2] == first}
    yield f"Seed {first} alone, trained longer: the same.\n"
    yield from _curves(alone, dict.fromkeys(chosen, 0), LONG)
    tested = [method for method in chosen if any(name == method for name, _, _ in test)]
    if not tested:
        return
    yield f"Test layouts, {_seeds(test)}, mean over the five sub-goals with a 95 % interval over seeds.\n"
    every = DOMAIN.sub_goals
    yield from table(
        ["method", "training steps", *SHOWN],
        (
            [
                TITLES[method],
                str(chosen[method]),
                *(interval(by_seed(test, method, chosen[method], score, every)) for score in SHOWN.values()),
            ]
            for method in tested
        ),
    )
    yield "D-BAT minus the other, cross-fitted ranking, seed by seed.\n"
    titles = ["D-BAT compared with", "sub-goal", "D-BAT ranks better by", "seeds on which it ranks better"]
    yield from table(titles, _differences(test, chosen, tested))


def _curves(numbers: Numbers, chosen: dict[str, int], shown: Sequence[int]) -> Iterator[str]:
    curves = {method: [curve(numbers, method, SHOWN[name]) for name in CROSSED] for method in chosen}
    looks = [step for step in shown if any(step in scores for scores, _ in curves.values())]

    def cell(method: str, step: int) -> str:
        text = " / ".join(f"{scores[step]:.3f}" if step in scores else "-" for scores in curves[method])
        return f"**{text}**" if step == chosen[method] else text

    yield from table(["", *map(str, looks)], ([m, *(cell(m, step) for step in looks)] for m in chosen))


def _differences(test: Numbers, chosen: dict[str, int], tested: Sequence[str]) -> Iterator[list[str]]:
    for method in tested:
        if method == "dbat":
            continue
        for title, goals in {
            "mean of all five": DOMAIN.sub_goals,
            **{goal: (goal,) for goal in DOMAIN.sub_goals},
        }.items():
            dbat, other = (by_seed(test, name, chosen[name], SHOWN[CROSSED[0]], goals) for name in ("dbat", method))
            if len(dbat) == len(other):
                count = f"{above(dbat, other).sum()} of {len(dbat)}"
                yield [TITLES[method], title, interval(dbat - other), count]


def _seeds(numbers: Numbers) -> str:
    seeds = sorted({seed for _, _, seed in numbers})
    return f"seeds {seeds[0]} to {seeds[-1]}" if seeds else "no seeds"


def main() -> None:
    """Run the cells that are not in the file yet."""
    parser = parser_of(__doc__, "0-9")
    parser.add_argument("--layouts", choices=LAYOUTS, default="test")
    parser.add_argument("--methods", default=",".join(METHODS), help="comma-separated; all by default")
    parser.add_argument("--until", type=int, default=LOOKS[-1], help="steps to train for")
    parser.add_argument("--chosen", action="store_true", help="each method at its chosen length, and no other")
    arguments = parser.parse_args()
    if printed(arguments, tables):
        return
    methods = arguments.methods.split(",")
    chosen = lengths(read(arguments.csv, "choice")) if arguments.chosen else {}
    until = tuple(step for step in LOOKS if step <= arguments.until)
    looks = {method: (chosen[method],) if chosen else until for method in methods}
    run_cells(
        arguments.csv,
        COLUMNS,
        KEYS[:4],
        {
            (arguments.layouts, method, sub_goal, str(seed)): partial(
                run_cell, arguments.layouts, method, sub_goal, seed, looks[method]
            )
            for seed in arguments.seeds
            for method in methods
            for sub_goal in DOMAIN.sub_goals
        },
        lambda cell: looks[cell[1]],
        arguments.workers,
    )


if __name__ == "__main__":
    main()
