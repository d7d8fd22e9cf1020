"""How often policies fool a success classifier, and where (Spec H5).

A classifier can be right in nearly all states that are met, and wrong where a policy stops that was trained to reach
its positive predictions. So options are learned that end at these, and the truth of each of their executions is looked
up.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit

from hypogoal.core.artefacts import open_artefact
from hypogoal.core.errors import UserError
from hypogoal.core.own_code import load
from hypogoal.domains.base import Engine
from hypogoal.evaluation.exploits import option_numbers
from hypogoal.evaluation.films import episode_gif
from hypogoal.evaluation.selection import states_met
from hypogoal.hypotheses.ensemble import THRESHOLD, read_ensemble
from hypogoal.hypotheses.scores import member_scores
from hypogoal.hypotheses.thresholds import log_odds_of
from hypogoal.meta.episodes import Frame
from hypogoal.meta.setup import Setup
from hypogoal.observations import PICTURE, Observations, Standard, standard_of
from hypogoal.options.loop import OptionLoop
from hypogoal.options.recording import Execution
from hypogoal.options.tables import Exploits
from hypogoal.options.termination import Terminations, load_rule

BEFORE, MENDED, SEARCH = POLICIES = ("before", "mended", "search")
CHUNK = 256  # observations that own code is given at once
CELL = 8  # of positions that count as one place
FILMS = 4  # kinds that are shown
NEVER = -100.0  # log-odds
RANDOM_STEPS = 4_000  # of random play
DECIMALS = 6  # of a threshold, which float32 log-odds round
Classifier = Callable[[Observations], NDArray[np.floating]]  # observations (n, *obs) -> log-odds (n,)


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
    if member >= len(ensemble):
        raise UserError("the ensemble has no such member", member, f"Give --member, 0 to {len(ensemble) - 1}.")

    def classify(observations: Observations) -> NDArray[np.floating]:
        return ensemble.log_odds(observations)[:, member]

    world = source.config["domain_config"] if source.config["domain"] == domain else {}
    return Target(classify, float(ensemble.thresholds[member]), ensemble.view.standard, world, [source.path])


def own_classifier(name: str) -> Classifier:
    """Code of the user's own, from observations (n, *obs) to probabilities (n,); else a ``UserError``."""
    function = load(name, "classifier", "hypogoal.classifiers", {})
    if not callable(function):
        raise UserError("this is not a function", name, "Give one from observations (N, *obs) to probabilities (N,).")

    def classify(observations: Observations) -> NDArray[np.floating]:
        parts = []
        for some in np.split(observations, range(CHUNK, len(observations), CHUNK)):
            probabilities = np.asarray(function(some), dtype=np.float64)
            if probabilities.shape != (len(some),) or not ((probabilities >= 0) & (probabilities <= 1)).all():
                fault = f"the classifier gave {probabilities.shape} {probabilities.ravel()[:3]}"
                raise UserError(fault, name, f"Give probabilities, 0 to 1, float ({len(some)},).")
            parts.append(probabilities)
        return log_odds_of(np.concatenate(parts))

    return classify


def terminations_of(
    target: Target,
    column: int,
    policies: Mapping[str, float],
) -> Callable[[Setup, Engine], Terminations]:
    """A function of an engine: options that end at a classifier's positives, one for each policy's threshold.

    That of the policy ``search`` ends at false positives alone, where sub-goal number ``column`` does not hold.
    """
    edges = np.array([*policies.values()])
    names = [*policies]

    def ends(setup: Setup, engine: Engine) -> Terminations:
        def log_odds(ids: NDArray[np.int64]) -> NDArray[np.float32]:
            of_states = target.classify(engine.images(ids)).astype(np.float32)
            every = np.repeat(of_states[:, None], len(edges), axis=1)
            if SEARCH in names:
                every[engine.labels(ids)[:, column], names.index(SEARCH)] = NEVER
            return every

        if engine.observation_dtype != PICTURE:
            engine.standard = target.standard or standard_of(engine.observation_shape)
        rule = load_rule(setup.config.termination)
        rule.refuse(setup.config, engine)
        thresholds = log_odds_of(edges).astype(np.float32)
        return rule(log_odds, len(edges), None, thresholds, engine.count)

    return ends


def report_of(loop: OptionLoop, policies: Iterable[str], sub_goals: Sequence[str], folder: Path) -> dict[str, Any]:
    """Each policy's findings, and its threshold at the end of learning; None for a policy that was not wanted."""
    report: dict[str, Any] = dict.fromkeys(POLICIES)
    for option, name in enumerate(policies):
        threshold = float(expit(loop.terminations.thresholds[option].astype(np.float64)))
        report[name] = {"threshold": round(threshold, DECIMALS), **findings(loop, option, name, sub_goals, folder)}
    return report


def random_play(loop: OptionLoop, column: int, rng: np.random.Generator) -> dict[str, Any]:
    """The classifier's scores, of sub-goal number ``column``, on the states that random actions lead to, each once."""
    engine = loop.engine
    engine.reset()
    ids = states_met(engine, RANDOM_STEPS, rng)
    ids = ids[engine.remembers(ids)]
    truth = engine.labels(ids)[:, column]
    positive = loop.terminations.of(ids)[:, :1]
    scores = {name: score.item() for name, score in member_scores(positive, truth).items()}
    false_positives = float((positive[:, 0] & ~truth).mean())
    return {"states": len(ids), "positives": int(truth.sum()), "false_positives": false_positives, **scores}


def shares_of(report: Mapping[str, Any]) -> dict[str, float | None]:
    """The shares of false positives: of the last executions of policies, of the states that random play met."""
    shares = {"policy": report[BEFORE]["fires_far"]}
    if report[SEARCH]:
        shares["search"] = report[SEARCH]["fires_far"]
    return {**shares, "play": report["random_play"]["false_positives"]}


def findings(
    loop: OptionLoop,
    option: int,
    name: str,
    sub_goals: Sequence[str],
    folder: Path,
) -> dict[str, Any]:
    """How the last executions of a policy ended, by their ``exploits.csv``: its part of ``audit.json``.

    Of each of the most frequent kinds of false positives a film is put into ``folder``, of pictures.
    """
    table = Exploits.read(folder / Exploits.FILE)
    executions = list(loop.recorder.executions[option])
    of_policy = table.option == option
    positive, near = table.reached[of_policy], table.near[of_policy]
    fooled = [executions[row] for row in np.flatnonzero(positive & ~near)]
    kinds = []
    for number, alike in enumerate(kinds_of(loop.engine, fooled)):
        film = f"{name}-{number + 1}.gif"
        shortest = min(alike, key=lambda row: row.duration)
        drawn = number < FILMS and _write_film(folder / film, loop, name, shortest)
        end = np.array(shortest.states[-1:])
        holds = np.array(sub_goals)[loop.engine.labels(end)[0]].tolist()
        at = loop.engine.positions(end)[0].tolist() if loop.engine.position_names else []
        position = dict(zip(loop.engine.position_names, at, strict=True))
        of_kind = {"executions": len(alike), "holds": holds, "position": position}
        kinds.append(of_kind | {"film": film if drawn else None})
    return {
        **option_numbers(table, option),
        "executions": int(of_policy.sum()),
        "fooled": len(fooled),
        "there": int((positive & near).sum()),
        "positive_at_start": sum(row.inside_at_start for row in executions),
        "kinds": kinds,
    }


def kinds_of(engine: Engine, fooled: Sequence[Execution]) -> list[list[Execution]]:
    """False positives of one kind, the most frequent first: the same sub-goals hold, the cell is the same, if known."""
    if not fooled:
        return []
    ends = np.array([row.states[-1] for row in fooled])
    marks = engine.labels(ends).astype(np.int64)
    if engine.position_names:
        marks = np.concatenate([marks, engine.positions(ends) // CELL], axis=1)
    _, kind = np.unique(marks, axis=0, return_inverse=True)
    kinds: list[list[Execution]] = [[] for _ in range(kind.max() + 1)]
    for row, number in zip(fooled, kind.reshape(-1), strict=True):
        kinds[number].append(row)
    return sorted(kinds, key=len, reverse=True)


def _write_film(path: Path, loop: OptionLoop, name: str, execution: Execution) -> bool:
    """An execution that ended in a false positive, from where it began; False where it cannot be drawn."""
    ids = np.array([execution.began, *execution.states])
    if loop.engine.observation_dtype != PICTURE or not loop.engine.remembers(ids).all():
        return False
    timeout = loop.config.option_timeout
    positive = loop.terminations.of(ids)[:, execution.option].tolist()
    frames = []
    for step, picture in enumerate(loop.engine.images(ids)):
        frames.append(Frame(picture, step, 0, (positive[step],), timeout - step, ""))
    frames[-1] = replace(frames[-1], ended="fooled")
    path.write_bytes(episode_gif(frames, [name], 1, timeout))
    return True


def lines_of(report: Mapping[str, Any]) -> Iterator[str]:
    """What ``audit.json`` says, for a terminal of 80 columns."""
    random_play = report["random_play"]
    yield f"random play: right in {random_play['accuracy']:.1%} of {random_play['states']} states"
    for name in POLICIES:
        if row := report[name]:
            ends = f"fooled in {row['fooled']} of {row['executions']} executions, there in {row['there']}"
            yield f"{name}, positive above {row['threshold']:.4g}: {ends}"
            if row["positive_at_start"]:
                yield f"  {row['positive_at_start']} begin where it is positive already, so that doing nothing is paid"
            for kind in row["kinds"][:FILMS]:
                sub_goals = " and ".join(kind["holds"]) or "no sub-goal"
                yield f"  {kind['film'] or '':12s} {kind['executions']:4d} x  while {sub_goals} holds"
