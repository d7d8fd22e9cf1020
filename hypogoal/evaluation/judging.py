"""What members say of held-out and of unlabelled states: by far the longest part of an evaluation, on several cores."""

from __future__ import annotations

from collections import Counter
from collections.abc import (
    Callable,
    Iterator,
    Mapping,
)
from dataclasses import dataclass, field
from functools import lru_cache, partial
from pathlib import Path
from typing import (
    TYPE_CHECKING,
    Any,
    NamedTuple,
)

import numpy as np

from hypogoal.core.arrays import (
    Bools,
    Floats,
    Ints,
)
from hypogoal.core.artefacts import Artefact
from hypogoal.core.processes import (
    cores,
    in_processes,
    prepare,
)
from hypogoal.core.progress import Progress
from hypogoal.data import States, open_dataset
from hypogoal.evaluation.names import places_of, rank
from hypogoal.evaluation.run import Contents, takes
from hypogoal.observations import Observations

if TYPE_CHECKING:
    from hypogoal.hypotheses.ensemble import Ensemble

SPREAD_FROM = 4e9  # bytes of states times members from which on more processes pay where each starts in 3 s
WHERE = {0: "unseen", 1: "unlabelled data from it", 2: "labelled data from it"}  # values of the origin ``seen``


class Case(NamedTuple):
    """An ensemble artefact and the data file that it is judged on."""

    data: Path
    ensemble: Path
    config: dict[str, Any]

    def read(self, sub_goal: str) -> Ensemble:
        """The ensemble of a sub-goal."""
        from hypogoal.hypotheses.ensemble import read_ensemble  # with PyTorch, which a report does not need

        return read_ensemble(self.ensemble, self.config, sub_goal)


class Judged(NamedTuple):
    """What K members say of N held-out and M unlabelled states."""

    probabilities: Floats  # (N, K), that the sub-goal is reached
    predictions: Bools  # (N, K), each at its member's own threshold
    unlabelled: Bools  # (M, K), the predictions on unlabelled states
    thresholds: Floats  # (K,), each member's own, of the probability


@dataclass(frozen=True)
class Judgement:
    """What the members of one sub-goal say."""

    case: Case
    sub_goal: str
    split: States  # the held-out states' labels and origins, without the states
    judged: Judged


def place_of(origins: Mapping[str, Ints], state: int) -> str:
    """Where a state is from, in words; nothing where no origin says it."""
    if "layout_seed" in origins:
        return f"layout {origins['layout_seed'][state]}"
    if "room" not in origins:
        return ""
    seen = f" ({WHERE[int(origins['seen'][state])]})" if "seen" in origins else ""
    return f"room {origins['room'][state]}{seen}"


@dataclass
class Work:
    """What the questions' numbers are made from."""

    contents: Contents  # the run's artefacts
    arrays: Any  # ``arrays.h5``, to be written into
    progress: Progress  # is told of each sub-goal judged and looked at, each run, and each layout that one plays
    layouts: tuple[int, ...] = ()  # on which trained agents are to play
    facts: dict[str, Any] = field(default_factory=dict)  # what is not a number, for ``run.json``
    validated: dict[Path, Any] = field(default_factory=dict)  # the member that labelled rooms pick for each sub-goal

    def __post_init__(self) -> None:
        self.places = places_of(self.contents)
        self.browsed = most_used(self.contents)

    def place(self, artefact: Artefact) -> dict[str, Any]:
        """Where the numbers of an artefact of the run stand in the table: its method, N, ladder, layout, seed, path."""
        return self.places[artefact.path]

    def place_of(self, judgement: Judgement) -> dict[str, Any]:
        """Where the numbers of a sub-goal's members stand."""
        return {**self.places[judgement.case.ensemble], "sub_goal": judgement.sub_goal}

    def ranked(self, artefacts: list[Artefact]) -> list[Artefact]:
        """Some of the run's, the paper's method first."""
        return sorted(artefacts, key=lambda artefact: rank(self.place(artefact)["method"]))

    def cases(self) -> list[Case]:
        """Every ensemble, the paper's method first."""
        ensembles = self.ranked(self.contents.ensembles)
        return [Case(artefact.input("data"), artefact.path, artefact.config) for artefact in ensembles]


def most_used(contents: Contents) -> Path | None:
    """Which of the ensembles with the most members the most artefacts were learned from; the first of several."""
    learned = filter(takes, [*contents.agents, *contents.ladders])
    users = Counter(artefact.input("ensemble").resolve() for artefact in learned)
    ranks = {}
    for artefact in contents.ensembles:
        ranks[artefact.path] = artefact.config["members"], users[artefact.path.resolve()]
    return max(ranks, key=ranks.__getitem__, default=None)


def processes_for(cases: list[Case]) -> int:
    """How many processes are worth it: one where their start would take longer than it saves."""
    work = 0.0
    for case in cases:
        dataset = open_dataset(case.data)
        counts = dataset.counts()
        for sub_goal in case.config["sub_goals"]:
            states = counts["heldout"][sub_goal]["states"] + counts["unlabelled"]
            work += case.config["members"] * states * dataset.observation_bytes
    return cores() if work >= SPREAD_FROM else 1


def judgements(cases: list[Case], done: Callable[[], None]) -> Iterator[Judgement]:
    """Every sub-goal of every case judged, in any number of processes; ``done`` is called after each case.

    Those on the same states are judged one after another, since each process keeps the last ones that it read.
    """
    judged = {}
    order = sorted(cases, key=lambda case: case.data)

    def keep(index, result):
        judged[order[index].ensemble] = result
        done()

    tasks = [partial(judge, case) for case in order]
    in_processes(tasks, processes_for(cases), keep, forked=True)
    for case in cases:
        for sub_goal, (split, of_goal) in judged.pop(case.ensemble).items():
            yield Judgement(case, sub_goal, split, of_goal)
    states_of.cache_clear()


def judge(case: Case) -> dict[str, tuple[States, Judged]]:
    """Each sub-goal's held-out labels and origins, and what its members say."""
    from hypogoal.hypotheses.ensemble import together

    prepare()
    heldout, unlabelled = states_of(case.data)
    sub_goals = case.config["sub_goals"]
    ensembles = [case.read(sub_goal) for sub_goal in sub_goals]
    every = together(ensembles)

    def predicted(observations):
        if every is not None and all(each is observations[0] for each in observations):
            return np.split(every.predict(observations[0]), len(ensembles), axis=1)
        return [ensemble.predict(each) for ensemble, each in zip(ensembles, observations, strict=True)]

    on_heldout = predicted([heldout[sub_goal].observations for sub_goal in sub_goals])
    on_unlabelled = predicted([unlabelled] * len(sub_goals))
    judged = {}
    for sub_goal, ensemble, probabilities, others in zip(sub_goals, ensembles, on_heldout, on_unlabelled, strict=True):
        states = heldout[sub_goal]
        above = ensemble.thresholds.numpy()
        split = States(states.observations[:0].copy(), states.labels, states.origins)
        judged[sub_goal] = split, Judged(probabilities, probabilities > above, others > above, above)
    return judged


@lru_cache(maxsize=1)
def states_of(data: Path) -> tuple[dict[str, States], Observations]:
    """Every sub-goal's held-out states, and the unlabelled ones: the largest things here, read once for all."""
    dataset = open_dataset(data)
    return dataset.all_heldout(), dataset.unlabelled()
