"""Users' states, checked and split into the sets of a data file."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from hypogoal.core.errors import UserError
from hypogoal.core.seeding import rng_for
from hypogoal.data import (
    Collected,
    Integers,
    Labels,
    States,
    doubts_of,
    joined,
    leave_out,
    require_classes,
    require_names,
)
from hypogoal.domains.observations import reading_of
from hypogoal.importing.duplicates import contradictions, looks_of, near_duplicates
from hypogoal.importing.parts import Array, Given, Parts
from hypogoal.importing.taken import Taking

ROW = "row"  # the origin of each state: which of the given ones it was
PLAIN = Taking()
OTHERS = "Give some of other contexts."


def assemble(
    parts: Parts, sub_goals: Sequence[str] = (), taking: Taking = PLAIN, *, share: float = 0.2, seed: int = 0
) -> tuple[Collected, list[str]]:
    """The states in the form of a data file, and lines on what is allowed but may surprise.

    The name of a single sub-goal is optional. Without held-out states, a ``share`` of each class of the labelled ones,
    or of their groups, is held out by ``seed``. Unusable states, and a class that is missing or only has pictures that
    the other class has too, are a ``UserError``.
    """
    remarks = _doubts(parts.labelled)
    labelled = _states(parts.labelled, "labelled", taking)
    unlabelled = _states(parts.unlabelled, "unlabelled", taking, labelled)
    goals = _named(sub_goals or parts.sub_goals, labelled.labels.shape[1])
    names = test_names = parts.labelled.names
    if parts.features and len(parts.features) != labelled.observations[0].size:
        counts = f"{len(parts.features)} for {labelled.observations.dtype} {labelled.observations.shape[1:]}"
        raise UserError("the number of feature names is wrong", counts, "Give one for each.")
    if parts.heldout:
        heldout, test_names = _states(parts.heldout, "held-out", taking, labelled), parts.heldout.names
        remarks += contradictions(joined([labelled, heldout]), goals, [*names, *test_names])
        heldout = _apart(heldout, [labelled, unlabelled], "held-out", "to learn from", remarks)
    else:
        remarks += contradictions(labelled, goals, names)
        chosen = _held_out(labelled, parts.labelled.groups, share, seed)
        unlabelled = _without_groups(unlabelled, parts, chosen, remarks)
        heldout, labelled = labelled.where(chosen), labelled.where(~chosen)
        heldout = _apart(heldout, [labelled], "held-out", "to learn from", remarks)
        unlabelled = _apart(unlabelled, [heldout], "unlabelled", "held out", remarks)
        remark = "no held-out states were given: {} of the labelled ones are held out, which says nothing about {}"
        remarks.append(remark.format(int(chosen.sum()), "other contexts"))
    require_classes(labelled.labels, goals, None, "Give states of both kinds.")
    of_labelled = [names[row] for row in labelled.origins[ROW]]
    contradictions(labelled, goals, of_labelled)
    remarks += near_duplicates(
        labelled, heldout, goals, (of_labelled, [test_names[row] for row in heldout.origins[ROW]])
    )
    remarks += doubts_of(labelled.labels, heldout.labels, goals)
    sets = labelled, unlabelled, heldout
    labelled, unlabelled, heldout = [replace(states, origins=_rows(states)) for states in sets]
    shape = labelled.observations.shape[1:]
    channels = {key.replace("/", "."): meaning for key, meaning in parts.channels.items()}
    return Collected(shape, goals, labelled, unlabelled, heldout, tuple(parts.features), channels), remarks


def _doubts(part: Given) -> list[str]:
    """Why values may be something else than they are taken for."""
    readings = [reading_of(values.shape[1:], values.dtype) for values in part.observations.values()]
    return [reading.doubt for reading in readings if reading.doubt]


def _states(part: Given, kind: str, taking: Taking, like: States | None = None) -> States:
    """Checked states, with their rows as origins; ``like`` are the labelled ones."""
    pattern = like.observations if like else None
    observations = taking.observations(part.observations, f"the {kind} observations", pattern)
    goals = like.labels.shape[1] if like else None
    if part.labels is None:
        labels = np.zeros((len(observations), goals or 0), np.bool_)
    else:
        labels = _labels(part.labels, len(observations), kind, goals)
    states = States(observations, labels)
    return replace(states, origins=_rows(states))


def _labels(values: Array, count: int, kind: str, goals: int | None) -> Labels:
    """Labels bool (count, G) of ``goals`` sub-goals, if these are known."""
    columns = values if values.ndim > 1 else np.atleast_1d(values)[:, None]
    if columns.shape != (count, goals or columns.shape[1]) or not columns.size or not np.isin(columns, (0, 1)).all():
        fault = f"labels of {count} {kind} states are not 0 or 1 for each"
        do = f"Give ({count},), or ({count}, sub-goals): 1 where the sub-goal holds, 0 where not."
        raise UserError(fault, f"{values.dtype} {values.shape}", do)
    return columns.astype(np.bool_)


def _rows(states: States) -> dict[str, Integers]:
    return {ROW: np.arange(len(states.labels), dtype=np.int64)}


def _apart(states: States, others: Sequence[States], kind: str, role: str, remarks: list[str]) -> States:
    """The states of a ``kind`` that equal none of the others, whose ``role`` is for messages; none: a ``UserError``."""
    kept = leave_out(states, *[other.observations for other in others])
    count, left = len(states.labels), len(kept.labels)
    if left < count:
        remarks.append(f"{count - left} of {count} {kind} states look like one {role}: they are left out")
    if not left:
        raise UserError(f"every {kind} state looks like one {role}", None, OTHERS)
    return kept


def _without_groups(unlabelled: States, parts: Parts, chosen: Labels, remarks: list[str]) -> States:
    """The unlabelled states that are of no held-out group."""
    if parts.labelled.groups is None or parts.unlabelled.groups is None:
        return unlabelled
    kept = ~np.isin(parts.unlabelled.groups, parts.labelled.groups[chosen])
    if not kept.any():
        raise UserError("every unlabelled state is of a held-out group", None, OTHERS)
    if not kept.all():
        remarks.append(f"{(~kept).sum()} of {len(kept)} unlabelled states are of held-out groups: they are left out")
    return unlabelled.where(kept)


def _named(sub_goals: Sequence[str], count: int) -> tuple[str, ...]:
    """The names of ``count`` sub-goals; a ``UserError`` unless there are as many plain, distinct ones."""
    names = tuple(sub_goals) or (("sub-goal",) if count == 1 else ())
    if len(names) != count:
        do = f"Give --sub-goal NAME {count} times, in the order of the labels' columns."
        raise UserError(f"{count} sub-goals need as many names", ", ".join(names) or None, do)
    require_names(names)
    return names


def _held_out(states: States, groups: Array | None, share: float, seed: int) -> Labels:
    """Which states are held out, bool (N,): whole groups, or without groups all that look alike."""
    labels = states.labels
    if groups is not None and len(groups) != len(labels):
        raise UserError(
            "the groups do not fit the labelled states", f"{len(groups)} for {len(labels)}", "Give one each."
        )
    by = looks_of(states.observations) if groups is None else groups
    _, first, unit = np.unique(by, return_index=True, return_inverse=True)
    kinds = labels[first]
    if groups is not None:  # which labels a group has
        of_groups = [labels[unit == group] for group in range(len(first))]
        kinds = np.array([[*some.any(0), *some.all(0)] for some in of_groups])
    order = np.argsort(first)  # each once, in the original order
    held = np.zeros(len(first), np.bool_)
    held[order[held_out(kinds[order], share, seed)]] = True
    return held[unit]


def held_out(labels: Labels, share: float, seed: int) -> Labels:
    """Which states are held out, bool (N,): a random ``share`` of each combination of labels (N, G), never all of it.

    A remainder of less than one state is carried over to the next combination. No state at all is a ``UserError``.
    """
    rng = rng_for(seed, "held-out")
    chosen = np.zeros(len(labels), np.bool_)
    due = 0.0
    for kind in np.unique(labels, axis=0):
        rows = np.flatnonzero((labels == kind).all(axis=1))
        due += share * len(rows)
        taken = min(round(due), len(rows) - 1)
        chosen[rng.permutation(rows)[:taken]] = True
        due -= taken
    if not chosen.any():
        fault = f"none of {len(labels)} labelled states, or groups of them, can be held out"
        raise UserError(fault, f"heldout={share:g}", "Give held-out states, a larger --heldout, or more labelled ones.")
    return chosen
