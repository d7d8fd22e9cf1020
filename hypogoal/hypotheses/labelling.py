"""Which unlabelled states to label next: those where members disagree, common ones, unlike each other."""

import numpy as np
from scipy.spatial import KDTree
from scipy.spatial.distance import cdist
from scipy.special import expit

from hypogoal.core.arrays import Doubles, Floats, Ints
from hypogoal.domains.observations import resized_picture
from hypogoal.hypotheses.thresholds import log_odds_of
from hypogoal.observations import (
    PICTURE,
    Observations,
    fields_of,
    numbers_of,
    spread_rows,
    standard_of,
    standardised,
)

GRID = 16  # areas along a side of a picture, whose means are compared
DIRECTIONS = 16  # of the states' largest variance
NEIGHBOURS = 10  # whose distance says how dense states are
SAMPLE = 500  # states whose usual distance is taken
COMPARED = 4_000  # unlabelled states, spread over the file


def next_to_label(states: Observations, scores: Floats, thresholds: Doubles, count: int) -> tuple[Ints, Doubles]:
    """Which of unlabelled states (N, *obs) to label next, best first, and how much members differ there.

    Those where ``scores`` (N, K) differ much, that are common and unlike those before; among ``COMPARED`` at most.
    """
    compared = spread_rows(len(states), COMPARED)
    sketches = sketches_of(states[compared])
    disputed = disagreement(scores[compared], thresholds)
    proposed = to_label(disputed * density_of(sketches), sketches, count)
    return compared[proposed], disputed[proposed]


def sketches_of(observations: Observations) -> Doubles:
    """Observations (N, *obs) as few numbers (N, D), alike where states look alike: the directions of largest variance.

    A picture counts as much as all numbers together.
    """
    numbers = numbers_of(observations)
    parts = [standardised(numbers, *standard_of(numbers.shape[1:], numbers))]
    for key, (dtype, shape) in fields_of(observations.shape[1:], observations.dtype).items():
        if dtype == PICTURE:
            height, width = np.minimum(shape[:2], GRID)
            pictures = observations[key] if key else observations
            small = [resized_picture(picture, height, width).ravel() for picture in pictures]
            parts.append(np.stack(small) / 255.0)
    weighed = [part / (np.sqrt(part.var(axis=0).sum()) or 1.0) for part in parts if part.shape[1]]
    values = np.concatenate(weighed, axis=1).astype(float)
    values -= values.mean(axis=0)
    _, directions = np.linalg.eigh(values.T @ values)
    return values @ directions[:, ::-1][:, :DIRECTIONS]


def disagreement(probabilities: Floats, thresholds: Doubles) -> Doubles:
    """How much members' predictions (N, K) differ, 0 to 1: the mean over pairs, each about its own threshold (K,).

    Of one member, which cannot disagree, its own prediction, 0.5 at its threshold: the more, the more a policy is paid.
    """
    centred = expit(log_odds_of(probabilities) - log_odds_of(thresholds))
    if centred.shape[1] == 1:
        return centred[:, 0]
    first, second = np.triu_indices(centred.shape[1], 1)
    return np.abs(centred[:, first] - centred[:, second]).mean(axis=1)


def density_of(sketches: Doubles) -> Doubles:
    """How common each state is (N,): 1 where its ten nearest are as far as usual, up to e where they are nearer."""
    neighbours = min(NEIGHBOURS + 1, len(sketches))
    distances, _ = KDTree(sketches).query(sketches, [*range(1, neighbours + 1)])
    near = distances.mean(axis=1)
    return np.exp(1 - near / (np.median(near) or 1.0))


def to_label(scores: Doubles, sketches: Doubles, count: int) -> Ints:
    """The rows of ``count`` states to label next, best first: with a high score, and unlike those before.

    The score (N,), at least 0, times how far the nearest row before is: 0 there, 1 at the usual distance of two states.
    """
    some = sketches[spread_rows(len(sketches), SAMPLE)]
    usual = np.median(cdist(some, some)) or 1.0
    rows: list[int] = []
    apart = np.ones(len(scores))
    for _ in range(min(count, len(scores))):
        worth = scores * apart
        worth[rows] = -1
        rows.append(int(worth.argmax()))
        distance = np.linalg.norm(sketches - sketches[rows[-1]], axis=1) / usual
        apart = np.minimum(apart, 1 - np.exp(-(distance**2)))
    return np.array(rows)
