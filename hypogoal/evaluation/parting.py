"""The hypotheses: states on which members disagree, what each member says of them, and which member the agent went by.

The states are held-out states of the ensemble whose options were learned most often. :func:`saliency.look` writes them.
"""

import posixpath
from collections.abc import Iterator, Mapping
from operator import itemgetter
from typing import Any

import numpy as np
import pandas as pd

from hypogoal.core.arrays import Bools, Floats, Ints
from hypogoal.core.seeding import rng_for
from hypogoal.data import PLANTED
from hypogoal.evaluation.choosing import FROZEN, LEAST
from hypogoal.evaluation.curves import chosen_by
from hypogoal.evaluation.hypotheses import HELDOUT
from hypogoal.evaluation.judging import Judged
from hypogoal.evaluation.run import Results
from hypogoal.evaluation.selection import SCOPE
from hypogoal.evaluation.verdict import MARGIN

TITLE = "What the hypotheses say"
SHOWN = 6  # states of a sub-goal that the page shows without unfolding
PLACES = ("layout_seed", "room", "kind")  # origins whose values take turns
OF_MEMBERS = {  # columns of the table of members, each the first scope and quantity that the run has
    "accuracy": [("unseen", "balanced_accuracy"), (HELDOUT, "balanced_accuracy")],
    "match": [(SCOPE, "match")],
    "chosen": [(SCOPE, "chosen")],
    "quality": [(FROZEN, "quality")],
}


def states_to_show(
    judged: Judged,
    sub_goal: str,
    most: int,
) -> tuple[list[str], Ints]:
    """Return the kinds of the states that figures show, and the states of the gallery, int64 (n,), those first.

    States of figures are in rooms that no training set saw, if any of these is positive.
    """
    labels, origins = judged.labels, judged.origins
    allowed = origins.get("seen", np.zeros(len(labels))) == 0
    if not labels[allowed].any():
        allowed[:] = True
    kinds = pick_to_explain(judged.probabilities, judged.predictions, labels, allowed)
    places = {name: origins[name] for name in PLACES if name in origins}
    browsed = pick_for_gallery(
        judged.predictions,
        labels,
        places,
        rng_for(0, "browse", sub_goal),
    )
    states = pd.unique(np.array([*kinds.values(), *browsed]))
    return [*kinds], states[:most]


def pick_to_explain(
    probabilities: Floats,
    predictions: Bools,
    labels: Bools,
    allowed: Bools,
) -> dict[str, int]:
    """Return, by kind, the few of N states whose attributions Figures 2 and 9 draw. No state is picked twice.

    ``true positive``: most of K members are right, and members are surest on average. ``disagree``: members differ, and
    their probabilities are furthest apart. ``false positive``: most members err, and members are surest on average. A
    kind may lack a state.
    """
    positive = predictions.sum(axis=1)
    some = positive > 0
    surest = positive + probabilities.mean(axis=1)
    candidates = {
        "true positive": (labels & some, surest),
        "disagree": (some & ~predictions.all(axis=1), np.ptp(probabilities, axis=1)),
        "false positive": (~labels & some, surest),
    }
    free = allowed.copy()
    picked = {}
    for kind, (of_kind, order) in candidates.items():
        among = of_kind & free
        if among.any():
            picked[kind] = int(np.where(among, order, -np.inf).argmax())
            free[picked[kind]] = False
    return picked


def outcomes(predictions: Bools, labels: Bools) -> Any:
    """Return whether all members are right, all wrong, or disagree, as texts (n,), for predictions (n, K)."""
    errors = (predictions != labels[:, None]).sum(axis=1)
    return np.select([errors == 0, errors == predictions.shape[1]], ["all right", "all wrong"], "disagree")


def pick_for_gallery(
    predictions: Bools,
    labels: Bools,
    places: Mapping[str, Ints],
    rng: np.random.Generator,
) -> Ints:
    """Return states in the order of their interest, int64 (N,): kinds of outcome take turns, and then the places.

    Takes predictions (N, K), labels (N,), places (N,) each. States on which all members are right come last. ``rng``
    draws among states alike.
    """
    kinds = pd.DataFrame({"outcome": outcomes(predictions, labels), "label": labels})
    states = kinds.assign(**places).sample(frac=1, random_state=rng)
    turn = states.groupby([*states]).cumcount()
    states = states.assign(turn=turn).sort_values("turn", kind="stable")
    turn = states.groupby([*kinds]).cumcount()
    right = states["outcome"] == "all right"
    return states.assign(turn=turn, right=right).sort_values(["right", "turn"], kind="stable").index.to_numpy()


def context(results):
    """Return each sub-goal's members and the states on which they disagree, and all states of the gallery."""
    looked_at = results.facts.get("looked_at")
    if looked_at is None:
        return {}
    ensemble = looked_at["ensemble"]
    agent = agent_of(results, ensemble["artefact"])
    sub_goals, every = [], []
    for name, facts in looked_at["sub_goals"].items():
        states = [*states_of(results, name, facts)]
        every += states
        members = members_of(results.of(artefact=[ensemble["artefact"], agent], sub_goal=name))
        sub_goals.append({"name": name, "members": members, "parted": parted(states), **went_by(members["chosen"])})
    pursued = sorted(sub_goals, key=itemgetter("rare"))  # sub-goals that were pursued come first
    return {"ensemble": ensemble, "agent": agent, "sub_goals": pursued, "states": every}


def agent_of(results: Results, ensemble: str) -> str:
    """Return the path of the first agent that learned to choose among an ensemble's options, or an empty text."""
    learned = results.of(method=[*chosen_by(results, "learned")])["artefact"].unique()
    for artefact in results.facts["provenance"]["artefacts"]:
        sources = [posixpath.normpath(f"{artefact['path']}/{entry['relative']}") for entry in artefact["inputs"]]
        if artefact["path"] in learned and ensemble in sources:
            return artefact["path"]
    return ""


def members_of(numbers: pd.DataFrame) -> pd.DataFrame:
    """Return a row for each member of a sub-goal, with ``OF_MEMBERS``, and the planted ``feature`` that it tells best.

    ``tells`` is the balanced accuracy with which the member tells that feature. NaN is what the run does not have.
    """
    wide = numbers.pivot_table("value", "member", ["scope", "quantity"])
    columns = {}
    for name, places in OF_MEMBERS.items():
        of_member = [wide[place] for place in places if place in wide]
        columns[name] = of_member[0] if of_member else np.nan
    members = pd.DataFrame(columns, index=wide.index)
    features = {scope: wide[scope, "balanced_accuracy"] for scope in wide.columns.unique(0) if PLANTED in scope}
    if features:
        planted = pd.DataFrame(features).rename(columns=lambda scope: scope.removeprefix(PLANTED))
        members = members.assign(feature=planted.idxmax(axis=1), tells=planted.max(axis=1))
    return members


def went_by(chosen: pd.Series) -> dict[str, Any]:
    """Return how many ``times`` an agent took an option of some members, and whether that is too ``rare`` to say more.

    If it is not, return also the member whose option was taken ``most``, its ``share``, and whether it ``led``, that
    is, its share is above an even one by more than ``MARGIN``.
    """
    times = chosen.sum()
    even = 1 / len(chosen)
    if times * even < LEAST:
        return {"times": times, "rare": True}
    share = chosen.max() / times
    return {"times": times, "rare": False, "most": chosen.idxmax(), "share": share, "led": share - even > MARGIN}


def parted(states: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the first states on which members disagree. Each way to disagree comes once before any comes again."""
    differ = [state for state in states if state["outcome"] == "disagree"]
    says = pd.Series([state["predictions"].tobytes() for state in differ], dtype=object)
    turn = says.groupby(says).cumcount()
    return [differ[row] for row in turn.sort_values(kind="stable").index[:SHOWN]]


def states_of(results: Results, sub_goal: str, facts: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
    """Yield each state of the gallery with its arrays. Only the first states have attributions.

    Nothing is yielded if observations are numbers.
    """
    arrays = results.within(f"saliency/{sub_goal}")
    if "observations" not in arrays:
        return
    shared = {"sub_goal": sub_goal, "colours": facts["colours"], "attributions": []}
    outcome = outcomes(arrays["predictions"], arrays["labels"])
    for index, place in enumerate(facts["places"]):
        of_state = {name: values[index] for name, values in arrays.items() if index < len(values)}
        yield shared | of_state | {"place": place, "outcome": outcome[index]}
