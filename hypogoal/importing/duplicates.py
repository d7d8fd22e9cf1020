"""Labels of equal and nearly equal states: contradictions, and held-out pictures that are hardly new."""

from collections.abc import Sequence

import numpy as np

from hypogoal.core.errors import UserError
from hypogoal.core.terminal import amount
from hypogoal.data import Integers, States
from hypogoal.domains.observations import resized_picture
from hypogoal.importing.parts import Array
from hypogoal.observations import PICTURE, Observations, digest, spread_rows

GRID = 16  # areas along each side of a picture, whose mean brightness is compared
LEVELS = 8  # of 255: the most by which areas of nearly equal pictures differ, after equalising overall brightness
BRIGHTNESS = 32  # of 255: the most by which overall brightness differs
RULE = f"in {GRID} x {GRID} areas their brightness differs by at most {LEVELS} of 255 levels"
MOST_COMPARED = 2_000  # pictures per set, spread evenly
GREY = np.array([0.299, 0.587, 0.114], np.float32)  # perceived brightness of red, green and blue


def looks_of(observations: Observations) -> Array:
    """Hashes of observations (N, ...), (N,)."""
    return np.array([digest(each) for each in observations])


def contradictions(states: States, goals: Sequence[str], names: Sequence[str]) -> list[str]:
    """A line for each sub-goal with equal states whose labels differ; a ``UserError`` if a class has no others."""
    looks = looks_of(states.observations)
    kind = "picture" if states.observations.dtype == PICTURE else "observation"
    lines = []
    for goal, column in zip(goals, states.labels.T, strict=True):
        both = np.intersect1d(looks[column], looks[~column])
        if not len(both):
            continue
        equal = looks == both[0]
        pair = f"{names[int(np.argmax(equal & column))]} and {names[int(np.argmax(equal & ~column))]}"
        for of_kind, side, other in ((column, "positive", "negative"), (~column, "negative", "positive")):
            if np.isin(looks[of_kind], both).all():
                do = "Remove the copies whose label is wrong."
                raise UserError(f"every {side} of {goal} is also a {other}", f"for example {pair}", do)
        carry = f"{amount(len(both), kind)} {'carries' if len(both) == 1 else 'carry'}"
        lines.append(f"{carry} both labels of {goal}, such as {pair}: no member can be right about both")
    return lines


class _Sketched:
    """Some pictures of a set as few numbers (N, D); nearly equal ones differ in none by more than ``LEVELS``."""

    def __init__(self, states: States, names: Sequence[str]):
        rows = spread_rows(len(states.labels), MOST_COMPARED)
        pictures = states.observations[rows]
        self.names, self.labels, self.looks = np.array(names)[rows], states.labels[rows], looks_of(pictures)
        if pictures.shape[3] == 3:  # frames stay as they are
            pictures = (pictures @ GREY).round().astype(np.uint8)[..., None]
        sides = [min(GRID, side) for side in pictures.shape[1:3]]
        small = np.stack([resized_picture(picture, *sides).ravel() for picture in pictures]).astype(np.float32)
        brightness = small.mean(1, keepdims=True)
        self.sketches = np.concatenate([small - brightness, brightness * (LEVELS / BRIGHTNESS)], axis=1)


def near_duplicates(
    labelled: States, heldout: States, goals: Sequence[str], names: Sequence[Sequence[str]]
) -> list[str]:
    """A line if held-out pictures nearly equal labelled ones, and one per sub-goal whose classes have such a pair.

    Equal pictures do not count, nor do numbers. ``names``: of labelled and of held-out states.
    """
    if labelled.observations.dtype != PICTURE:
        return []
    learned, tests = _Sketched(labelled, names[0]), _Sketched(heldout, names[1])
    every = np.arange(len(tests.names)), np.arange(len(learned.names))
    remarks = [
        _near(tests, learned, *every, "held-out pictures", "labelled one", "scores on them say little about new ones")
    ]
    for goal, column in zip(goals, learned.labels.T, strict=True):
        equal = np.isin(learned.looks, np.intersect1d(learned.looks[column], learned.looks[~column]))
        positives, negatives = np.flatnonzero(column & ~equal), np.flatnonzero(~column & ~equal)
        of_goal = f"positives of {goal}", "negative", "are their labels right?"
        remarks.append(_near(learned, learned, positives, negatives, *of_goal))
    return [line for line in remarks if line]


def _near(
    some: _Sketched, others: _Sketched, rows: Integers, other_rows: Integers, kind: str, other: str, so: str
) -> str:
    """How many of some pictures nearly equal one of the others, and a pair of them; empty if none does."""
    from scipy.spatial import KDTree

    if not len(rows) or not len(other_rows):
        return ""
    tree = KDTree(others.sketches[other_rows])
    distances, nearest = tree.query(some.sketches[rows], p=np.inf, distance_upper_bound=LEVELS + 0.5)
    near = np.flatnonzero(np.isfinite(distances))
    if not len(near):
        return ""
    pair = f"{some.names[rows[near[0]]]} and {others.names[other_rows[nearest[near[0]]]]}"
    return f"{len(near)} of {len(rows)} {kind} nearly equal a {other}, such as {pair} ({RULE}): {so}"
