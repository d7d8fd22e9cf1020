"""Which held-out states are shown, and attributions of members to them (Spec F2, F6)."""

from collections.abc import Iterator, Mapping
from math import prod
from typing import Any

import numpy as np
import pandas as pd

from hypogoal.core.arrays import Bools, Floats, Ints
from hypogoal.core.seeding import rng_for
from hypogoal.data import open_dataset
from hypogoal.evaluation.house import melted
from hypogoal.evaluation.judging import (
    Judged,
    Judgement,
    Work,
    place_of,
    states_of,
)
from hypogoal.observations import PICTURE, fields_of, spread_rows

GALLERY = 40  # states of all sub-goals
EXPLAINED = 20  # of these with attributions: DeepLift takes .05 s for a state and member
INTEGRATED = 5  # where they are integrated gradients: of a large network seconds
AVERAGED = 64  # states over which attributions to features are averaged
PLACES = ("layout_seed", "room", "kind")  # origins whose values take turns


def look(work: Work, judgement: Judgement) -> Iterator[pd.DataFrame]:
    """What members look at in a few held-out states, of the ensemble whose options were learned most often.

    ``saliency/SUB_GOAL`` is written: states with what members predict, ``seen``, what members saw of the first of them,
    and ``attributions`` to it, float32 (n, K, H, W, C), in log-odds, against the mean of the unlabelled states. Of
    numbers, and of pictures and numbers by key, these alone, (n, K, features): a picture's are added up.
    """
    from hypogoal.hypotheses.deep_lift import (
        DEEP_LIFT,
        attributed,
        mean_state,
        method_of,
    )
    from hypogoal.hypotheses.ensemble import read_ensemble

    artefact, data, sub_goal, judged = judgement
    if artefact.path != work.browsed or not len(judged.labels):
        return
    place, sub_goals = work.place_of(judgement), artefact.config["sub_goals"]
    looked_at = work.facts.setdefault("looked_at", {"ensemble": place, "sub_goals": {}})
    dataset, ensemble = open_dataset(data), read_ensemble(artefact.path, artefact.config, sub_goal)
    heldout, unlabelled = states_of(data)
    observations = heldout[sub_goal].observations
    are_pictures = dataset.observation_dtype == PICTURE
    kinds: list[str] = []
    states = explained = spread_rows(len(judged.labels), AVERAGED)
    if are_pictures:
        kinds, states = states_to_show(judged, sub_goal, GALLERY // len(sub_goals))
        few = EXPLAINED if method_of(ensemble.members[0]) == DEEP_LIFT else INTEGRATED
        explained = states[: max(len(kinds), few // len(sub_goals))]
    seen = ensemble.see(observations[explained])
    attributions = attributed(ensemble, seen, mean_state(ensemble.see(unlabelled)))
    error = attributions.completeness_error()
    facts = {"kinds": kinds, "how": attributions.method, "completeness_error": error.max()}
    looked_at["sub_goals"][sub_goal] = facts
    values: Any = attributions.values
    group = work.arrays.create_group(f"saliency/{sub_goal}")
    if are_pictures:
        default = 3 if dataset.observation_shape[-1] == 3 else 1
        facts["colours"] = dataset.channels.get("", (1, default))[1]  # of each frame of a stack
        facts["places"] = [place_of(judged.origins, state) for state in states]
        group["observations"] = observations[states]
        group["labels"] = judged.labels[states]
        group["probabilities"] = judged.probabilities[states]
        group["predictions"] = judged.predictions[states]
        group["seen"] = seen
    else:
        facts["features"] = dataset.features()
        values = of_features(values.reshape(*error.shape, -1), seen.dtype)
    group.create_dataset("attributions", data=values.astype(np.float32), compression="gzip")
    for row, kind in enumerate(kinds):
        columns = {
            "completeness_error": error[row],
            "log_odds": attributions.log_odds[row],
        }
        yield melted(columns, **place, scope=f"state: {kind}")


def states_to_show(
    judged: Judged,
    sub_goal: str,
    most: int,
) -> tuple[list[str], Ints]:
    """States of the gallery, those of the figures first, and what kinds these are; unseen ones if some are positive."""
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


def of_features(values: Floats, dtype: Any) -> Floats:
    """Attributions (n, K, D) to each number; of mixed observations those to a picture are added up."""
    if not dtype.names:
        return values
    features = []
    start = 0
    for kind, shape in fields_of((), dtype).values():
        of_key = values[..., start : start + prod(shape)]
        start += prod(shape)
        features.append(of_key.sum(axis=-1, keepdims=True) if kind == PICTURE else of_key)
    return np.concatenate(features, axis=-1)


def pick_to_explain(
    probabilities: Floats,
    predictions: Bools,
    labels: Bools,
    allowed: Bools,
) -> dict[str, int]:
    """Figures 2 and 9: the few of N states, by kind, whose attributions are drawn, no state twice.

    ``true positive``: where most of K members are right and surest on average; ``disagree``: where members differ and
    their probabilities are furthest apart; ``false positive``: where most err, and are surest. Fewer where none are.
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
    """Of predictions (n, K) of labels (n,): whether all members are right, all wrong, or they disagree."""
    errors = (predictions != labels[:, None]).sum(axis=1)
    return np.select([errors == 0, errors == predictions.shape[1]], ["all right", "all wrong"], "disagree")


def pick_for_gallery(
    predictions: Bools,
    labels: Bools,
    places: Mapping[str, Ints],
    rng: np.random.Generator,
) -> Ints:
    """States by how interesting they are, int64 (N,): kinds of outcome take turns, and within each the places.

    Takes predictions (N, K), labels (N,), places (N,) each. States on which all members are right come last; ``rng``
    draws among states alike.
    """
    kinds = pd.DataFrame({"outcome": outcomes(predictions, labels), "label": labels})
    states = kinds.assign(**places).sample(frac=1, random_state=rng)
    turn = states.groupby([*states]).cumcount()
    states = states.assign(turn=turn).sort_values("turn", kind="stable")
    turn = states.groupby([*kinds]).cumcount()
    right = states["outcome"] == "all right"
    return states.assign(turn=turn, right=right).sort_values(["right", "turn"], kind="stable").index.to_numpy()
