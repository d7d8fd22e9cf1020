"""Held-out states to browse: a bounded, seeded choice in which each kind of verdict and each place comes up (F2, F7).

What members say of most states is right, so a sample as it comes would hardly show an error. Here the kinds of outcome
take turns, and within each the places that states are from; how often a kind comes up therefore says nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hypogoal.core.seeding import rng_for
from hypogoal.dataset import Split
from hypogoal.evaluation.arrays import write_states
from hypogoal.evaluation.pictures import brightness, flat, to_bytes
from hypogoal.evaluation.saliency import deep_lift, mean_state
from hypogoal.evaluation.shown import Unlabelled
from hypogoal.hypotheses.ensemble import Ensemble
from hypogoal.hypotheses.views import positions_of

MOST_STATES = 300  # over all sub-goals, for the page's sake
MOST_OF_ONE = 180  # of one sub-goal
MOST_EXPLAINED = 120  # states with attributions, over all sub-goals: DeepLift takes .05 s for a state and member
PLACES = ("layout_seed", "room", "kind")  # origins whose values take turns


def browse_states(
    ensemble: Ensemble,
    sub_goal: str,
    split: Split,
    judged: tuple[NDArray[np.float32], NDArray[np.bool_]],
    unlabelled: Unlabelled,
    kinds: Sequence[str],
    sub_goals: int,
    arrays: Any,
) -> dict[str, Any]:
    """Write one sub-goal's states to browse as ``explorer/<sub-goal>``; attributions of the first of them.

    Args:
        ensemble: whose members.
        sub_goal: its name.
        split: the held-out states, N.
        judged: every member's probabilities and verdicts on them, (N, K) each.
        unlabelled: the mean of what members see of them is the attributions' baseline.
        kinds: names of the values of the origin ``kind``.
        sub_goals: how many share the page.
        arrays: the file.

    Returns:
        ``sub_goal``, ``states`` (of how many), ``shown`` and ``explained``.
    """
    most = min(MOST_OF_ONE, MOST_STATES // sub_goals)
    places = [split.origins[name] for name in PLACES if name in split.origins]
    picked = pick_to_browse(judged[1], split.labels, places, most, rng_for(0, "browse", sub_goal))
    group = arrays.create_group(f"explorer/{sub_goal}")
    kind = split.origins.get("kind")
    names = [kinds[kind[index]] if kind is not None and kind[index] < len(kinds) else "" for index in picked]
    write_states(group, list(zip(picked.tolist(), names, strict=True)), split, *judged)
    group["rows"] = picked
    explained = picked[: min(len(picked), MOST_EXPLAINED // sub_goals)]
    positions = positions_of(split.origins)
    seen = ensemble.see(split.observations[explained], None if positions is None else positions[explained])
    baseline = mean_state(ensemble.see(unlabelled.observations, unlabelled.positions))
    values = [to_bytes(flat(deep_lift(ensemble, seen[i : i + 8], baseline).values)) for i in range(0, len(seen), 8)]
    shape = (0, len(ensemble), *seen.shape[1:3])
    group["attributions"] = np.concatenate([np.zeros(shape, np.int8), *values])
    group["brightness"] = brightness(seen)
    return {"sub_goal": sub_goal, "states": len(split.labels), "shown": len(picked), "explained": len(explained)}


def pick_to_browse(
    verdicts: NDArray[np.bool_],
    labels: NDArray[np.bool_],
    places: Sequence[NDArray[np.int64]],
    most: int,
    rng: np.random.Generator,
) -> NDArray[np.int64]:
    """Which states are shown, int64 (n,) with n at most ``most``, no state twice.

    Args:
        verdicts: bool (N, K).
        labels: bool (N,).
        places: int (N,) each; states alike in all of them are from the same place.
        most: states.
        rng: draws among states alike.
    """
    errors = (verdicts != labels[:, None]).sum(1)
    outcome = np.where(errors == 0, 0, np.where(errors == verdicts.shape[1], 2, 1)) * 2 + labels
    order = rng.permutation(len(labels))
    if places:
        _, place = np.unique(np.stack(places, axis=1), axis=0, return_inverse=True)
        order = take_turns(order, place.reshape(-1))
    return take_turns(order, outcome)[:most]


def take_turns(order: NDArray[np.int64], groups: NDArray[np.int64]) -> NDArray[np.int64]:
    """The same states (n,), reordered so that groups take turns: the first of each, then the second of each, ...

    Args:
        order: indices, the better first.
        groups: int (N,), each state's.
    """
    own = groups[order]
    turn = np.zeros(len(order), dtype=np.int64)
    for group in np.unique(own):
        here = own == group
        turn[here] = np.arange(here.sum())
    return order[np.argsort(turn, kind="stable")]
