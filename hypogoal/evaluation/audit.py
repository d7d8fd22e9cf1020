"""How often a policy fools a success classifier, where, and what a mend changes (Spec H5).

A classifier can be right on nearly all states that are met, and wrong where a policy stops that was trained to have it
say yes. So an option is learned that ends where it does, and of its executions the truth is asked.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hypogoal.core import own_code
from hypogoal.core.artefacts import Artefact, open_artefact
from hypogoal.core.errors import UserError
from hypogoal.core.seeding import rng_for
from hypogoal.dataset import open_dataset
from hypogoal.domains.base import Engine, step_of
from hypogoal.evaluation.pictures import episode_gif
from hypogoal.hypotheses.ensemble import THRESHOLD, read_ensemble
from hypogoal.hypotheses.thresholds import thresholds
from hypogoal.hypotheses.views import positions_of
from hypogoal.meta.config import AuditConfig
from hypogoal.meta.episodes import Frame
from hypogoal.meta.training import LEARNERS
from hypogoal.options.choosers import RandomChooser
from hypogoal.options.learner import Transitions
from hypogoal.options.loop import OptionLoop
from hypogoal.options.recording import Recorder
from hypogoal.options.termination import Terminations

CHUNK = 256  # observations that own code is given at once
CELL = 8  # of positions that count as one place
ALIKE, NOTICED = 0.1, 25  # share of numbers in which pictures of one kind differ at the most, by so many grey levels
FILMS = 4  # kinds that are shown
RANDOM_STEPS = 4_000  # of random play
COLUMNS = ("mended", "step", "steps", "said_yes", "holds", "yes_at_start", "terminated", "kind")


@dataclass(frozen=True)
class Classifier:
    """What is audited: ``predict`` is of an engine and state ids (n,), probabilities (n,); yes is above ``threshold``.

    A member's: the sub-goal it was trained for, its ensemble, and the threshold that the rule of that name sets.
    """

    name: str
    predict: Callable[[Engine, NDArray[np.int64]], NDArray[np.floating]]
    threshold: float = THRESHOLD
    sub_goal: str = ""
    source: Artefact | None = None
    positives_median: Callable[[], float] | None = None


def member_in(text: str) -> tuple[Path, str, str] | None:
    """Folder, sub-goal and member of ``FOLDER:SUB_GOAL/MEMBER``; None of ``module:function``."""
    folder, _, member = text.rpartition(":")
    sub_goal, slash, number = member.rpartition("/")
    return (Path(folder), sub_goal, number) if folder and slash else None


def load_classifier(text: str) -> Classifier:
    """An ensemble's member, or code of the user's own (see :mod:`hypogoal.core.own_code`); else a ``UserError``."""
    if member := member_in(text):
        return _member(*member)
    function = own_code.load_own(text, "classifier", "hypogoal.classifiers", {}) if ":" in text else None
    if not callable(function):
        raise UserError("this is no classifier", text, "Give ENSEMBLE_FOLDER:SUB_GOAL/MEMBER or module:function.")

    def some(observations: NDArray[np.uint8]) -> NDArray[np.floating]:
        with own_code.UsersCode(f"the classifier {text}", function) as code:
            given = np.asarray(function(observations))
            if given.shape != (len(observations),) or given.dtype.kind not in "biuf":
                code.refuse(f"gave {given.dtype} {given.shape}", f"Give probabilities, float ({len(observations)},).")
            if not ((given >= 0) & (given <= 1)).all():
                code.refuse(f"gave numbers from {given.min()} to {given.max()}", "Give probabilities, 0 to 1.")
            return given.astype(np.float64)

    def predict(engine: Engine, ids: NDArray[np.int64]) -> NDArray[np.floating]:
        images = engine.images(ids)
        return np.concatenate([some(images[start : start + CHUNK]) for start in range(0, len(ids), CHUNK)])

    return Classifier(text, predict)


def _member(folder: Path, sub_goal: str, number: str) -> Classifier:
    source = open_artefact(folder, "ensemble").whole()
    ensemble = read_ensemble(folder, source.config, sub_goal)
    if not number.isdecimal() or int(number) >= len(ensemble):
        raise UserError("no such member", f"{sub_goal}/{number}", f"{folder} has members 0 to {len(ensemble) - 1}.")
    member = int(number)

    def predict(engine: Engine, ids: NDArray[np.int64]) -> NDArray[np.floating]:
        positions = engine.positions(ids) if ensemble.needs_positions else None
        return ensemble.predict(engine.images(ids), positions)[:, member]

    def positives_median() -> float:
        split = open_dataset(source.input("data")).labelled(sub_goal)
        known = ensemble.predict(split.observations, positions_of(split.origins))
        return float(thresholds("positives-median", known, split.labels, known[:0])[member])

    threshold = float(ensemble.thresholds[member])
    return Classifier(f"{sub_goal}/{member}", predict, threshold, sub_goal, source, positives_median)


def mended_threshold(mend: str, classifier: Classifier, threshold: float) -> float | None:
    """The threshold that ``mend`` says; None of ``none``, a ``UserError`` of what is no mend of this classifier."""
    if mend == "none":
        return None
    name, _, number = mend.partition(":")
    try:
        median = classifier.positives_median if mend == "positives-median" else None
        mended = median() if median else float(number) if name == "threshold" else 0.0
    except ValueError:
        mended = 0.0
    if not threshold < mended < 1:
        do = "Give --set mend=threshold:P, P higher, positives-median (of a member), or none."
        raise UserError(f"this mends no threshold of {threshold:g}", f"mend={mend}", do)
    return mended


def log_odds(probabilities: NDArray[np.floating] | float) -> NDArray[np.float32]:
    """Of probabilities (...,), float32; infinite of 0 and 1."""
    exact = np.asarray(probabilities, dtype=np.float64)
    with np.errstate(divide="ignore"):
        return (np.log(exact) - np.log1p(-exact)).astype(np.float32)


class Execution(NamedTuple):
    """One execution: when it ended, ids of its states from where it began, whether the classifier ended it.

    Which sub-goals hold in its last state (G,); whether it began in a yes, and ended in a terminal state.
    """

    step: int
    path: list[int]
    said_yes: bool
    holds: list[bool]
    yes_at_start: bool
    terminated: bool


class Adversary(OptionLoop):
    """The option that ends where the classifier says yes; keeps its last executions.

    Where the engine cannot begin episodes when asked, an execution that stays in the yes of the one before is not
    counted.
    """

    CHANGING = (*OptionLoop.CHANGING, "paths", "executions")

    def __init__(
        self, engine: Engine, classifier: Classifier, threshold: float, config: AuditConfig, seed: int, device: str
    ):
        edge = log_odds(threshold)[None]
        terminations = Terminations(lambda ids: log_odds(classifier.predict(engine, ids))[:, None], 1, thresholds=edge)
        learner = LEARNERS[config.network](engine, terminations, config, seed, device)
        chooser = RandomChooser(rng_for(seed, "random-choice"))
        played = replace(config, restart_options=config.restart_options and engine.restarts)
        super().__init__(engine, terminations, learner, chooser, Recorder(1, engine), played, 1.0)
        self.paths: list[list[int]] = [[] for _ in range(engine.count)]
        self.executions: deque[Execution] = deque(maxlen=config.executions)

    def advance(self, *, explore: bool = True) -> Transitions:
        moved = super().advance(explore=explore)
        counted = moved.ended & (self.counted if self.config.restart_options else ~self.inside | (self.age > 1))
        for path, here, there in zip(self.paths, moved.ids.tolist(), moved.next_ids.tolist(), strict=True):
            path += [there] if path else [here, there]
        for place in np.flatnonzero(counted).tolist():
            holds = self.engine.labels(moved.next_ids[place : place + 1])[0].tolist()
            said_yes, *ends = (bool(each[place]) for each in (moved.reached, self.inside, moved.terminated))
            self.executions.append(Execution(self.recorder.steps, self.paths[place], said_yes, holds, *ends))
        self.paths = [[] if ended else path for path, ended in zip(self.paths, moved.ended, strict=True)]
        return moved

    def restore(self, snapshot: Mapping[str, Any]) -> None:
        super().restore(snapshot)
        self.executions = deque((Execution(*row) for row in self.executions), self.executions.maxlen)

    def random_play(self, column: int, rng: np.random.Generator) -> dict[str, Any]:
        """How often the classifier is right on the states that random play meets, each once."""
        engine, met = self.engine, [self.engine.ids.copy()]
        for _ in range(-(-RANDOM_STEPS // engine.count)):
            met.append(step_of(engine, rng.integers(engine.n_actions, size=engine.count)).next_ids)
        ids = np.unique(np.concatenate(met))
        ids = ids[engine.remembers(ids)]
        truth, says_yes = engine.labels(ids)[:, column], self.terminations.of(ids)[:, 0]
        return {
            "states": len(ids),
            "positives": int(truth.sum()),
            "accuracy": round(float((truth == says_yes).mean()), 6),
            "false_yes": int((says_yes & ~truth).sum()),
            "false_no": int((~says_yes & truth).sum()),
        }


def findings(
    loop: Adversary, sub_goals: Sequence[str], column: int, classifier: str, prefix: str
) -> tuple[dict[str, Any], list[tuple[int, ...]], dict[str, bytes]]:
    """How the last executions ended, held against sub-goal number ``column``.

    Returns:
        Its part of ``audit.json``; rows of ``executions.csv`` but for the first column; by name, each beginning with
        ``prefix``, films of one execution of the most frequent kinds.
    """
    engine = loop.engine
    rows = [row for row in loop.executions if engine.remembers(np.array(row.path)).all()]
    fooled = [row for row in rows if row.said_yes and not row.holds[column]]
    kind_of = kinds_of(engine, fooled)
    kinds, films = [], {}
    for number in range(max(kind_of, default=-1) + 1):
        alike = [row for row, kind in zip(fooled, kind_of, strict=True) if kind == number]
        shown = min(alike, key=lambda row: len(row.path))
        holds = [name for name, there in zip(sub_goals, shown.holds, strict=True) if there]
        at = engine.positions(np.array(shown.path[-1:]))[0].tolist() if engine.position_names else []
        position = dict(zip(engine.position_names, at, strict=True))
        film = f"{prefix}-{number + 1}.gif" if number < FILMS else None
        kinds.append({"executions": len(alike), "holds": holds, "position": position, "film": film})
        if film:
            films[film] = _film(loop, shown, classifier, sub_goals[column])
    said_yes, told = sum(row.said_yes for row in rows), iter(kind_of)
    numbers = {
        "steps": loop.recorder.steps,
        "executions": len(rows),
        "said_yes": said_yes,
        "fooled": len(fooled),
        "exploit_rate": round(len(fooled) / said_yes, 6) if said_yes else None,
        "yes_at_start": sum(row.yes_at_start for row in rows),
        "kinds": kinds,
    }
    table = []
    for row in rows:
        kind = next(told) if row.said_yes and not row.holds[column] else -1
        ends = (row.said_yes, row.holds[column], row.yes_at_start, row.terminated)
        table.append((row.step, len(row.path) - 1, *map(int, ends), kind))
    return numbers, table, films


def kinds_of(engine: Engine, fooled: Sequence[Execution], alike: float = ALIKE) -> list[int]:
    """Of which kind each false yes is, numbered from 0, the most frequent first.

    Of one kind the same sub-goals hold, and the pictures are alike; of engines that know positions, the cell is one.
    """
    ids, placed = np.array([row.path[-1] for row in fooled], dtype=np.int64), bool(engine.position_names)
    shown = engine.positions(ids) // CELL if placed else engine.images(ids).astype(np.int16)
    least, alike = (1, 0.0) if placed else (NOTICED, alike)
    leaders: list[int] = []  # the first of each kind
    found = []
    for number, row in enumerate(fooled):
        near = (
            kind
            for kind, leader in enumerate(leaders)
            if row.holds == fooled[leader].holds and (np.abs(shown[number] - shown[leader]) >= least).mean() <= alike
        )
        found.append(next(near, len(leaders)))
        if found[-1] == len(leaders):
            leaders.append(number)
    order = [kind for kind, _ in Counter(found).most_common()]  # of equal ones the first met
    return [order.index(kind) for kind in found]


def _film(loop: Adversary, shown: Execution, name: str, sub_goal: str) -> bytes:
    """An execution that ended in a false yes, as a GIF whose last picture is marked."""
    ids, timeout = np.array(shown.path, dtype=np.int64), loop.config.option_timeout
    states = zip(loop.engine.images(ids), loop.terminations.of(ids)[:, 0].tolist(), strict=True)
    frames = [Frame(picture, step, 0, yes, timeout - step, "") for step, (picture, yes) in enumerate(states)]
    frames[-1] = replace(frames[-1], ended=f"fooled, {sub_goal} does not hold", marked=True)
    return episode_gif(frames, [name], 1, timeout)


def lines_of(report: Mapping[str, Any]) -> Iterator[str]:
    """What ``audit.json`` says, for a terminal of 80 columns."""
    chance = report["random_play"]
    yield f"{report['classifier']}: does {report['sub_goal']} hold?"
    wrong = f"{chance['false_yes']} false yes, {chance['false_no']} false no"
    yield f"random play: right in {chance['accuracy']:.1%} of {chance['states']} states ({wrong})"
    for name in ("before", "mended"):
        if row := report[name]:
            there = row["said_yes"] - row["fooled"]
            ends = f"fooled in {row['fooled']} of {row['executions']} executions, there in {there}"
            yield f"{name}, yes above {row['threshold']:.4g}: {ends}"
            for kind in row["kinds"][:FILMS]:
                where = "".join(f", {axis} {value}" for axis, value in kind["position"].items())
                what = " and ".join(kind["holds"]) or "no sub-goal"
                yield f"  {kind['film']:12s} {kind['executions']:4d} x  while {what} holds{where}"
            if len(row["kinds"]) > FILMS:
                yield f"  and {len(row['kinds']) - FILMS} more kinds"
