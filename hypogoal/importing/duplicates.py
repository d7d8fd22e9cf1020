"""Labels of equal and nearly equal states: contradictions, and held-out pictures that are hardly new."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from hypogoal.core.errors import UserError
from hypogoal.core.terminal import amount
from hypogoal.data import States
from hypogoal.domains.observations import resized_picture
from hypogoal.observations import PICTURE, Observations, digest, spread_rows

GRID = 16  # areas along each side of a picture, whose mean brightness is compared
LEVELS = 8  # of 255: the most by which areas of nearly equal pictures differ, after equalising overall brightness
BRIGHTNESS = 32  # of 255: the most by which overall brightness differs
RULE = f"in {GRID} x {GRID} areas their brightness differs by at most {LEVELS} of 255 levels"
MOST_COMPARED = 2_000  # pictures per set, spread evenly

Looks: TypeAlias = NDArray[np.bytes_]


def looks_of(observations: Observations) -> Looks:
    """Hashes of observations (N, ...), (N,)."""
    return np.array([digest(each) for each in observations])


def contradictions(states: States, goals: Sequence[str], names: Sequence[str]) -> list[str]:
    """A line for each sub-goal with equal states whose labels differ."""
    looks = looks_of(states.observations)
    kind = "picture" if states.observations.dtype == PICTURE else "observation"
    lines = []
    for goal, column in zip(goals, states.labels.T, strict=True):
        both = np.intersect1d(looks[column], looks[~column])
        if len(both):
            count = f"{amount(len(both), kind)} {'carries' if len(both) == 1 else 'carry'}"
            pair = _pair(looks, column, both[0], names)
            lines.append(f"{count} both labels of {goal}, such as {pair}: no member can be right about both")
    return lines


def require_own_pictures(states: States, goals: Sequence[str], names: Sequence[str]) -> None:
    """Refuse (``UserError``) labels if every state of a class equals one of the other class."""
    looks = looks_of(states.observations)
    for goal, column in zip(goals, states.labels.T, strict=True):
        for kind, other, of_kind in (("positive", "negative", column), ("negative", "positive", ~column)):
            if np.isin(looks[of_kind], looks[~of_kind]).all():
                pair = _pair(looks, column, looks[of_kind][0], names)
                do = "Remove the copies whose label is wrong."
                raise UserError(f"every {kind} of {goal} is also a {other}", f"for example {pair}", do)


def near_duplicates(
    labelled: States, heldout: States, goals: Sequence[str], names: tuple[Sequence[str], Sequence[str]]
) -> list[str]:
    """A line if held-out pictures nearly equal labelled ones, and one per sub-goal whose classes have such a pair.

    Equal pictures do not count, nor do numbers. ``names``: of labelled and of held-out states.
    """
    if labelled.observations.dtype != PICTURE:
        return []
    rows = spread_rows(len(labelled.labels), MOST_COMPARED)
    test_rows = spread_rows(len(heldout.labels), MOST_COMPARED)
    sketches, tests = _sketches(labelled.observations[rows]), _sketches(heldout.observations[test_rows])
    lines = []
    nearest = _nearest(tests, sketches)
    near = np.flatnonzero(nearest >= 0)
    if len(near):
        pair = f"{names[1][test_rows[near[0]]]} and {names[0][rows[nearest[near[0]]]]}"
        text = f"{len(near)} of {len(test_rows)} held-out pictures nearly equal a labelled one, such as {pair} ({RULE})"
        lines.append(f"{text}: scores on them say little about new ones")
    looks = looks_of(labelled.observations[rows])
    for goal, column in zip(goals, labelled.labels[rows].T, strict=True):
        equal = np.isin(looks, np.intersect1d(looks[column], looks[~column]))
        positives, negatives = np.flatnonzero(column & ~equal), np.flatnonzero(~column & ~equal)
        nearest = _nearest(sketches[positives], sketches[negatives])
        near = np.flatnonzero(nearest >= 0)
        if len(near):
            pair = f"{names[0][rows[positives[near[0]]]]} and {names[0][rows[negatives[nearest[near[0]]]]]}"
            text = f"{len(near)} of {len(positives)} positives of {goal} nearly equal a negative, such as {pair}"
            lines.append(f"{text} ({RULE}): are their labels right?")
    return lines


def _pair(looks: Looks, labels: NDArray[np.bool_], look: Any, names: Sequence[str]) -> str:
    """The names of the first positive and the first negative with this hash."""
    same = looks == look
    return f"{names[np.flatnonzero(same & labels)[0]]} and {names[np.flatnonzero(same & ~labels)[0]]}"


def _sketches(pictures: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Pictures (N, H, W, C) as few numbers (N, D); nearly equal ones differ in none by more than LEVELS."""
    if pictures.shape[3] == 3:  # weighted by perceived brightness; frames stay as they are
        pictures = (pictures @ np.array([0.299, 0.587, 0.114], np.float32)).round().astype(np.uint8)[..., None]
    height, width = (min(GRID, side) for side in pictures.shape[1:3])
    small = np.stack([resized_picture(picture, height, width).ravel() for picture in pictures]).astype(np.float32)
    brightness = small.mean(1, keepdims=True)
    return np.concatenate([small - brightness, brightness * (LEVELS / BRIGHTNESS)], axis=1)


def _nearest(sketches: NDArray[np.float32], others: NDArray[np.float32]) -> NDArray[np.int64]:
    """For each of the sketches (N, D) the row of its nearest of the others (M, D), -1 if none is nearly equal."""
    from scipy.spatial import KDTree

    if not len(sketches) or not len(others):
        return np.full(len(sketches), -1)
    distances, rows = KDTree(others).query(sketches, p=np.inf, distance_upper_bound=LEVELS + 0.5)
    return np.where(np.isfinite(distances), rows, -1)
