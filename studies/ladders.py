"""What members know of rooms of Montezuma's Revenge nobody labelled, by labelled ladder groups and length of training.

    python -m studies.ladders docs/results/figure3-ladders.csv --groups 1 --seeds 0-9

A cell is N (labelled ladder groups), a method and a seed: one training, looked at after each of ``LOOKS`` steps.
Up to N = 3, length and member are picked on half of the rooms and scored on the other half, and the other way round.
From N = 4 on a half has no base, so all rooms are scored, at the length that is best for the other seeds. Cells are
kept and gone on with as in ``studies.hypotheses``; ``--tables`` draws them.

The paper's network and Table 1, but K = 3 (6) to halve the cost; two unlabelled rooms, 300 held-out states of each of
24 rooms, up to 1,000 steps (107 passes; the authors' configuration says 130). Seeds: ten at N = 1 and 2, five at 3 and
4, three at 5 to 7 (without the control at 6 and 7). Commits 7f39d96, 4f87b6a, e4812526, d2e49422.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hypogoal.core.config import integers
from hypogoal.core.processes import prepare
from hypogoal.core.progress import Progress
from hypogoal.core.seeding import seed_for
from hypogoal.data import Collected
from hypogoal.domains.montezuma.domain import DOMAIN, SEEN_NOWHERE, TABLE_1, MontezumaConfig
from hypogoal.domains.montezuma.sub_goals import CLIMB_DOWN
from hypogoal.hypotheses.config import EnsembleConfig
from hypogoal.hypotheses.ensemble import Ensemble
from hypogoal.hypotheses.scores import halves, member_scores, ranking
from hypogoal.hypotheses.training import EnsembleTraining
from studies.cells import TITLES, Jobs, Row, interval, parser_of, printed, read_rows, run_cells, table, won

METHODS: dict[str, dict[str, Any]] = {
    "dbat": {"diversity": "dbat"},
    "none": {"diversity": "none"},
    "cnn": {"members": 1, "diversity": "none"},
    "dbat-unpaired": {"diversity": "dbat-unpaired"},
}
MEMBERS = 3
LOOKS = (10, 25, 50, 100, 200, 300, 450, 600, 800, 1000)
SCOPES = ("all", "unseen", "first", "second")  # all rooms; those of no training set, and both halves of these
HELDOUT = 300  # states of each room
ALL_ROOMS_FROM = 4  # groups: one half of the unseen rooms has no base
KEYS = ("groups", "method", "seed", "step", "member")
COLUMNS = (*KEYS, *(f"{name}_{scope}" for scope in SCOPES for name in ("ranking", "balanced_accuracy", "accuracy")))
# 'Accuracy', three seeds each: experiments/divdis_monte/classifier_plot.py of the authors' repository.
AUTHORS = Path(__file__).parents[1] / "docs/results/figure3-authors.csv"


@lru_cache(maxsize=1)
def states_of(groups: int) -> Collected:
    """The states of ``collect montezuma --set groups=N --set heldout_per_room=HELDOUT``, of the paper's sub-goal."""
    config = MontezumaConfig(groups=groups, sub_goals=(CLIMB_DOWN.name,), heldout_per_room=HELDOUT, workers=1)
    return DOMAIN.collect(config, 0, Progress("collect", 1, quiet=True))


def run_cell(groups: int, method: str, seed: int, looks: tuple[int, ...]) -> list[Row]:
    """Train one ensemble as ``hypogoal train-ensemble --seed`` would, and score it on the way."""
    prepare()
    data = states_of(groups)
    labels, unseen = data.heldout.labels[:, 0], data.heldout.origins["seen"] == SEEN_NOWHERE
    first = halves(data.heldout.origins["room"][unseen])
    assert first is not None
    scopes = dict.fromkeys(SCOPES, np.ones(len(labels), dtype=np.bool_))
    scopes["unseen"] = unseen
    for name, half in (("first", first), ("second", ~first)):
        scopes[name] = np.zeros(len(labels), dtype=np.bool_)
        scopes[name][np.flatnonzero(unseen)[half]] = True
    rows: list[Row] = []

    def look(step: int, ensemble: Ensemble) -> None:
        probabilities = ensemble.predict(data.heldout.observations)
        columns: dict[str, NDArray[np.float64]] = {}
        for scope, inside in scopes.items():
            scores = member_scores(probabilities[inside] > 0.5, labels[inside])
            columns[f"ranking_{scope}"] = ranking(probabilities[inside], labels[inside])
            columns |= {f"{name}_{scope}": scores[name] for name in ("balanced_accuracy", "accuracy")}
        for member in range(len(ensemble)):
            place = {"groups": groups, "method": method, "seed": seed, "step": step, "member": member}
            rows.append(place | {name: float(values[member]) for name, values in columns.items()})

    config = EnsembleConfig.of(**{**TABLE_1, "members": MEMBERS, "steps": looks[-1]})
    training = EnsembleTraining(
        data.labelled.observations,
        data.labelled.labels[:, 0],
        data.unlabelled.observations,
        config.model_copy(update=METHODS[method]),
        seed_for(seed, "ensemble", CLIMB_DOWN.name),
    )
    for step, _ in training.steps():
        if step in looks:
            look(step, training.ensemble)
    return rows


Seeds = dict[int, dict[int, dict[str, NDArray[np.float64]]]]  # by seed, step and column: (K,)
Numbers = dict[str, Seeds]  # by method


def read(path: Path, groups: int) -> Numbers:
    """The cells of one N; only seeds that every method has."""
    numbers: Numbers = {}
    for row in read_rows(path):
        if int(row["groups"]) == groups:
            steps = numbers.setdefault(row["method"], {}).setdefault(int(row["seed"]), {})
            columns = steps.setdefault(int(row["step"]), {})
            for name in COLUMNS[len(KEYS) :]:
                columns[name] = np.append(columns.get(name, np.empty(0)), float(row[name] or "nan"))
    shared = set.intersection(*map(set, numbers.values())) if numbers else set()
    return {method: {seed: seeds[seed] for seed in sorted(shared)} for method, seeds in numbers.items()}


def picked(seeds: Seeds, half: str) -> int:
    """The rule: the look at which the best member's ranking on half of the rooms is highest, mean over seeds."""
    steps = next(iter(seeds.values()))
    return max(steps, key=lambda step: np.mean([looks[step][f"ranking_{half}"].max() for looks in seeds.values()]))


def crossed(seeds: Seeds, name: str) -> NDArray[np.float64]:
    """A score of the member that ranks best on one half of the rooms, on the other, at the length of that half.

    Returns:
        float64 (seeds,): the mean of both directions.
    """
    directions = []
    for picking, scoring in (("first", "second"), ("second", "first")):
        step = picked(seeds, picking)
        looks = [steps[step] for steps in seeds.values()]
        directions.append([look[f"{name}_{scoring}"][look[f"ranking_{picking}"].argmax()] for look in looks])
    scores: NDArray[np.float64] = np.mean(directions, axis=0)
    return scores


def best_at_others_length(seeds: Seeds, name: str) -> NDArray[np.float64]:
    """The best member's score over all rooms, each seed at the length picked on all others: float64 (seeds,)."""
    best = []
    for seed, steps in seeds.items():
        step = picked({other: looks for other, looks in seeds.items() if other != seed}, "all")
        best.append(steps[step][f"{name}_all"].max())
    return np.array(best)


def tables(path: Path) -> Iterator[str]:
    """What the cells say, as lines of Markdown."""
    for groups in range(1, 8):
        numbers = read(path, groups)
        seeds = len(numbers.get("dbat", {}))
        if groups < ALL_ROOMS_FROM and seeds:
            yield from _tables(groups, numbers)
        elif seeds > 1:
            yield from _tables_of_all_rooms(groups, numbers)


def _tables_of_all_rooms(groups: int, numbers: Numbers) -> Iterator[str]:
    yield f"N = {groups}, {len(numbers['dbat'])} seeds: the best member over all rooms, at the others' length.\n"
    yield from table(
        ["", "ranking", "balanced accuracy", "accuracy", "D-BAT minus it, balanced accuracy", "the authors' accuracy"],
        (_at_others_length(groups, numbers, method) for method in numbers),
    )


def _at_others_length(groups: int, numbers: Numbers, method: str) -> list[str]:
    names = ("ranking", "balanced_accuracy", "accuracy")
    scores, dbat = ({name: best_at_others_length(numbers[each], name) for name in names} for each in (method, "dbat"))
    versus = "-" if method == "dbat" else interval(dbat["balanced_accuracy"] - scores["balanced_accuracy"])
    return [method, *(interval(scores[name]) for name in names), versus, _of_authors(groups, method)]


def _tables(groups: int, numbers: Numbers) -> Iterator[str]:
    seeds = list(numbers["dbat"])
    yield f"N = {groups}, {len(seeds)} seeds, cross-fitted:"
    yield "length and member picked on half of the unseen rooms, scored on the other.\n"
    lengths = ["training steps that rank best on one half", "training steps that rank best on the other half"]
    scores = ["ranking", "balanced accuracy at 0.5", "D-BAT ranks better by", "seeds on which it ranks better"]
    rows = [_cross_fitted(numbers, method) for method in numbers]
    yield from table(["method", *lengths, *scores], rows)
    yield "All rooms, at the mean of both lengths: the best member there, the paper's way.\n"
    yield from table(
        ["", "balanced accuracy", "accuracy", "the authors' (three seeds)"],
        (_all_rooms(groups, method, seeds) for method, seeds in numbers.items()),
    )


def _cross_fitted(numbers: Numbers, method: str) -> list[str]:
    seeds = numbers[method]
    rankings, dbat = crossed(seeds, "ranking"), crossed(numbers["dbat"], "ranking")
    steps = [str(picked(seeds, half)) for half in ("first", "second")]
    versus = ["-", "-"] if method == "dbat" else [interval(dbat - rankings), won(dbat - rankings)]
    return [TITLES[method], *steps, interval(rankings), interval(crossed(seeds, "balanced_accuracy")), *versus]


def _all_rooms(groups: int, method: str, seeds: Seeds) -> list[str]:
    best = []
    for name in ("balanced_accuracy_all", "accuracy_all"):
        of_half = [[steps[picked(seeds, half)][name].max() for steps in seeds.values()] for half in ("first", "second")]
        best.append(interval(np.mean(of_half, axis=0)))
    return [method, *best, _of_authors(groups, method)]


def _of_authors(groups: int, method: str) -> str:
    """Their accuracies, or '-'."""
    rows = [row for row in read_rows(AUTHORS) if (row["method"], row["groups"]) == (method, str(groups))]
    return " ".join(f"{float(row[seed]):.3f}" for row in rows for seed in ("first", "second", "third")) or "-"


def main() -> None:
    """Run the cells that are not in the file yet."""
    parser = parser_of(__doc__, "0-9")
    parser.add_argument("--groups", type=integers, default=[1], help="labelled ladder groups: 1 or 1-4")
    parser.add_argument("--methods", default=",".join(METHODS), help="comma-separated; all by default")
    parser.add_argument("--until", type=int, default=LOOKS[-1], help="steps to train for")
    arguments = parser.parse_args()
    if printed(arguments, tables):
        return
    looks = tuple(step for step in LOOKS if step <= arguments.until)
    jobs: Jobs = {
        (str(groups), method, str(seed)): partial(run_cell, groups, method, seed, looks)
        for groups in arguments.groups
        for seed in arguments.seeds
        for method in arguments.methods.split(",")
    }
    run_cells(arguments.csv, COLUMNS, KEYS[:3], jobs, lambda _: looks, arguments.workers)


if __name__ == "__main__":
    main()
