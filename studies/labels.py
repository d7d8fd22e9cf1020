"""How many labelled states does a hypothesis need? DoorKey's held-out layouts by the number of labels.

    python -m studies.labels docs/results/labels-doorkey.csv --seeds 0-4

A cell is a number of labelled states, a method, a sub-goal and a seed: one training of ``STEPS`` steps on states drawn
from those of layout 0, half of them positives where there are so many. Kept and gone on with as in
``studies.hypotheses``; ``--tables`` draws the cells.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hypogoal.core.compute import prepare
from hypogoal.core.seeding import rng_for, seed_for
from hypogoal.domains.doorkey import DOMAIN
from hypogoal.hypotheses.config import EnsembleConfig
from hypogoal.hypotheses.ensemble import Ensemble
from hypogoal.hypotheses.scores import cross_fitted, halves, member_scores, ranking
from hypogoal.hypotheses.training import Watcher, fit
from studies.cells import Jobs, Row, difference, interval, parser_of, printed, read_rows, run_cells, table
from studies.hypotheses import Looked, settings_of, states_of

LABELS = (5, 10, 20, 50, 200, 0)  # 0: all of them
TRAINED = ("dbat", "none", "dbat-unpaired")
STEPS = 150
KEYS = ("labels", "method", "sub_goal", "seed", "step", "member")
SCORES = ("ranking", "balanced_accuracy")
COLUMNS = (*KEYS, "positives", *(f"{name}{half}" for half in ("", "_first", "_second") for name in SCORES))


def drawn(labels: NDArray[np.bool_], count: int, seed: int) -> NDArray[np.int64]:
    """Which states are labelled: ``count`` of them, half of them positives where there are so many; all for 0."""
    if not count:
        return np.arange(len(labels))
    rng = rng_for(seed, "labels", count)
    positives, negatives = rng.permutation(np.flatnonzero(labels)), rng.permutation(np.flatnonzero(~labels))
    few = positives[: count // 2]
    return np.sort(np.concatenate([few, negatives[: count - len(few)]]))


def run_cell(count: int, method: str, sub_goal: str, seed: int) -> list[Row]:
    """Train one ensemble on so many labelled states, and score it on the test layouts."""
    prepare()
    data = states_of("test")
    column = data.sub_goals.index(sub_goal)
    labels, truth = data.labelled.labels[:, column], data.heldout.labels[:, column]
    chosen = drawn(labels, count, seed)
    first = halves(data.heldout.origins["layout_seed"])
    assert first is not None
    rows: list[Row] = []

    def look(step: int, ensemble: Ensemble) -> None:
        probabilities = Looked(ensemble, "test").predict(data.heldout.observations)
        columns: dict[str, NDArray[np.float64]] = {}
        for half, inside in (("", slice(None)), ("_first", first), ("_second", ~first)):
            seen, true = probabilities[inside], truth[inside]
            columns[f"ranking{half}"] = ranking(seen, true)
            columns[f"balanced_accuracy{half}"] = member_scores(seen > 0.5, true)["balanced_accuracy"]
        for member in range(len(ensemble)):
            place = dict(zip(KEYS, (count, method, sub_goal, seed, step, member), strict=True))
            scores = {name: float(values[member]) for name, values in columns.items()}
            rows.append(place | {"positives": int(labels[chosen].sum())} | scores)

    fit(
        data.labelled.observations[chosen],
        labels[chosen],
        data.unlabelled.observations,
        dataclasses.replace(EnsembleConfig(steps=STEPS), **settings_of(method)),
        seed_for(seed, "ensemble", sub_goal),
        Watcher(look=look, look_at=(STEPS,)),
    )
    return rows


def tables(path: Path) -> Iterator[str]:
    """What the cells say, as lines of Markdown."""
    rows = read_rows(path)
    for name, title in (("ranking", "Ranking"), ("balanced_accuracy", "Balanced accuracy at 0.5")):
        yield f"{title} of the cross-fitted best member, mean over sub-goals with a 95 % interval over seeds."
        yield ""
        counts = [count for count in LABELS if any(int(row["labels"]) == count for row in rows)]
        yield from table(
            ["labelled states", *TRAINED, "D-BAT minus no diversity"],
            (
                [
                    str(count or "all 1,640"),
                    *(interval(by_seed(rows, name, count, method)) for method in TRAINED),
                    difference(by_seed(rows, name, count, "dbat") - by_seed(rows, name, count, "none")),
                ]
                for count in counts
            ),
        )
    yield "Ranking of D-BAT's cross-fitted best member by sub-goal, and how many of the labelled states are positives."
    yield ""
    yield from table(
        ["labelled states", *DOMAIN.sub_goals],
        ([str(count or "all 1,640"), *(_goal(rows, count, goal) for goal in DOMAIN.sub_goals)] for count in counts),
    )


def _goal(rows: list[dict[str, str]], count: int, goal: str) -> str:
    positives = {row["positives"] for row in rows if int(row["labels"]) == count and row["sub_goal"] == goal}
    return f"{by_seed(rows, 'ranking', count, 'dbat', goal).mean():.3f} ({', '.join(sorted(positives))})"


def by_seed(rows: list[dict[str, str]], name: str, count: int, method: str, sub_goal: str = "") -> NDArray[np.float64]:
    """The cross-fitted best member's score, mean over sub-goals (or of one): float64 (seeds,), whole seeds only."""
    cells: dict[str, dict[str, tuple[list[float], list[float]]]] = {}
    for row in rows:
        if (int(row["labels"]), row["method"]) == (count, method) and sub_goal in ("", row["sub_goal"]):
            first, second = cells.setdefault(row["seed"], {}).setdefault(row["sub_goal"], ([], []))
            first.append(float(row[f"{name}_first"]))
            second.append(float(row[f"{name}_second"]))
    wanted = 1 if sub_goal else len(DOMAIN.sub_goals)
    return np.array(
        [
            np.mean([cross_fitted(np.array(first), np.array(second)) for first, second in goals.values()])
            for _, goals in sorted(cells.items())
            if len(goals) == wanted
        ]
    )


def main() -> None:
    """Run the cells that are not in the file yet."""
    parser = parser_of(__doc__, "0-4")
    arguments = parser.parse_args()
    if printed(arguments, tables):
        return
    jobs: Jobs = {
        (str(count), method, sub_goal, str(seed)): partial(run_cell, count, method, sub_goal, seed)
        for seed in arguments.seeds
        for count in LABELS
        for method in TRAINED
        for sub_goal in DOMAIN.sub_goals
    }
    run_cells(arguments.csv, COLUMNS, KEYS[:4], jobs, lambda _: (STEPS,), arguments.workers)


if __name__ == "__main__":
    main()
