"""Users' states, checked and split into the sets of a data file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hypogoal.core.errors import UserError
from hypogoal.core.seeding import rng_for
from hypogoal.data import (
    Collected,
    States,
    hard_to_judge,
    hard_to_learn,
    joined,
    leave_out,
    require_classes,
    require_names,
)
from hypogoal.domains.observations import reading_of
from hypogoal.importing.duplicates import contradictions, looks_of, near_duplicates, require_own_pictures
from hypogoal.importing.parts import Given, Parts, Source
from hypogoal.importing.taken import observations_of

ROW = "row"  # the origin of each state: which of the given ones it was


def assemble(
    parts: Parts,
    sub_goals: Sequence[str] = (),
    *,
    share: float = 0.2,
    seed: int = 0,
    sides: Mapping[str, int] | None = None,
    stack: bool = False,
) -> tuple[Collected, list[str]]:
    """The states in the form of a data file, and lines on what is allowed but may surprise.

    The name of a single sub-goal is optional. Without held-out states, a ``share`` of each class of the labelled ones,
    or of their groups, is held out by ``seed``. ``sides`` and ``stack``: see :func:`observations_of`. Unusable states,
    and a class that is missing or only has pictures that the other class has too, are a ``UserError``.
    """
    said = [doubt for doubt in map(_doubt, _sources(parts.labelled.observations)) if doubt]
    shown: dict[str, Any] = {"sides": sides, "stack": stack}
    labelled = _states(parts.labelled, "labelled", None, shown)
    images = labelled.observations
    goals = named(sub_goals or parts.sub_goals, labelled.labels.shape[1])
    if parts.features and (images.dtype != np.float32 or len(parts.features) != images[0].size):
        counts = f"{len(parts.features)} for {images.dtype} {images.shape[1:]}"
        raise UserError("the number of feature names is wrong", counts, "Give one for each.")
    unlabelled = _states(parts.unlabelled, "unlabelled", labelled, shown)
    names = parts.labelled.names
    if parts.heldout is not None:
        heldout = _states(parts.heldout, "held-out", labelled, shown)
        test_names = parts.heldout.names
        said += contradictions(joined([labelled, heldout]), goals, [*names, *test_names])
        do = "Hold out others, of other contexts."
        heldout = _apart(heldout, (images, unlabelled.observations), "held-out", "to learn from", do, said)
    else:
        test_names = names
        said += contradictions(labelled, goals, names)
        chosen = _held_out(labelled, parts.labelled.groups, share, seed)
        heldout, labelled = labelled.where(chosen), labelled.where(~chosen)
        do = "Give some of other contexts."
        unlabelled = _without_groups(unlabelled, parts, chosen, said)
        heldout = _apart(heldout, (labelled.observations,), "held-out", "to learn from", do, said)
        unlabelled = _apart(unlabelled, (heldout.observations,), "unlabelled", "held out", do, said)
        about = "" if parts.labelled.groups is not None else ", which says nothing about other contexts"
        said.append(f"no held-out states were given: {int(chosen.sum())} of the labelled ones are held out{about}")
    require_classes(labelled.labels, goals, None, "Give states of both kinds.")
    of_labelled = [names[row] for row in labelled.origins[ROW]]
    of_heldout = [test_names[row] for row in heldout.origins[ROW]]
    require_own_pictures(labelled, goals, of_labelled)
    said += near_duplicates(labelled, heldout, goals, (of_labelled, of_heldout))
    said += hard_to_learn(labelled.labels, goals) + hard_to_judge(heldout.labels, goals)
    sets = [replace(states, origins=_rows(len(states.labels))) for states in (labelled, unlabelled, heldout)]
    return Collected(tuple(images.shape[1:]), goals, *sets, parts.features), said


def _sources(source: Source) -> list[NDArray[Any]]:
    return [*source.values()] if isinstance(source, Mapping) else [source]


def _doubt(values: NDArray[Any]) -> str:
    """Why these values may be something else than they are taken for; empty if that is clear."""
    return "" if values.dtype.names or not values.ndim else reading_of(values.shape[1:], values.dtype).doubt


def _states(given: Given, kind: str, like: States | None, shown: Mapping[str, Any]) -> States:
    """Checked states, with their rows as origins; ``like`` are the labelled ones."""
    subject = f"the {kind} observations"
    observations = observations_of(given.observations, subject, None if like is None else like.observations, **shown)
    goals = None if like is None else like.labels.shape[1]
    if kind == "unlabelled":
        labels = np.zeros((len(observations), goals or 0), np.bool_)
    else:
        subject = "the labels" if like is None else "the held-out labels"
        labels = as_labels(np.asarray(given.labels), len(observations), subject, goals)
    return States(observations, labels, _rows(len(observations)))


def _rows(count: int) -> dict[str, NDArray[np.int64]]:
    return {ROW: np.arange(count, dtype=np.int64)}


def _apart(states: States, others: Sequence[NDArray[Any]], kind: str, role: str, do: str, said: list[str]) -> States:
    """The states of a ``kind`` that equal none of the others, whose ``role`` is for messages; none: a ``UserError``."""
    kept = leave_out(states, *others)
    count = len(states.labels)
    if len(kept.labels) < count:
        said.append(f"{count - len(kept.labels)} of {count} {kind} states look like one {role}: they are left out")
    if not len(kept.labels):
        raise UserError(f"every {kind} state looks like one {role}", None, do)
    return kept


def _without_groups(unlabelled: States, parts: Parts, chosen: NDArray[np.bool_], said: list[str]) -> States:
    """The unlabelled states that are of no held-out group."""
    groups, own = parts.labelled.groups, parts.unlabelled.groups
    if groups is None or own is None:
        return unlabelled
    kept = ~np.isin(own, groups[chosen])
    if not kept.all():
        said.append(f"{(~kept).sum()} of {len(kept)} unlabelled states are of held-out groups: they are left out")
    if not kept.any():
        raise UserError("every unlabelled state is of a held-out group", None, "Give some of other groups.")
    return unlabelled.where(kept)


def as_labels(values: NDArray[Any], count: int, subject: str, goals: int | None = None) -> NDArray[np.bool_]:
    """Labels bool (count, G); another number, or values other than 0 and 1, are a ``UserError``."""
    actual = f"{values.dtype} {values.shape}"
    columns = values[:, None] if values.ndim == 1 else values
    if columns.ndim != 2 or len(columns) != count or columns.shape[1] == 0:
        raise UserError(f"{subject} do not fit {count} states", actual, f"Give ({count},), or ({count}, sub-goals).")
    odd = np.setdiff1d(columns, (0, 1))[:3].tolist() if columns.dtype.kind in "biuf" else actual
    if odd:
        raise UserError(f"{subject} are not only 0 and 1", odd, "1 where the sub-goal holds, 0 where not.")
    if goals is not None and columns.shape[1] != goals:
        fault = f"{subject} are of {columns.shape[1]} sub-goals, not {goals}"
        raise UserError(fault, actual, "Give a column for each.")
    return columns.astype(np.bool_)


def named(sub_goals: Sequence[str], count: int) -> tuple[str, ...]:
    """The names of ``count`` sub-goals; a ``UserError`` unless there are as many plain, distinct ones."""
    names = tuple(sub_goals) or (("sub-goal",) if count == 1 else ())
    if len(names) != count:
        do = f"Give --sub-goal NAME {count} times, in the order of the labels' columns."
        raise UserError(f"{count} sub-goals need as many names", ", ".join(names) or None, do)
    require_names(names)
    return names


def _held_out(states: States, groups: NDArray[Any] | None, share: float, seed: int) -> NDArray[np.bool_]:
    """Which states are held out, bool (N,): whole groups, or without groups all that look alike."""
    if groups is not None:
        if len(groups) != len(states.labels):
            raise UserError("the groups do not fit the labelled states", f"{len(groups)} for {len(states.labels)}")
        return held_out_groups(states.labels, groups, share, seed)
    _, first, picture = np.unique(looks_of(states.observations), return_index=True, return_inverse=True)
    ordered = np.sort(first)  # each picture once, in the original order
    chosen = np.zeros(len(states.labels), np.bool_)
    chosen[ordered[held_out(states.labels[ordered], share, seed)]] = True
    return chosen[first][picture]


def held_out(labels: NDArray[np.bool_], share: float, seed: int) -> NDArray[np.bool_]:
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
        fault = f"none of {len(labels)} labelled states can be held out"
        raise UserError(fault, f"heldout={share:g}", "Give held-out states, a larger --heldout, or more labelled ones.")
    return chosen


def held_out_groups(labels: NDArray[np.bool_], groups: NDArray[Any], share: float, seed: int) -> NDArray[np.bool_]:
    """Which states are held out, bool (N,): random whole groups, up to a ``share`` of the states, at least one group.

    Positives and negatives of each sub-goal (N, G) are left; if no group can be spared, it is a ``UserError``.
    """
    names = np.unique(groups)
    chosen = np.zeros(len(labels), np.bool_)
    for name in rng_for(seed, "held-out").permutation(names):
        more = chosen | (groups == name)
        left = labels[~more]
        fits = not chosen.any() or more.sum() <= share * len(labels)
        if fits and len(left) and (left.any(axis=0) & ~left.all(axis=0)).all():
            chosen = more
    if not chosen.any():
        fault = f"none of {len(names)} groups can be held out: both classes would not be left"
        raise UserError(fault, f"heldout={share:g}", "Give more groups, or held-out states.")
    return chosen
