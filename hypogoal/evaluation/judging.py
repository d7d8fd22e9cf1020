"""What members say of held-out and of unlabelled states: by far the longest part of an evaluation, on several cores."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache, partial
from math import prod
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hypogoal.core.artefacts import Artefact
from hypogoal.core.compute import prepare
from hypogoal.core.workers import in_processes
from hypogoal.dataset import Split, open_dataset
from hypogoal.evaluation.shown import Unlabelled
from hypogoal.hypotheses.ensemble import Ensemble
from hypogoal.hypotheses.storage import read_ensemble
from hypogoal.hypotheses.views import positions_of

# Bytes of states times members from which on more processes pay for their start (3 s): about 100 s of Montezuma's.
SPREAD_FROM = 4e9


class Case(NamedTuple):
    """One sub-goal's ensemble and the data file that it is judged on."""

    data: Path
    sub_goal: str
    ensemble: Path
    config: dict[str, Any]

    def read(self) -> Ensemble:
        """The ensemble."""
        return read_ensemble(self.ensemble, self.config, self.sub_goal)


class Judged(NamedTuple):
    """What K members say of N held-out and M unlabelled states.

    Attributes:
        probabilities: float32 (N, K), that the sub-goal is reached.
        verdicts: bool (N, K), each at its member's own threshold.
        told: bool (M, K), the verdicts on unlabelled states.
    """

    probabilities: NDArray[np.float32]
    verdicts: NDArray[np.bool_]
    told: NDArray[np.bool_]


def cases_of(ensembles: Sequence[Artefact]) -> list[tuple[int, Case]]:
    """Every sub-goal of every ensemble with the ensemble's number, those on the same states one after another."""
    found = [
        (number, Case(artefact.input("data"), sub_goal, artefact.path, artefact.config))
        for number, artefact in enumerate(ensembles)
        for sub_goal in artefact.config["sub_goals"]
    ]
    order = {path: open_dataset(path).sub_goals for path in sorted({case.data for _, case in found})}
    paths = list(order)
    return sorted(found, key=lambda item: (paths.index(item[1].data), order[item[1].data].index(item[1].sub_goal)))


def processes_for(cases: Sequence[Case], cores: int) -> int:
    """How many processes are worth it: one where their start would take longer than it saves."""
    work = 0.0
    for case in cases:
        dataset = open_dataset(case.data)
        counts = dataset.counts()
        states = counts["heldout"][case.sub_goal]["states"] + counts["unlabelled"]
        work += case.config["members"] * states * prod(dataset.observation_shape)
    return min(cores, len(cases)) if work >= SPREAD_FROM else 1


def judge_all(cases: Sequence[Case], workers: int, done: Callable[[int], None]) -> list[Judged]:
    """Judge the cases, ``workers`` processes at once; the same numbers for any of those.

    Args:
        cases: those on the same states one after another, since each process keeps the last ones that it read.
        workers: processes.
        done: told the number of each case as soon as it is judged, in any order.
    """
    judged: list[Judged | None] = [None] * len(cases)

    def keep(number: int, result: Judged) -> None:
        judged[number] = result
        done(number)

    in_processes([partial(judge, case) for case in cases], workers, keep)
    states_of.cache_clear()
    return [result for result in judged if result is not None]


def judge(case: Case) -> Judged:
    """What the members of one case say."""
    prepare()
    split, unlabelled = states_of(case.data, case.sub_goal)
    ensemble = case.read()
    thresholds = ensemble.thresholds.numpy()
    probabilities = ensemble.predict(split.observations, positions_of(split.origins))
    told = ensemble.predict(unlabelled.observations, unlabelled.positions)
    return Judged(probabilities, probabilities > thresholds, told > thresholds)


@lru_cache(maxsize=1)
def states_of(data: Path, sub_goal: str) -> tuple[Split, Unlabelled]:
    """A sub-goal's held-out states and the unlabelled ones: the largest things here, read once for all ensembles."""
    dataset = open_dataset(data)
    return dataset.heldout(sub_goal), Unlabelled(dataset.unlabelled(), positions_of(dataset.unlabelled_origins()))
