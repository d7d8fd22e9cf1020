"""Users' states, checked and split into the sets of a data file."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from hypogoal.core.errors import UserError
from hypogoal.core.seeding import rng_for
from hypogoal.data import Collected, States, hard_to_judge, hard_to_learn, leave_out, require_classes, require_names
from hypogoal.domains.observations import CLEARLY, reading_of, shrunk_picture
from hypogoal.observations import NUMBERS, PICTURE, packed, type_text
from hypogoal.own_data.supervision import contradictions, looks_of, near_duplicates, require_own_pictures

# Pictures (N, H, W, C) or (N, H, W), or numbers (N, *shape); such arrays by key; or mixed observations (N,).
Source: TypeAlias = NDArray[Any] | Mapping[str, NDArray[Any]]
Resize: TypeAlias = int | Mapping[str, int]  # most pixels on the longer side, 0: any; or by key, "" for other pictures
STACKED = "'import --stack' puts stacked frames among the channels."


@dataclass(frozen=True)
class Parts:
    """States as read, unchecked. Without held-out states, a share of the labelled ones will be held out."""

    observations: Source  # labelled
    labels: NDArray[Any]  # (N,) or (N, G)
    unlabelled: Source  # (M, ...)
    heldout_observations: Source | None = None
    heldout_labels: NDArray[Any] | None = None
    sub_goals: tuple[str, ...] = ()  # their names, if the source has them
    features: tuple[str, ...] = ()  # names of the numbers
    name: Callable[[str, int], str] = "{}[{}]".format  # names a state, by its field and row, in messages


def collected_of(
    parts: Parts,
    sub_goals: Sequence[str],
    *,
    share: float = 0.2,
    seed: int = 0,
    resize: Resize = 0,
    stack: bool = False,
) -> tuple[Collected, list[str]]:
    """The states in the form of a data file, and lines that warn of what is allowed but may surprise.

    The name of a single sub-goal is optional. Without held-out states, a ``share`` of each class of the labelled ones
    is held out by ``seed``. ``resize`` and ``stack``: see :func:`as_observations`. Unusable states, and a class that is
    missing or only has pictures that the other class has too, are a ``UserError``.
    """
    warned: list[str] = []
    images = as_observations(parts.observations, "the labelled observations", resize=resize, stack=stack)
    sources = parts.observations.values() if isinstance(parts.observations, Mapping) else [parts.observations]
    for source in sources:
        doubt = "" if source.dtype.names else reading_of(source.shape[1:], source.dtype).doubt
        if doubt:
            warned.append(doubt)
    if parts.features and (images.dtype != np.float32 or len(parts.features) != images[0].size):
        counts = f"{len(parts.features)} for {images.dtype} {images.shape[1:]}"
        raise UserError("the number of feature names is wrong", counts, "Give one for each.")
    shape = images.shape[1:]
    labelled = States(images, as_labels(parts.labels, len(images), "the labels"), _rows(images))
    goals = named(sub_goals or parts.sub_goals, labelled.labels.shape[1])
    unlabelled = as_observations(parts.unlabelled, "the unlabelled observations", images, resize=resize, stack=stack)
    bare = States(unlabelled, np.zeros((len(unlabelled), len(goals)), np.bool_), _rows(unlabelled))
    looks, kind = looks_of(images), "picture" if images.dtype == PICTURE else "observation"
    names = partial(parts.name, "observations"), partial(parts.name, "heldout_observations")
    if parts.heldout_observations is not None and parts.heldout_labels is not None:
        heldout = parts.heldout_observations
        heldout = as_observations(heldout, "the held-out observations", images, resize=resize, stack=stack)
        heldout_labels = as_labels(parts.heldout_labels, len(heldout), "the held-out labels", len(goals))
        test = States(heldout, heldout_labels, _rows(heldout))
        every = np.concatenate([looks, looks_of(heldout)]), np.concatenate([labelled.labels, heldout_labels])
        warned += contradictions(*every, goals, _one_after_another(len(images), *names), kind=kind)
        do = "Hold out others, of other contexts."
        test = _apart(test, (images, unlabelled), "held-out", "to learn from", do, warned)
    else:
        warned += contradictions(looks, labelled.labels, goals, names[0], kind=kind)
        _, first, picture = np.unique(looks, return_index=True, return_inverse=True)
        ordered = np.sort(first)  # each picture once, in the original order
        chosen = np.zeros(len(images), np.bool_)
        chosen[ordered[held_out(labelled.labels[ordered], share, seed)]] = True
        chosen = chosen[first][picture]  # with all states that look like a held-out one
        test, labelled, looks = labelled.where(chosen), labelled.where(~chosen), looks[~chosen]
        names = names[0], names[0]
        do = "Give some of other contexts."
        bare = _apart(bare, (test.observations,), "unlabelled", "held out", do, warned)
        warned.append(
            f"no held-out states were given: {int(chosen.sum())} of the labelled ones are held out, which says nothing "
            "about other contexts"
        )
    require_classes(labelled.labels, goals, None, "Give states of both kinds.")
    of_labelled, of_test = _of_rows(labelled, names[0]), _of_rows(test, names[1])
    require_own_pictures(looks, labelled.labels, goals, of_labelled)
    warned += near_duplicates(labelled, test, goals, (of_labelled, of_test))
    warned += hard_to_learn(labelled.labels, goals) + hard_to_judge(test.labels, goals)
    numbered = [replace(states, origins=_rows(states.labels)) for states in (labelled, bare, test)]
    return Collected(tuple(shape), goals, numbered[0], numbered[1], numbered[2], parts.features), warned


def _rows(states: NDArray[Any]) -> dict[str, NDArray[np.int64]]:
    return {"row": np.arange(len(states), dtype=np.int64)}


def _of_rows(states: States, name: Callable[[int], str]) -> Callable[[int], str]:
    """The names of states that are a selection of the original ones."""
    return lambda index: name(int(states.origins["row"][index]))


def _one_after_another(count: int, first: Callable[[int], str], second: Callable[[int], str]) -> Callable[[int], str]:
    """The names of ``count`` states followed by others."""
    return lambda index: first(index) if index < count else second(index - count)


def _apart(states: States, others: Sequence[NDArray[Any]], kind: str, role: str, do: str, warned: list[str]) -> States:
    """The states of a ``kind`` that equal none of the others, whose ``role`` is for messages; none: a ``UserError``."""
    kept = leave_out(states, *others)
    count = len(states.labels)
    if len(kept.labels) < count:
        twice = f"{count - len(kept.labels)} of {count} {kind} states"
        warned.append(f"{twice} look like one {role}: they are left out")
    if not len(kept.labels):
        raise UserError(f"every {kind} state looks like one {role}", None, do)
    return kept


def as_observations(
    values: Source, subject: str, like: NDArray[Any] | None = None, *, resize: Resize = 0, stack: bool = False
) -> NDArray[Any]:
    """Pictures uint8 (N, H, W, C) or numbers float32 (N, *shape), told apart by ``hypogoal.domains.observations``.

    Arrays by key become mixed observations. ``stack``: axes of frames and colours become channels. ``resize``: at most
    so many pixels on the longer side. Values that are neither, an empty array, and a shape or type that differs from
    ``like`` are a ``UserError``.
    """
    if isinstance(values, Mapping):
        parts = {}
        for key, part in values.items():
            size = resize_of(resize, key, picture=part.dtype == PICTURE and part.ndim > 2)
            parts[key] = as_observations(part, f"{subject} {key!r}", resize=size, stack=stack)
        try:
            values = packed(parts)
        except ValueError as error:
            do = "Give as many states of each key, and keys that can be file names."
            raise UserError(f"{subject} do not fit together", error, do) from None
    elif not values.dtype.names:
        values = _of_one_kind(values, subject, resize_of(resize, "", picture=True), stack)
    if like is not None and (values.shape[1:], values.dtype) != (like.shape[1:], like.dtype):
        difference = f"{type_text(values.dtype)} {values.shape[1:]}, not {type_text(like.dtype)} {like.shape[1:]}"
        raise UserError(f"{subject} differ in shape or type from the labelled ones", difference)
    return np.ascontiguousarray(values)


def resize_of(resize: Resize, key: str, *, picture: bool) -> int:
    """What ``resize`` says of a key; what it says of all others holds for pictures only."""
    by_key = resize if isinstance(resize, Mapping) else {"": resize}
    return by_key.get(key, by_key.get("", 0) if picture else 0)


def _of_one_kind(values: NDArray[Any], subject: str, resize: int, stack: bool) -> NDArray[Any]:
    """Pictures or numbers, see :func:`as_observations`."""
    actual = f"{values.dtype} {values.shape}"
    if values.dtype.kind not in "iufb" or values.ndim < 2 or 0 in values.shape[1:]:
        do = "Give images (N, height, width, channels), or numbers (N, ...)."
        raise UserError(f"{subject} are not observations", actual, do)
    if not len(values):
        raise UserError(f"{subject} are empty", actual, "Give some; unlabelled ones from other contexts.")
    reading = reading_of(values.shape[1:], values.dtype)
    stackable = len(reading.axes) > 2
    if reading.fault and not (stack and stackable):
        raise UserError(f"{subject} {reading.fault}", actual, f"{CLEARLY} {STACKED}" if stackable else CLEARLY)
    if reading.dtype == PICTURE:
        values = reading.arranged(values)
        if resize and max(values.shape[1:3]) > resize:
            values = np.stack([shrunk_picture(picture, resize) for picture in values])
    elif resize:
        raise UserError("only pictures can be resized", actual, "Leave out --resize.")
    else:
        values = values.astype(NUMBERS, copy=False)
        if not np.isfinite(values).all():
            raise UserError(f"{subject} have numbers that are not finite", actual, "Give finite ones.")
    return values


def as_labels(values: NDArray[Any], count: int, subject: str, goals: int | None = None) -> NDArray[np.bool_]:
    """Labels bool (count, G); another number, or values other than 0 and 1, are a ``UserError``."""
    actual = f"{values.dtype} {values.shape}"
    columns = values[:, None] if values.ndim == 1 else values
    if columns.ndim != 2 or len(columns) != count or columns.shape[1] == 0:
        raise UserError(f"{subject} do not fit {count} states", actual, f"Give ({count},), or ({count}, sub-goals).")
    numbers = columns.dtype.kind in "biuf"
    odd = np.setdiff1d(columns, (0, 1))[:3].tolist() if numbers else actual
    if odd:
        raise UserError(f"{subject} are not only 0 and 1", odd, "1 where the sub-goal holds, 0 where not.")
    if goals is not None and columns.shape[1] != goals:
        raise UserError(
            f"{subject} are of {columns.shape[1]} sub-goals, not {goals}", actual, "Give a column for each."
        )
    return columns.astype(np.bool_)


def named(sub_goals: Sequence[str], count: int) -> tuple[str, ...]:
    """The names of ``count`` sub-goals; a ``UserError`` unless there are as many plain, distinct ones."""
    names = tuple(sub_goals) or (("sub-goal",) if count == 1 else ())
    if len(names) != count:
        do = f"Give --sub-goal NAME {count} times, in the order of the labels' columns."
        raise UserError(f"{count} sub-goals need as many names", ", ".join(names) or None, do)
    require_names(names)
    return names


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
