"""How often policies fool a success classifier, and where (Spec H5).

A classifier can be right in nearly all states that are met, and wrong where a policy stops that was trained to reach
its positive predictions. So options are learned that end at these, and the truth of each of their executions is looked
up.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hypogoal.core.artefacts import open_artefact
from hypogoal.core.errors import UserError
from hypogoal.core.own_code import load
from hypogoal.domains.base import Engine
from hypogoal.evaluation.exploits import COLUMNS, TABLE, option_numbers
from hypogoal.evaluation.films import episode_gif
from hypogoal.evaluation.selection import states_met
from hypogoal.hypotheses.ensemble import THRESHOLD, Ensemble, read_ensemble
from hypogoal.hypotheses.scores import member_scores
from hypogoal.hypotheses.thresholds import log_odds_of
from hypogoal.meta.episodes import Frame
from hypogoal.meta.setup import Setup
from hypogoal.observations import PICTURE, Standard, standard_of
from hypogoal.options.loop import OptionLoop
from hypogoal.options.recording import Execution
from hypogoal.options.tables import read_table
from hypogoal.options.termination import Terminations, rule_of

POLICIES = ("before", "mended")
CHUNK = 256  # observations that own code is given at once
CELL = 8  # of positions that count as one place
FILMS = 4  # kinds that are shown
RANDOM_STEPS = 4_000  # of random play
Classifier = Callable[[Engine, NDArray[np.int64]], NDArray[np.floating]]  # state ids (n,) -> log-odds (n,)


def own_classifier(name: str) -> Classifier:
    """Code of the user's own, from observations (n, *obs) to probabilities (n,); else a ``UserError``."""
    function = load(name, "classifier", "hypogoal.classifiers", {})
    if not callable(function):
        raise UserError("this is not a function", name, "Give one from observations (N, *obs) to probabilities (N,).")

    def classify(engine: Engine, ids: NDArray[np.int64]) -> NDArray[np.floating]:
        log_odds = []
        for some in np.split(ids, range(CHUNK, len(ids), CHUNK)):
            probabilities = np.asarray(function(engine.images(some)), dtype=np.float64)
            if probabilities.shape != some.shape or not ((probabilities >= 0) & (probabilities <= 1)).all():
                fault = f"the classifier gave {probabilities.shape} {probabilities.ravel()[:3]}"
                raise UserError(fault, name, f"Give probabilities, 0 to 1, float ({len(some)},).")
            log_odds.append(log_odds_of(probabilities))
        return np.concatenate(log_odds)

    return classify


def member_of(ensemble: Ensemble, member: int) -> Classifier:
    """A member of an ensemble; a ``UserError`` where there is no such one."""
    if member >= len(ensemble):
        raise UserError("the ensemble has no such member", member, f"Give --member, 0 to {len(ensemble) - 1}.")

    def classify(engine: Engine, ids: NDArray[np.int64]) -> NDArray[np.floating]:
        return ensemble.log_odds(engine.images(ids))[:, member]

    return classify


@dataclass(frozen=True)
class Target:
    """A classifier to audit."""

    classify: Classifier
    threshold: float  # the probability above which its prediction is positive
    standard: Standard | None = None  # of observations that are no pictures; None: unknown
    domain_config: Mapping[str, Any] = field(default_factory=dict)  # of the world that its data were collected in
    inputs: Sequence[Path] = ()


def target_of(name: str, sub_goal: str, member: int, domain: str, device: str) -> Target:
    """A member of an ensemble artefact, or ``module:function``; anything else is a ``UserError``."""
    if ":" in name and not Path(name).is_dir():
        return Target(own_classifier(name), THRESHOLD)
    source = open_artefact(Path(name), "ensemble")
    ensemble = read_ensemble(source.path, source.config, sub_goal).to(device)
    classify, threshold = member_of(ensemble, member), float(ensemble.thresholds[member])
    world = source.config["domain_config"] if source.config["domain"] == domain else {}
    return Target(classify, threshold, ensemble.view.standard, world, [source.path])


def terminations_of(target: Target, edges: NDArray[np.float64]) -> Callable[[Setup, Engine], Terminations]:
    """A function of an engine: options that end at a classifier's positives, one for each threshold (K,)."""

    def ends(setup: Setup, engine: Engine) -> Terminations:
        def log_odds(ids: NDArray[np.int64]) -> NDArray[np.float32]:
            return np.repeat(target.classify(engine, ids)[:, None], len(edges), axis=1).astype(np.float32)

        if engine.observation_dtype != PICTURE:
            engine.standard = target.standard or standard_of(engine.observation_shape)
        rule, length = rule_of(setup.config.termination)
        rule.refuse(setup.config, engine)
        return rule(log_odds, len(edges), None, log_odds_of(edges).astype(np.float32), engine.count, length)

    return ends


def report_of(loop: OptionLoop, edges: Sequence[float], sub_goals: Sequence[str], folder: Path) -> dict[str, Any]:
    """Each policy's findings, and the threshold that it learned against; None for a policy that was not wanted."""
    table = read_table(folder / TABLE, COLUMNS)
    report: dict[str, Any] = dict.fromkeys(POLICIES)
    for option, (name, edge) in enumerate(zip(POLICIES, edges, strict=False)):
        ended = float(1 / (1 + np.exp(-loop.terminations.thresholds[option])))  # a rule may have changed it
        threshold = edge if math.isclose(ended, edge, rel_tol=1e-6) else ended  # float32 log-odds round it
        report[name] = {"threshold": threshold, **findings(loop, table, option, sub_goals, folder)}
    return report


def random_play(loop: OptionLoop, column: int, rng: np.random.Generator) -> dict[str, Any]:
    """The classifier's scores, of sub-goal number ``column``, on the states that random actions lead to, each once."""
    engine = loop.engine
    engine.reset()
    ids = states_met(engine, RANDOM_STEPS, rng)
    ids = ids[engine.remembers(ids)]
    truth, positive = engine.labels(ids)[:, column], loop.terminations.of(ids)[:, :1]
    scores = {name: score.item() for name, score in member_scores(positive, truth).items()}
    return {"states": len(ids), "positives": int(truth.sum()), **scores}


def findings(
    loop: OptionLoop, table: dict[str, NDArray[np.float64]], option: int, sub_goals: Sequence[str], folder: Path
) -> dict[str, Any]:
    """How the last executions of a policy ended, by their ``exploits.csv``: its part of ``audit.json``.

    False positives are of one kind where the same sub-goals hold and, where positions are known, the cell is the same;
    of each of the most frequent kinds a film of the shortest execution is put into ``folder``, of pictures.
    """
    engine, of_policy, rows = loop.engine, table["option"] == option, list(loop.recorder.executions[option])
    positive, near = table["reached"][of_policy] > 0, table["near"][of_policy] > 0
    fooled = [row for row, wrong in zip(rows, positive & ~near, strict=True) if wrong]

    def kind_of(row: Execution) -> tuple[tuple[str, ...], tuple[int, ...]]:
        end = np.array(row.states[-1:])
        cell = engine.positions(end)[0] // CELL if engine.position_names else np.zeros(0, dtype=np.int64)
        return tuple(np.array(sub_goals)[engine.labels(end)[0]].tolist()), tuple(cell.tolist())

    of_kind: dict[Any, list[Execution]] = {}
    for row in fooled:
        of_kind.setdefault(kind_of(row), []).append(row)
    kinds: list[dict[str, Any]] = []
    for (holds, _), alike in sorted(of_kind.items(), key=lambda item: -len(item[1])):
        row = min(alike, key=lambda row: row.duration)
        path = np.array([row.began, *row.states])
        at = engine.positions(path[-1:])[0].tolist() if engine.position_names else []
        film = f"{POLICIES[option]}-{len(kinds) + 1}.gif"
        pictures = engine.observation_dtype == PICTURE
        if shown := pictures and len(kinds) < FILMS and bool(engine.remembers(path).all()):
            (folder / film).write_bytes(_film(loop, path, option))
        description = {"holds": holds, "position": dict(zip(engine.position_names, at, strict=True))}
        kinds.append({"executions": len(alike), **description, "film": film if shown else None})
    ends = {"fooled": len(fooled), "there": int((positive & near).sum())}
    ends["positive_at_start"] = sum(row.inside_at_start for row in rows)
    return option_numbers(table, option) | ends | {"kinds": kinds}


def _film(loop: OptionLoop, path: NDArray[np.int64], option: int) -> bytes:
    """An execution that ended in a false positive, from where it began."""
    timeout = loop.config.option_timeout
    states = zip(loop.engine.images(path), loop.terminations.of(path)[:, option].tolist(), strict=True)
    frames = [
        Frame(picture, step, option, (positive,), timeout - step, "") for step, (picture, positive) in enumerate(states)
    ]
    return episode_gif([*frames[:-1], replace(frames[-1], ended="fooled")], POLICIES, 1, timeout)


def lines_of(report: Mapping[str, Any]) -> Iterator[str]:
    """What ``audit.json`` says, for a terminal of 80 columns."""
    random_play = report["random_play"]
    yield f"random play: right in {random_play['accuracy']:.1%} of {random_play['states']} states"
    for name in POLICIES:
        if row := report[name]:
            ends = f"fooled in {row['fooled']} of {row['executions']} executions, there in {row['there']}"
            yield f"{name}, positive above {row['threshold']:.4g}: {ends}"
            for kind in row["kinds"][:FILMS]:
                sub_goals = " and ".join(kind["holds"]) or "no sub-goal"
                yield f"  {kind['film'] or '':12s} {kind['executions']:4d} x  while {sub_goals} holds"
