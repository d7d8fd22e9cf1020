"""Sub-goals of which rewards have not told which member is best, and the states whose labels would tell.

Only agents with ``chooser=symbols`` are looked at, because their posterior says how sure they are.
"""

from typing import Any

import numpy as np
import pandas as pd

from hypogoal.core.arrays import Doubles
from hypogoal.core.artefacts import Artefact
from hypogoal.evaluation.choosing import FROZEN
from hypogoal.evaluation.curves import SHORT, SOLVED
from hypogoal.evaluation.judging import Work
from hypogoal.evaluation.names import UNIFORM
from hypogoal.evaluation.verdict import UNDECIDED, outcome_of
from hypogoal.options.tables import Episodes

EPISODES = 50  # with fewer episodes, nobody can be sure
DRAWS = 400  # draws of the posterior
NAMED = 8  # states to label


def facts(work: Work, numbers: pd.DataFrame) -> dict[str, Any]:
    """Return ``undecided``: failing agents' sub-goals whose two best members the agent cannot tell apart.

    An agent fails if it solves less than 95 % of the episodes that it plays after training. If it played none, its last
    ``SHORT`` training episodes count.
    """
    undecided = []
    played = numbers[(numbers["scope"] == FROZEN) & (numbers["quantity"] == "success") & (numbers["method"] != UNIFORM)]
    for artefact in work.contents.agents:
        if artefact.config.get("chooser") != "symbols" or artefact.config["termination"] == "oracle":
            continue
        place = work.place(artefact)
        succeeded = Episodes.read(artefact.path / Episodes.FILE).succeeded
        solved = succeeded[-SHORT:].mean() if len(succeeded) else 0.0
        frozen = played[played["artefact"] == place["artefact"]]["value"]
        if len(frozen):
            solved = frozen.mean()
        if len(succeeded) >= EPISODES and solved < SOLVED:
            named = {"agent": place["method"], "episodes": len(succeeded)}
            undecided += [{**named, **each} for each in of_agent(work, artefact)]
    return {"undecided": undecided}


def of_agent(work: Work, artefact: Artefact) -> list[dict[str, Any]]:
    """Return an entry for each sub-goal whose two best members may or may not differ.

    Members are compared by their options' values in the symbols in which their sub-goal was pursued most. The
    difference has a 95 % interval over draws of the posterior; an entry is made if the interval leaves the outcome
    open.
    """
    from hypogoal.core.tensors import load_tensors
    from hypogoal.meta.symbols import Model
    from hypogoal.options.choosers import FILE

    config = artefact.config
    members, sub_goals = config["members"], config["sub_goals"]
    options = members * len(sub_goals)
    model = Model(options, config["history"], 1.0)
    model.restore({name: values.numpy() for name, values in load_tensors(artefact.path / FILE).items()})
    executions = np.bincount(model.pairs(), model.sums[:, 0], len(model.symbols) * options).reshape(-1, options)
    draw = np.random.default_rng(0).standard_gamma
    drawn = np.stack([model.qualities(draw) for _ in range(DRAWS)])
    undecided = []
    for goal, sub_goal in enumerate(sub_goals):
        options_of_goal = slice(goal * members, (goal + 1) * members)
        place = executions[:, options_of_goal].sum(axis=1).argmax()
        tried = np.flatnonzero(executions[place, options_of_goal])
        if len(tried) < 2:
            continue
        values = drawn[:, place, options_of_goal][:, tried]
        second, best = values.mean(axis=0).argsort()[-2:]
        difference = values[:, best] - values[:, second]
        low, high = np.percentile(difference, (2.5, 97.5))
        if outcome_of(low, high) != UNDECIDED:
            continue
        pair = sorted([int(tried[best]), int(tried[second])])
        numbers = {"difference": difference.mean(), "low": low, "high": high}
        states = to_label(work, artefact, sub_goal, pair)
        undecided.append({"sub_goal": sub_goal, "members": pair, **numbers, **states})
    return undecided


def to_label(work: Work, artefact: Artefact, sub_goal: str, pair: list[int]) -> dict[str, Any]:
    """Return the ensemble's file ``data``, and ``states``: its unlabelled states on which two members differ most.

    ``states`` is empty if the ensemble is not part of the run, or if its file has no unlabelled states.
    """
    from hypogoal.data import open_dataset
    from hypogoal.hypotheses.ensemble import read_ensemble
    from hypogoal.hypotheses.labelling import next_to_label

    place = artefact.input("ensemble").resolve()
    source = next((each for each in work.contents.ensembles if each.path.resolve() == place), None)
    if source is None:
        return {"data": "", "states": []}
    data = work.contents.data_of[source.path]
    ensemble = read_ensemble(source.path, source.config, sub_goal)
    unlabelled = open_dataset(data).unlabelled()
    if not len(unlabelled):
        return {"data": str(data), "states": []}
    thresholds: Doubles = np.array(ensemble.thresholds.tolist())[pair]
    rows, _ = next_to_label(unlabelled, ensemble.predict(unlabelled)[:, pair], thresholds, NAMED)
    return {"data": str(data), "states": rows.tolist()}
