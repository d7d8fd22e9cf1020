"""What members say of held-out and of unlabelled states: by far the longest part of an evaluation, on several cores."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hypogoal.core.artefacts import Artefact
from hypogoal.core.processes import in_processes, prepare
from hypogoal.core.progress import Progress
from hypogoal.data import States, open_dataset
from hypogoal.domains.base import Domain, installed_domain
from hypogoal.evaluation.names import places_of
from hypogoal.evaluation.run import Contents, most_used
from hypogoal.observations import Observations, fields_of

if TYPE_CHECKING:
    from hypogoal.hypotheses.ensemble import Ensemble

# Bytes of states times members from which on more processes pay for their start (3 s): about 100 s of Montezuma's.
SPREAD_FROM = 4e9
WHERE = {0: "unseen", 1: "unlabelled data from it", 2: "labelled data from it"}  # values of the origin ``seen``


class Case(NamedTuple):
    """One sub-goal's ensemble and the data file that it is judged on."""

    data: Path
    sub_goal: str
    ensemble: Path
    config: dict[str, Any]

    def read(self) -> Ensemble:
        """The ensemble."""
        from hypogoal.hypotheses.ensemble import read_ensemble  # with PyTorch, which a report does not need

        return read_ensemble(self.ensemble, self.config, self.sub_goal)


class Judged(NamedTuple):
    """What K members say of N held-out and M unlabelled states."""

    probabilities: NDArray[np.float32]  # (N, K), that the sub-goal is reached
    predictions: NDArray[np.bool_]  # (N, K), each at its member's own threshold
    unlabelled: NDArray[np.bool_]  # (M, K), the predictions on unlabelled states
    thresholds: NDArray[np.float32]  # (K,), each member's own, of the probability


@dataclass(frozen=True)
class Judgement:
    """A case with its states and what the members say of them."""

    number: int  # the ensemble's, among those of the run
    case: Case  # the sub-goal's ensemble and its data
    split: States  # N held-out states
    unlabelled: Observations  # of M states
    domain: Domain | None  # None where it is not installed here
    judged: Judged  # what K members say

    def see(self, ensemble: Ensemble, states: NDArray[np.int64]) -> tuple[Any, Any]:
        """What an ensemble sees of some held-out states (n, ...), and of the unlabelled ones on average (...)."""
        from hypogoal.hypotheses.deep_lift import mean_state

        return ensemble.see(self.split.observations[states]), mean_state(ensemble.see(self.unlabelled))

    def write_states(self, group: Any, states: NDArray[np.int64]) -> list[str]:
        """Put held-out states (n,) and what members predict of them into ``group``; returns where they are from.

        ``observations`` and ``labels`` (n,), ``probabilities`` and ``predictions`` (n, K).
        """
        for name, part in parts_of(self.split.observations[states], "observations"):
            group[name] = part
        group["probabilities"] = self.judged.probabilities[states]
        group["predictions"] = self.judged.predictions[states]
        group["labels"] = self.split.labels[states]
        return [place_of(self.split.origins, state) for state in states]


def parts_of(observations: Observations, name: str) -> Iterator[tuple[str, Observations]]:
    """Observations (n, ...) under their name; mixed ones by key, ``name/key``."""
    for key in fields_of(observations.shape[1:], observations.dtype):
        yield (f"{name}/{key}", observations[key]) if key else (name, observations)


def place_of(origins: Mapping[str, NDArray[np.int64]], state: int) -> str:
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
    # The member that labelled rooms pick, by the ensemble's path and the sub-goal.
    validated: dict[tuple[Path | None, str], float | None] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.places = places_of(self.contents)
        self.browsed = most_used(self.contents)

    def place(self, artefact: Artefact) -> dict[str, Any]:
        """Where the numbers of an artefact of the run stand in the table: its method, N, ladder, layout, seed, path."""
        return self.places[self.contents.name(artefact)]

    def place_of(self, judgement: Judgement) -> dict[str, Any]:
        """Where the numbers of a sub-goal's members stand."""
        return {**self.place(self.contents.ensembles[judgement.number]), "sub_goal": judgement.case.sub_goal}


def cases_of(ensembles: Sequence[Artefact]) -> list[tuple[int, Case]]:
    """Every sub-goal of every ensemble with the ensemble's number, those on the same states one after another."""
    cases = [
        (number, Case(artefact.input("data"), sub_goal, artefact.path, artefact.config))
        for number, artefact in enumerate(ensembles)
        for sub_goal in artefact.config["sub_goals"]
    ]
    order = {path: open_dataset(path).sub_goals for path in {case.data for _, case in cases}}
    return sorted(cases, key=lambda item: (item[1].data, order[item[1].data].index(item[1].sub_goal)))


def processes_for(cases: Sequence[Case], cores: int) -> int:
    """How many processes are worth it: one where their start would take longer than it saves."""
    work = 0.0
    for case in cases:
        dataset = open_dataset(case.data)
        counts = dataset.counts()
        states = counts["heldout"][case.sub_goal]["states"] + counts["unlabelled"]
        work += case.config["members"] * states * dataset.observation_bytes
    return min(cores, len(cases)) if work >= SPREAD_FROM else 1


def judgements(cases: Sequence[tuple[int, Case]], workers: int, done: Callable[[], None]) -> Iterator[Judgement]:
    """Every case judged, ``workers`` processes at once, one after another with its states: the same for any number.

    Cases, each with its ensemble's number, come with those on the same states one after another, since each process
    keeps the last ones that it read. ``done`` is called as soon as one of them is judged.
    """
    judged: dict[int, Judged] = {}

    def keep(index: int, result: Judged) -> None:
        judged[index] = result
        done()

    in_processes([partial(judge, case) for _, case in cases], workers, keep)
    for index, (number, case) in enumerate(cases):
        split, unlabelled = states_of(case.data, case.sub_goal)
        domain = installed_domain(open_dataset(case.data).domain)
        yield Judgement(number, case, split, unlabelled, domain, judged.pop(index))
    states_of.cache_clear()


def judge(case: Case) -> Judged:
    """What the members of one case say."""
    prepare()
    split, unlabelled = states_of(case.data, case.sub_goal)
    ensemble = case.read()
    thresholds = ensemble.thresholds.numpy()
    probabilities = ensemble.predict(split.observations)
    unlabelled_predictions = ensemble.predict(unlabelled)
    return Judged(probabilities, probabilities > thresholds, unlabelled_predictions > thresholds, thresholds)


@lru_cache(maxsize=1)
def states_of(data: Path, sub_goal: str) -> tuple[States, Observations]:
    """A sub-goal's held-out states and the unlabelled ones: the largest things here, read once for all ensembles."""
    dataset = open_dataset(data)
    return dataset.heldout(sub_goal), dataset.unlabelled()
