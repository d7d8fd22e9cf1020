"""What members say of held-out and unlabelled states: by far the longest part of an evaluation, on several cores."""

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from hypogoal.core.arrays import Bools, Floats, Ints
from hypogoal.core.artefacts import Artefact
from hypogoal.core.processes import cores, in_processes, prepare
from hypogoal.core.progress import Progress
from hypogoal.data import States, open_dataset
from hypogoal.evaluation.names import places_of, rank
from hypogoal.evaluation.run import Contents, takes
from hypogoal.observations import Observations

SPREAD_FROM = 4e9  # bytes of states times members; from here on, processes that start in 3 s save time
WHERE = {0: "unseen", 1: "unlabelled data from it", 2: "labelled data from it"}  # values of the origin ``seen``


class Judged(NamedTuple):
    """What K members say of N held-out and M unlabelled states."""

    labels: Bools  # (N,)
    origins: Mapping[str, Ints]  # (N,) each: ``seen``, ``room``, ``layout_seed``, planted features
    probabilities: Floats  # (N, K), that the sub-goal is reached
    predictions: Bools  # (N, K), each at its member's own threshold
    unlabelled: Bools  # (M, K), the predictions on unlabelled states
    thresholds: Floats  # (K,), each member's own, of the probability


class Judgement(NamedTuple):
    """What the members of one sub-goal say."""

    artefact: Artefact  # the ensemble
    data: Path  # the file on whose states the ensemble is judged
    sub_goal: str
    judged: Judged


def place_of(origins: Mapping[str, Ints], state: int) -> str:
    """Return where a state is from, in words, or an empty text if no origin says it."""
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
    progress: Progress  # counts sub-goals judged and looked at, runs, and layouts that an agent plays
    layouts: tuple[int, ...] = ()  # on which trained agents are to play
    facts: dict[str, Any] = field(default_factory=dict)  # what is not a number, for ``run.json``
    validated: dict[Path, Any] = field(default_factory=dict)  # the member that labelled rooms pick for each sub-goal

    def __post_init__(self) -> None:
        self.places = places_of(self.contents)
        self.browsed = most_used(self.contents)

    def place(self, artefact: Artefact) -> dict[str, Any]:
        """Return an artefact's fields in the table of numbers: method, N, ladder, layout, seed, artefact."""
        return self.places[artefact.path]

    def place_of(self, judgement: Judgement) -> dict[str, Any]:
        """Return the fields in the table of a sub-goal's members."""
        return self.place(judgement.artefact) | {"sub_goal": judgement.sub_goal}

    def ranked(self, artefacts: list[Artefact]) -> list[Artefact]:
        """Return artefacts of the run, the paper's method first."""
        return sorted(artefacts, key=lambda artefact: rank(self.place(artefact)["method"]))

    def judgements(self) -> Iterator[Judgement]:
        """Judge every sub-goal of every ensemble, in any number of processes, and yield the judgements.

        The paper's method comes first. Ensembles on the same states are judged one after another, since each process
        keeps the last states that it read.
        """
        ranked = self.ranked(self.contents.ensembles)
        ensembles = [(artefact, self.contents.data_of[artefact.path]) for artefact in ranked]
        order = sorted(ensembles, key=lambda each: each[1])
        by_path = {}

        def keep(number: int, judged: dict[str, Judged]) -> None:
            artefact, _ = order[number]
            by_path[artefact.path] = judged
            self.progress.advance()

        tasks = [partial(judge, *each) for each in order]
        in_processes(tasks, processes_for(order), keep, forked=True)
        for artefact, data in ensembles:
            for sub_goal, judged in by_path.pop(artefact.path).items():
                yield Judgement(artefact, data, sub_goal, judged)
        states_of.cache_clear()


def most_used(contents: Contents) -> Path | None:
    """Return the path of the ensemble from which the most artefacts were learned, or None without ensembles.

    Only the ensembles with the most members count. Of several, the first is returned.
    """
    learned = filter(takes, [*contents.agents, *contents.ladders])
    users = Counter(artefact.input("ensemble").resolve() for artefact in learned)
    ranks = {}
    for artefact in contents.ensembles:
        ranks[artefact.path] = artefact.config["members"], users[artefact.path.resolve()]
    return max(ranks, key=ranks.__getitem__, default=None)


def processes_for(ensembles: list[tuple[Artefact, Path]]) -> int:
    """Return how many processes to use for ensembles on data files.

    It is one if the start of others would take longer than they save.
    """
    work = 0.0
    for artefact, data in ensembles:
        dataset = open_dataset(data)
        counts = dataset.counts()
        for sub_goal in artefact.config["sub_goals"]:
            states = counts["heldout"][sub_goal]["states"] + counts["unlabelled"]
            work += artefact.config["members"] * states * dataset.observation_bytes
    return cores() if work >= SPREAD_FROM else 1


def judge(artefact: Artefact, data: Path) -> dict[str, Judged]:
    """Return what each sub-goal's members of an ensemble say of the states in a data file, by sub-goal."""
    from hypogoal.hypotheses.ensemble import read_ensemble, together  # with PyTorch, which a report does not need

    prepare()
    heldout, unlabelled = states_of(data)
    sub_goals = artefact.config["sub_goals"]
    ensembles = [read_ensemble(artefact.path, artefact.config, sub_goal) for sub_goal in sub_goals]
    every = together(ensembles)

    def predicted(observations):
        if every is not None and all(each is observations[0] for each in observations):
            return np.split(every.predict(observations[0]), len(ensembles), axis=1)
        return [ensemble.predict(each) for ensemble, each in zip(ensembles, observations, strict=True)]

    on_heldout = predicted([heldout[sub_goal].observations for sub_goal in sub_goals])
    on_unlabelled = predicted([unlabelled] * len(sub_goals))
    judged = {}
    for sub_goal, ensemble, probabilities, others in zip(
        sub_goals,
        ensembles,
        on_heldout,
        on_unlabelled,
        strict=True,
    ):
        states, above = heldout[sub_goal], ensemble.thresholds.numpy()
        predictions = probabilities > above
        judged[sub_goal] = Judged(states.labels, states.origins, probabilities, predictions, others > above, above)
    return judged


@lru_cache(maxsize=1)
def states_of(data: Path) -> tuple[dict[str, States], Observations]:
    """Return every sub-goal's held-out states, and the unlabelled states.

    They are the largest things of an evaluation, so they are read once for all ensembles.
    """
    dataset = open_dataset(data)
    return dataset.all_heldout(), dataset.unlabelled()
