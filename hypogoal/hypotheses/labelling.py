"""Choice of the unlabelled states to label next.

States are chosen on which members disagree, and that are common and unlike each other.
"""

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

GRID = 16  # a picture is compared by the means of GRID x GRID areas
DIRECTIONS = 16  # the number of directions of largest variance that a sketch keeps
NEIGHBOURS = 10  # the number of nearest states whose distance says how dense states are
SAMPLE = 500  # the number of states from which the usual distance is computed
COMPARED = 4_000  # the largest number of unlabelled states that are compared, spread over the file


def next_to_label(states: Observations, scores: Floats, thresholds: Doubles, count: int) -> tuple[Ints, Doubles]:
    """Choose ``count`` of the unlabelled states (N, *obs) to label next.

    States are proposed where the members' ``scores``, probabilities (N, K), differ much. Proposed states are common,
    and unlike the states proposed before. At most ``COMPARED`` of the states are looked at. ``thresholds`` (K,) are the
    members' thresholds.

    Returns:
        The indices of the proposed states, best first, int64 (n,), and how much members differ there, float64 (n,).
    """
    compared = spread_rows(len(states), COMPARED)
    sketches = sketches_of(states[compared])
    disputed = disagreement(scores[compared], thresholds)
    proposed = to_label(disputed * density_of(sketches), sketches, count)
    return compared[proposed], disputed[proposed]


def sketches_of(observations: Observations) -> Doubles:
    """Return sketches, float64 (N, D): few numbers for each observation, alike where the states look alike.

    A sketch is the projection of an observation onto the directions of largest variance. A picture counts as much as
    all numbers together.
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
    """Return how much the members' probabilities (N, K) differ, 0 to 1, float64 (N,).

    The disagreement is the mean over pairs of members, and each member's probability is taken relative to the member's
    own threshold (K,). A single member cannot disagree. For a single member the result is its probability, shifted to
    be 0.5 at the threshold, because a policy is paid more the higher that probability is.
    """
    centred = expit(log_odds_of(probabilities) - log_odds_of(thresholds))
    if centred.shape[1] == 1:
        return centred[:, 0]
    first, second = np.triu_indices(centred.shape[1], 1)
    return np.abs(centred[:, first] - centred[:, second]).mean(axis=1)


def density_of(sketches: Doubles) -> Doubles:
    """Return how common each state is, float64 (N,).

    The density is 1 where the ten nearest states are as far away as usual, and rises to e where they are nearer.
    """
    neighbours = min(NEIGHBOURS + 1, len(sketches))
    distances, _ = KDTree(sketches).query(sketches, [*range(1, neighbours + 1)])
    near = distances.mean(axis=1)
    return np.exp(1 - near / (np.median(near) or 1.0))


def to_label(scores: Doubles, sketches: Doubles, count: int) -> Ints:
    """Return the indices of ``count`` states to label next, best first, int64 (n,).

    States are picked that have a high score and are unlike the states picked before. The score (N,), at least 0, is
    multiplied by a number that grows with the distance to the nearest picked state: 0 at no distance, 0.63 at the usual
    distance of two states, 1 far away.
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
