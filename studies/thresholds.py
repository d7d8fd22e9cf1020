"""Above which threshold to predict positive, without labels of another layout: rules compared on DoorKey.

    python -m studies.thresholds docs/results/thresholds-doorkey.csv --layouts choice --seeds 100-101
    python -m studies.thresholds docs/results/thresholds-doorkey.csv --layouts test --seeds 0-4

A cell is a method, a sub-goal and a seed: one training, looked at after each of ``LOOKS`` steps; ``--tables`` draws
them. A rule sees a member's probabilities on the labelled and the unlabelled states, and which labelled ones are
positives.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit, logit

from hypogoal.core.compute import prepare
from hypogoal.core.seeding import seed_for
from hypogoal.domains.doorkey import DOMAIN
from hypogoal.hypotheses.config import EnsembleConfig
from hypogoal.hypotheses.ensemble import Ensemble
from hypogoal.hypotheses.scores import best_threshold, member_scores
from hypogoal.hypotheses.thresholds import unlabelled_split
from hypogoal.hypotheses.training import Watcher, fit
from studies.cells import Jobs, Row, difference, interval, parser_of, printed, read_rows, run_cells, table
from studies.hypotheses import METHODS, states_of

Probabilities = NDArray[np.float64]  # of one member
Rule = Callable[[Any, Any, Any], float | np.floating]  # labelled positives, negatives, unlabelled
LOOKS = (150, 600)
TRAINED = ("dbat", "none", "dbat-unpaired")
KEYS = ("layouts", "method", "sub_goal", "seed", "step", "member")


def base_rate(positives: Probabilities, negatives: Probabilities, unlabelled: Probabilities) -> float:
    """Predict positive on as large a share of the unlabelled states as of the labelled ones."""
    return float(np.quantile(unlabelled, len(negatives) / (len(positives) + len(negatives)), method="higher"))


def adjusted(positives: Probabilities, negatives: Probabilities, unlabelled: Probabilities) -> float:
    """Saerens et al. (2002): the share of positives that the unlabelled probabilities are most likely under, by EM.

    Members are trained on batches half of which are positive. A prediction is positive if
    it is likelier than not under that share.
    """
    share = 0.5
    for _ in range(1_000):
        odds = unlabelled / np.maximum(1 - unlabelled, 1e-12) * share / (1 - share)
        share = float(np.clip((odds / (1 + odds)).mean(), 1e-6, 1 - 1e-6))
    return 1 - share


def margin(positives: Probabilities, negatives: Probabilities, unlabelled: Probabilities) -> float:
    """Half-way, in logits, between the median positive and the median unlabelled state."""
    middle = [np.median(logit(states.clip(1e-12, 1 - 1e-12))) for states in (positives, unlabelled)]
    return float(expit(np.mean(middle)))


RULES: dict[str, Rule] = {
    "0.5": lambda positives, negatives, unlabelled: 0.5,
    "unlabelled-q95": lambda positives, negatives, unlabelled: float(np.quantile(unlabelled, 0.95, method="higher")),
    "unlabelled-q80": lambda positives, negatives, unlabelled: float(np.quantile(unlabelled, 0.8, method="higher")),
    "base-rate": base_rate,
    "adjusted": adjusted,
    "split": unlabelled_split,
    "margin": margin,
    "positives-median": lambda positives, negatives, unlabelled: float(np.median(positives)),
    "positives-q05": lambda positives, negatives, unlabelled: float(np.quantile(positives, 0.05, method="lower")),
    "positives-least": lambda positives, negatives, unlabelled: float(np.nextafter(positives.min(), 0)),
}
COLUMNS = (*KEYS, *RULES, "best")


def run_cell(layouts: str, method: str, sub_goal: str, seed: int) -> list[Row]:
    """Train one ensemble, and judge each of its members at every rule's threshold on the held-out layouts."""
    prepare()
    data = states_of(layouts)
    column = data.sub_goals.index(sub_goal)
    labels, truth = data.labelled.labels[:, column], data.heldout.labels[:, column]
    rows: list[Row] = []

    def look(step: int, ensemble: Ensemble) -> None:
        labelled, elsewhere, heldout = (
            ensemble.predict(states.observations).astype(np.float64)
            for states in (data.labelled, data.unlabelled, data.heldout)
        )
        for member in range(len(ensemble)):
            place = dict(zip(KEYS, (layouts, method, sub_goal, seed, step, member), strict=True))
            seen = (labelled[labels, member], labelled[~labels, member], elsewhere[:, member])
            thresholds = np.array([rule(*seen) for rule in RULES.values()])
            scores = member_scores(heldout[:, [member]] > np.minimum(thresholds, np.nextafter(1, 0)), truth)
            best = best_threshold(heldout[:, [member]].astype(np.float32), truth)[1]
            accuracies = map(float, (*scores["balanced_accuracy"], best[0]))
            rows.append(place | dict(zip(COLUMNS[len(KEYS) :], accuracies, strict=True)))

    fit(
        data.labelled.observations,
        labels,
        data.unlabelled.observations,
        dataclasses.replace(EnsembleConfig(steps=LOOKS[-1]), **METHODS[method]),
        seed_for(seed, "ensemble", sub_goal),
        Watcher(look=look, look_at=LOOKS),
    )
    return rows


def tables(path: Path) -> Iterator[str]:
    """What the cells say, as lines of Markdown."""
    every = read_rows(path)
    choice, test = ([row for row in every if row["layouts"] == layouts] for layouts in ("choice", "test"))
    yield f"Mean member's balanced accuracy: {_seeds(choice)} for choosing, {_seeds(test)} for the test."
    yield ""
    cells = {f"{method}, {step}": (method, step) for step in LOOKS for method in TRAINED}
    rules = {"the best there is" if rule == "best" else rule: rule for rule in COLUMNS[len(KEYS) :]}

    def gain(method: str = "", step: int = 0) -> str:
        return difference(by_seed(test, "split", method, step) - by_seed(test, "0.5", method, step))

    yield from table(
        ["", "choosing, mean", "test, mean", *cells],
        [
            *(
                [
                    title,
                    f"{by_seed(choice, rule).mean():.3f}",
                    interval(by_seed(test, rule)),
                    *(f"{by_seed(test, rule, *cell).mean():.3f}" for cell in cells.values()),
                ]
                for title, rule in rules.items()
            ),
            ["split minus 0.5", "-", gain(), *(gain(*cell) for cell in cells.values())],
        ],
    )
    yield f"D-BAT, {LOOKS[0]} steps, test, by sub-goal."
    yield ""
    yield from table(
        ["", *DOMAIN.sub_goals],
        (
            [title, *(f"{by_seed(test, rules[title], 'dbat', LOOKS[0], goal).mean():.3f}" for goal in DOMAIN.sub_goals)]
            for title in ("0.5", "base-rate", "split", "the best there is")
        ),
    )


def _seeds(rows: list[dict[str, str]]) -> str:
    return f"{len({row['seed'] for row in rows})} seeds"


def by_seed(
    rows: list[dict[str, str]], rule: str, method: str = "", step: int = 0, sub_goal: str = ""
) -> NDArray[np.float64]:
    """Balanced accuracy at a rule's threshold, mean over cells (of one method, step, sub-goal): float64 (seeds,)."""
    wanted = {"method": method, "step": str(step or ""), "sub_goal": sub_goal}
    chosen = [row for row in rows if all(value in ("", row[name]) for name, value in wanted.items())]
    seeds = sorted({row["seed"] for row in chosen})
    return np.array([np.mean([float(row[rule]) for row in chosen if row["seed"] == seed]) for seed in seeds])


def main() -> None:
    """Run the cells that are not in the file yet."""
    parser = parser_of(__doc__, "0-4")
    parser.add_argument("--layouts", choices=("choice", "test"), default="test")
    arguments = parser.parse_args()
    if printed(arguments, tables):
        return
    jobs: Jobs = {
        (arguments.layouts, method, sub_goal, str(seed)): partial(run_cell, arguments.layouts, method, sub_goal, seed)
        for seed in arguments.seeds
        for method in TRAINED
        for sub_goal in DOMAIN.sub_goals
    }
    run_cells(arguments.csv, COLUMNS, KEYS[:4], jobs, lambda _: LOOKS, arguments.workers)


if __name__ == "__main__":
    main()
