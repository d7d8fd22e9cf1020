"""What recorded states say about a success classifier, without a simulator: where members disagree, which failures a
policy would be drawn to, what a prediction hangs on, and which states to label next (Spec I6).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations, pairwise, product
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree
from scipy.spatial.distance import cdist

from hypogoal.data import States
from hypogoal.domains.observations import resized_picture
from hypogoal.evaluation.pictures import coloured
from hypogoal.hypotheses.thresholds import log_odds_of
from hypogoal.observations import PICTURE, Observations, fields_of, numbers_of, spread_rows, standard_of, standardised

GRID = 16  # areas along a side of a picture, whose means are compared
DIRECTIONS = 16  # of the states' largest variance
NEIGHBOURS = 10  # whose distance says how dense states are
SAMPLE = 500  # states whose usual distance is taken
PATCHES = 6  # along a side of a picture
FRAME = (240, 160, 0)  # around the patch that turns a prediction
Predict = Callable[[Observations], NDArray[np.floating]]  # observations (N, *obs) -> probabilities (N, K)


def sketches_of(observations: Observations) -> NDArray[np.float64]:
    """Observations (N, *obs) as few numbers (N, D), alike where states look alike: the directions of largest variance.

    A picture counts as much as all numbers together.
    """
    numbers = numbers_of(observations)
    parts = [standardised(numbers, *standard_of(numbers.shape[1:], numbers))]
    for key, (dtype, shape) in fields_of(observations.shape[1:], observations.dtype).items():
        if dtype == PICTURE:
            pictures = observations[key] if key else observations
            sides = [min(GRID, side) for side in shape[:2]]
            parts.append(np.stack([resized_picture(picture, *sides).ravel() for picture in pictures]) / 255.0)
    weighed = [part / (np.sqrt(part.var(0).sum()) or 1.0) for part in parts if part.shape[1]]
    values = np.concatenate(weighed, axis=1).astype(np.float64)
    values -= values.mean(0)
    _, directions = np.linalg.eigh(values.T @ values)
    return values @ directions[:, ::-1][:, :DIRECTIONS]


def disagreement(probabilities: NDArray[np.floating], thresholds: NDArray[np.floating]) -> NDArray[np.float64]:
    """How much members' predictions (N, K) differ, 0 to 1: the mean over pairs, each about its own threshold (K,).

    Of one member, which cannot disagree, its own prediction, 0.5 at its threshold: the more, the more a policy is paid.
    """
    centred = 1 / (1 + np.exp(log_odds_of(thresholds) - log_odds_of(probabilities)))
    if centred.shape[1] == 1:
        return np.asarray(centred[:, 0])
    pairs = combinations(range(centred.shape[1]), 2)
    return np.mean([np.abs(centred[:, first] - centred[:, second]) for first, second in pairs], axis=0)


def density_of(sketches: NDArray[np.float64]) -> NDArray[np.float64]:
    """How common each state is (N,): 1 where its ten nearest are as far as usual, up to e where they are nearer."""
    neighbours = min(NEIGHBOURS + 1, len(sketches))
    near = KDTree(sketches).query(sketches, neighbours)[0].reshape(len(sketches), -1).mean(1)
    density: NDArray[np.float64] = np.exp(1 - near / (np.median(near) or 1.0))
    return density


def to_label(scores: NDArray[np.float64], sketches: NDArray[np.float64], count: int) -> NDArray[np.int64]:
    """The rows of ``count`` states to label next, best first: with a high score, and unlike those before.

    The score (N,), at least 0, times how far the nearest row before is: 0 there, 1 at the usual distance of two states.
    """
    some = sketches[spread_rows(len(sketches), SAMPLE)]
    usual = float(np.median(cdist(some, some))) or 1.0
    rows: list[int] = []
    apart = np.ones(len(scores))
    for _ in range(min(count, len(scores))):
        remaining = np.where(np.isin(np.arange(len(scores)), rows), -1.0, scores * apart)
        rows.append(int(remaining.argmax()))
        distance = np.linalg.norm(sketches - sketches[rows[-1]], axis=1) / usual
        apart = np.minimum(apart, 1 - np.exp(-(distance**2)))
    return np.array(rows, np.int64)


def tempting(states: States, probabilities: NDArray[np.floating], count: int) -> NDArray[np.int64]:
    """The rows of the negatives that a member scores (N,) highest, highest first: where a policy would be drawn to."""
    negatives = np.flatnonzero(~states.labels)
    return negatives[np.argsort(-probabilities[negatives], kind="stable")][:count]


def opposite_pairs(
    sketches: NDArray[np.float64], positive: NDArray[np.bool_], count: int
) -> list[tuple[int, int, float]]:
    """The nearest states with opposite predictions (N,): rows of a positive and a negative, distance; each once."""
    positives, negatives = np.flatnonzero(positive), np.flatnonzero(~positive)
    if not len(positives) or not len(negatives):
        return []
    distances, nearest = KDTree(sketches[negatives]).query(sketches[positives])
    pairs, taken = [], set()
    for row in np.argsort(distances, kind="stable"):
        if (other := int(negatives[nearest[row]])) not in taken:
            taken.add(other)
            pairs.append((int(positives[row]), other, float(distances[row])))
    return pairs[:count]


@dataclass(frozen=True)
class Turned:
    """The patch whose exchange lowers a member's probability most."""

    key: str  # of the picture, empty if it is the whole observation
    box: tuple[int, int, int, int]  # top, left, bottom, right: pixels
    before: float
    after: float


def turning_patch(state: Observations, other: Observations, member: int, predict: Predict) -> Turned | None:
    """Which of 6 x 6 patches of ``state`` (*obs) says most of a member's positive prediction: exchanged for the same
    patch of ``other`` (*obs), it lowers the probability most. None without pictures.
    """
    boxes = []
    for key, (dtype, shape) in fields_of(state.shape, state.dtype).items():
        if dtype == PICTURE:
            rows, columns = (np.linspace(0, side, min(PATCHES, side) + 1).astype(int).tolist() for side in shape[:2])
            patches = product(pairwise(rows), pairwise(columns))
            boxes += [(key, (top, left, bottom, right)) for (top, bottom), (left, right) in patches]
    changed = np.repeat(state[None], len(boxes) + 1, axis=0)
    for number, (key, (top, left, bottom, right)) in enumerate(boxes):
        pictures, source = (changed[key], other[key]) if key else (changed, other)
        pictures[number, top:bottom, left:right] = source[top:bottom, left:right]
    if not boxes:
        return None
    *after, before = predict(changed)[:, member].tolist()
    lowest = int(np.argmin(after))
    return Turned(*boxes[lowest], before, after[lowest])


def picture_of(state: Observations, turned: Turned | None = None) -> NDArray[np.uint8] | None:
    """A state's pictures side by side, uint8 (H, W, 3), the patch that turned a prediction framed; None without any."""
    parts = []
    for key, (dtype, _) in fields_of(state.shape, state.dtype).items():
        if dtype == PICTURE:
            picture = coloured(np.array(state[key] if key else state))
            if turned and key == turned.key:
                top, left, bottom, right = turned.box
                width = max(1, max(picture.shape[:2]) // 64)
                inside = picture[top:bottom, left:right]
                for edge in (inside[:width], inside[-width:], inside[:, :width], inside[:, -width:]):
                    edge[:] = FRAME
            parts.append(picture)
    if not parts:
        return None
    height = max(len(part) for part in parts)
    padded = [np.pad(part, ((0, height - len(part)), (0, 0), (0, 0)), constant_values=255) for part in parts]
    return np.concatenate(padded, axis=1)


def member_findings(
    labelled: States, known_scores: NDArray[np.floating], scores: NDArray[np.floating], thresholds: Sequence[float]
) -> list[dict[str, Any]]:
    """A row for each member: its false positives among known states (N, K), its predictions of others (M, K)."""
    positive, rows = scores > np.asarray(thresholds), []
    negatives = ~labelled.labels
    for member, threshold in enumerate(thresholds):
        wrong = known_scores[negatives, member] > threshold
        others = np.delete(positive, member, axis=1).any(1)
        rows.append(
            {
                "member": member,
                "threshold": float(threshold),
                "negatives": int(negatives.sum()),
                "false_positives": int(wrong.sum()),
                "highest_negative": float(known_scores[negatives, member].max(initial=0.0)),
                "positive_unlabelled": float(positive[:, member].mean()),
                "positive_alone": float((positive[:, member] & ~others).mean()),
            }
        )
    return rows
