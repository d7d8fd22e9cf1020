"""Which recorded states to label next? How many labels until a policy is no longer fooled, by who picks them.

    python -m studies.labels_next docs/results/labels-next.csv --seeds 0-9

A cell is a way of picking, a sub-goal and a seed: an ensemble learns 200 labelled states of layout 0, states of a pool
from ten other layouts are picked and labelled by the truth, it is trained anew, and so on up to ``BUDGETS[-1]`` labels.
Kept and gone on with as in ``studies.hypotheses``; ``--tables`` draws the cells.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import lru_cache, partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hypogoal.core.compute import prepare
from hypogoal.core.progress import Progress
from hypogoal.core.seeding import rng_for, seed_for
from hypogoal.dataset import Collected
from hypogoal.domains.doorkey import DOMAIN, DoorKeyConfig
from hypogoal.domains.doorkey_engine import DoorKeyEngine
from hypogoal.evaluation.recorded import density_of, disagreement, sketches_of, to_label
from hypogoal.hypotheses.config import EnsembleConfig
from hypogoal.hypotheses.ensemble import Ensemble
from hypogoal.hypotheses.training import fit
from studies.cells import Jobs, Row, difference, parser_of, printed, read_rows, run_cells, table

SUB_GOALS = ("collect-red-key", "collect-blue-key")
BUDGETS = (0, 10, 20, 40, 80, 160)
FIRST, POOL, STEPS = 200, 4_000, 150
FOOLED, THERE = 0.02, 0.9  # at most, at least, of the layouts
LATE = 2  # steps behind the nearest true state that a policy still looks for a positive
KEYS = ("sub_goal", "way", "seed", "step")  # a step is a number of labels
ENDS = ("fooled", "there", "fooled_strictest", "there_strictest")  # by the mean of members, and by all of them
COLUMNS = (*KEYS, "positives", *ENDS)


class Places(NamedTuple):
    """Layouts to train on besides layout 0, and to be judged on."""

    pool: range
    judged: range


PLACES = {"choice": Places(range(11, 21), range(500, 600)), "test": Places(range(1, 11), range(1000, 1100))}
WAYS = {  # members, objective, who picks
    "next": (3, "dbat", "next"),  # as the audit picks: members disagree, and there are many such states
    "disagreement": (3, "dbat", "disagreement"),  # without the latter
    "random": (3, "dbat", "random"),
    "uncertain": (3, "dbat", "uncertain"),
    "single-random": (1, "none", "random"),
    "single-uncertain": (1, "none", "uncertain"),
}


class Course(NamedTuple):
    """The states of one layout that a policy can be in before, and little after, the sub-goal may first hold."""

    observations: NDArray[np.uint8]  # (N, 64, 64, 3), each once
    steps: NDArray[np.int64]  # (N,), from the start
    labels: NDArray[np.bool_]  # (N,), the truth


@lru_cache(maxsize=1)
def states_of(layouts: str) -> Collected:
    """The labelled states of layout 0, and those of the pool's layouts."""
    config = DoorKeyConfig(unlabelled_seeds=tuple(PLACES[layouts].pool), heldout_layouts=1)
    return DOMAIN.collect(config, 0, Progress("collect", 1, quiet=True))


@lru_cache(maxsize=2)
def courses_of(layouts: str, sub_goal: str) -> list[Course]:
    """One for each layout to be judged on in which the sub-goal can be reached."""
    column, courses = DOMAIN.sub_goals.index(sub_goal), []
    for seed in PLACES[layouts].judged:
        engine = DoorKeyEngine(seed)
        ids, steps = engine.distances()
        labels = engine.labels(ids)[:, column]
        if labels.any():
            near = steps <= steps[labels].min() + LATE
            courses.append(Course(engine.images(ids[near]), steps[near], labels[near]))
    return courses


def ends(positive: NDArray[np.bool_], course: Course) -> tuple[float, float]:
    """Where a policy ends that takes a shortest way to a positive prediction (N,): the shares of false positives and of
    true states among those that are nearest. Both are 0 where it finds none.
    """
    if not positive.any():
        return 0.0, 0.0
    nearest = positive & (course.steps == course.steps[positive].min())
    there = float(course.labels[nearest].mean())
    return 1 - there, there


def pick(picked: str, ensemble: Ensemble, states: NDArray[np.uint8], count: int, seed: int) -> NDArray[np.int64]:
    """The rows (count,) of the pool (N, 64, 64, 3) to label next."""
    if picked == "random":
        return rng_for(seed, "labels-next", len(states)).choice(len(states), count, replace=False)
    probabilities = ensemble.predict(states)
    if picked == "uncertain":
        return np.argsort(np.abs(probabilities.mean(1) - 0.5), kind="stable")[:count]
    scores, sketches = disagreement(probabilities, ensemble.thresholds.cpu().numpy()), sketches_of(states)
    return to_label(scores * density_of(sketches) if picked == "next" else scores, sketches, count)


def run_cell(layouts: str, way: str, sub_goal: str, seed: int) -> list[Row]:
    """Pick, label and train up to the last budget; where a policy would end after each."""
    prepare()
    members, objective, picked = WAYS[way]
    data, column = states_of(layouts), DOMAIN.sub_goals.index(sub_goal)
    pool = rng_for(seed, "labels-next", "pool").choice(len(data.unlabelled.labels), POOL, replace=False)
    states, truth = data.unlabelled.observations[pool], data.unlabelled.labels[pool, column]
    first = rng_for(seed, "labels-next", "first").choice(len(data.labelled.labels), FIRST, replace=False)
    known, labels = data.labelled.observations[first], data.labelled.labels[first, column]
    config = EnsembleConfig(steps=STEPS, members=members, diversity=objective)
    labelled, rows = np.zeros(POOL, np.bool_), []
    ensemble: Ensemble | None = None
    for budget in BUDGETS:
        if ensemble is not None:
            rest = np.flatnonzero(~labelled)
            labelled[rest[pick(picked, ensemble, states[rest], budget - int(labelled.sum()), seed)]] = True
        ensemble = fit(
            np.concatenate([known, states[labelled]]),
            np.concatenate([labels, truth[labelled]]),
            states[~labelled],
            config,
            seed_for(seed, "ensemble", sub_goal),
        )
        ended = np.mean([_ends_of(ensemble, course) for course in courses_of(layouts, sub_goal)], axis=0)
        place = dict(zip(KEYS, (sub_goal, way, seed, budget), strict=True))
        rows.append(place | {"positives": int(truth[labelled].sum())} | dict(zip(ENDS, ended.tolist(), strict=True)))
    return rows


def _ends_of(ensemble: Ensemble, course: Course) -> tuple[float, ...]:
    probabilities = ensemble.predict(course.observations)
    return (*ends(probabilities.mean(1) > 0.5, course), *ends(probabilities.min(1) > 0.5, course))


def labels_needed(ended: Mapping[int, tuple[float, float]]) -> int:
    """The fewest labels from which on a policy is fooled at most ``FOOLED`` and there at least ``THERE`` of the time.

    ``ended`` are both shares by budget; twice the last budget where even that does not suffice.
    """
    needed = 2 * max(ended)
    for budget in sorted(ended, reverse=True):
        fooled, there = ended[budget]
        if fooled > FOOLED or there < THERE:
            break
        needed = budget
    return needed


def tables(path: Path) -> Iterator[str]:
    """What the cells say, as lines of Markdown."""
    rows = read_rows(path)
    for by, what in (("_strictest", "all members are positive"), ("", "their mean is positive")):
        ways = {way: _by_cell(rows, way, by) for way in WAYS}
        seeds = [
            seed for seed in range(100) if all({(goal, seed) for goal in SUB_GOALS} <= set(of) for of in ways.values())
        ]
        if not seeds:
            continue
        needed = {way: np.array([_needed(of, seed) for seed in seeds]) for way, of in ways.items()}
        yield f"Paid where {what}: episodes that end in a false positive / there, {len(seeds)} seeds."
        yield ""
        yield from table(
            ["", *(f"{budget} labels" for budget in BUDGETS), "labels needed", "halvings against random"],
            (
                [
                    way,
                    *(_shares(of, seeds, budget) for budget in BUDGETS),
                    f"{2 ** needed[way].mean():.0f}",
                    "-" if way == "random" else difference(needed["random"] - needed[way], 1),
                ]
                for way, of in ways.items()
            ),
        )


Ended = dict[tuple[str, int], dict[int, tuple[float, float]]]  # by sub-goal and seed, and by budget: fooled, there


def _by_cell(rows: list[dict[str, str]], way: str, by: str) -> Ended:
    ended: Ended = {}
    for row in rows:
        if row["way"] == way:
            cell = ended.setdefault((row["sub_goal"], int(row["seed"])), {})
            cell[int(row["step"])] = float(row[f"fooled{by}"]), float(row[f"there{by}"])
    return ended


def _needed(ended: Ended, seed: int) -> float:
    """The binary logarithm of the labels needed, mean over sub-goals; less than ten count as five."""
    return float(np.mean([np.log2(max(5, labels_needed(ended[goal, seed]))) for goal in SUB_GOALS]))


def _shares(ended: Ended, seeds: list[int], budget: int) -> str:
    fooled, there = np.mean([ended[goal, seed][budget] for goal in SUB_GOALS for seed in seeds], axis=0)
    return f"{fooled:.2f} / {there:.2f}"


def main() -> None:
    """Run the cells that are not in the file yet."""
    parser = parser_of(__doc__, "0-9")
    parser.add_argument("--layouts", choices=tuple(PLACES), default="test", help="to be judged on")
    parser.add_argument("--ways", default=",".join(WAYS), help="comma-separated; all by default")
    arguments = parser.parse_args()
    if printed(arguments, tables):
        return
    jobs: Jobs = {
        (sub_goal, way, str(seed)): partial(run_cell, arguments.layouts, way, sub_goal, seed)
        for seed in arguments.seeds
        for sub_goal in SUB_GOALS
        for way in arguments.ways.split(",")
    }
    run_cells(arguments.csv, COLUMNS, KEYS[:3], jobs, lambda _: BUDGETS, arguments.workers)


if __name__ == "__main__":
    main()
