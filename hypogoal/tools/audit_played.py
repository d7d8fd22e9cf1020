"""How often policies fool a success classifier, and where.

A classifier can be right in nearly all states that are met, and wrong where a policy stops that was trained to reach
its positive predictions. So options are learned that end at positive predictions, and the truth of each of their
executions is looked up.
"""

from collections.abc import Mapping, Sequence
from itertools import compress
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy.special import expit

from hypogoal.core.arrays import Floats, Ints
from hypogoal.domains.base import Engine
from hypogoal.evaluation.exploits import option_numbers
from hypogoal.evaluation.selection import states_met
from hypogoal.films import episode_gif
from hypogoal.hypotheses.ensemble import Ensemble
from hypogoal.hypotheses.scores import member_scores
from hypogoal.hypotheses.thresholds import log_odds_of
from hypogoal.meta.episodes import Frame
from hypogoal.meta.setup import Setup
from hypogoal.observations import PICTURE, standard_of
from hypogoal.options.loop import OptionLoop
from hypogoal.options.tables import Exploits
from hypogoal.options.termination import Terminations, load_rule
from hypogoal.tools.classifiers import Classifier

BEFORE, MENDED = POLICIES = ("before", "mended")
CELL = 8  # side of a cell, whose positions count as one place
FILMS = 4  # kinds that get a film
RANDOM_STEPS = 4_000  # steps of random play
DECIMALS = 6  # decimals of a threshold, which float32 log-odds round


def terminations_of(
    classifier: Classifier,
    member: int,
    policies: Mapping[str, float],
    setup: Setup,
    engine: Engine,
) -> Terminations:
    """Return terminations at a member's positives for one option per policy, each with its policy's threshold."""

    def log_odds(ids: Ints) -> Floats:
        of_members = classifier.log_odds(engine.images(ids))
        return of_members[:, [member] * len(policies)].astype(np.float32)

    if engine.observation_dtype != PICTURE:
        standard = classifier.view.standard if isinstance(classifier, Ensemble) else None
        engine.standard = standard or standard_of(engine.observation_shape)
    rule = load_rule(setup.config.termination)
    rule.refuse(setup.config, engine)
    edges = log_odds_of(np.array([*policies.values()])).astype(np.float32)
    return Terminations(log_odds, rule(edges, engine.count))


def random_play(
    loop: OptionLoop,
    column: int,
    rng: np.random.Generator,
) -> dict[str, Any]:
    """Return the classifier's scores on the distinct states to which random actions lead.

    ``column`` is the number of the sub-goal.
    """
    engine = loop.engine
    engine.reset()
    ids = states_met(engine, RANDOM_STEPS, rng)
    ids = ids[engine.remembers(ids)]
    truth = engine.labels(ids)[:, column]
    positive = loop.terminations.of(ids)[:, :1]
    scores = member_scores(positive, truth)
    return {
        "states": len(ids),
        "positives": truth.sum(),
        "false_positives": (positive[:, 0] & ~truth).mean(),
        **{name: score[0] for name, score in scores.items()},
    }


def shares_of(report: Mapping[str, Any]) -> dict[str, float | None]:
    """Return the shares of false positives: of policies' last executions, and of the states that random play met."""
    return {"policy": report[BEFORE]["fires_far"], "play": report["random_play"]["false_positives"]}


def findings(
    loop: OptionLoop,
    option: int,
    name: str,
    sub_goals: Sequence[str],
    folder: Path,
) -> dict[str, Any]:
    """Return how the last executions of a policy ended, by their ``exploits.csv``: its part of ``audit.json``.

    False positives are of one kind if the same sub-goals hold, in the same cell if that is known. For each of the most
    frequent kinds, a film is written to ``folder`` if observations are pictures.
    """
    engine = loop.engine
    threshold = expit(loop.terminations.rule.thresholds[option].astype(float))
    table = Exploits.read(folder / Exploits.FILE)
    last = table.at(table.option == option)
    executions = loop.recorder.executions[option]
    fooled = [*compress(executions, last.reached & ~last.near)]
    ends = np.array([run.states[-1] for run in fooled], int)
    labels = engine.labels(ends)
    positions = engine.positions(ends) if engine.position_names else np.empty((len(ends), 0), int)
    marks = pd.DataFrame(np.column_stack([labels, positions // CELL]))
    alike_ones = [rows.index for _, rows in marks.groupby([*marks])]
    kinds = []
    for number, alike in enumerate(sorted(alike_ones, key=len, reverse=True)):
        shortest = min(alike, key=lambda row: fooled[row].duration)
        film = f"{name}-{number + 1}.gif"
        is_drawn = number < FILMS and _write_film(folder / film, loop, name, fooled[shortest])
        kinds.append(
            {
                "executions": len(alike),
                "holds": [*compress(sub_goals, labels[shortest])],
                "position": dict(zip(engine.position_names, positions[shortest], strict=True)),
                "film": film if is_drawn else None,
            }
        )
    return {
        "threshold": round(float(threshold), DECIMALS),
        **option_numbers(table, option),
        "executions": len(last),
        "fooled": len(fooled),
        "there": (last.reached & last.near).sum(),
        "positive_at_start": sum(run.inside_at_start for run in executions),
        "kinds": kinds,
    }


def _write_film(
    path,
    loop,
    name,
    run,
):
    """Write a film of an execution that ended in a false positive, from where it began.

    Returns False if the execution cannot be drawn.
    """
    ids = np.array([run.began, *run.states])
    engine, timeout = loop.engine, loop.config.option_timeout
    if engine.observation_dtype != PICTURE or not engine.remembers(ids).all():
        return False
    positive = loop.terminations.of(ids)[:, run.option].tolist()
    frames = []
    for step, picture in enumerate(engine.images(ids)):
        ended = "fooled" if step == len(run.states) else ""
        frames.append(Frame(picture, step, 0, (positive[step],), timeout - step, ended))
    path.write_bytes(episode_gif(frames, [name], 1, timeout))
    return True
