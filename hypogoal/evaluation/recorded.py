"""What recorded states say about members, without a simulator: where these disagree, which failures they take for a
success, and which states to label next (Spec I6).
"""

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.spatial import KDTree
from scipy.spatial.distance import cdist
from scipy.special import expit

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
            small = [resized_picture(picture, *sides).ravel() for picture in pictures]
            parts.append(np.stack(small) / 255.0)
    weighed = [part / (np.sqrt(part.var(axis=0).sum()) or 1.0) for part in parts if part.shape[1]]
    values = np.concatenate(weighed, axis=1).astype(np.float64)
    values -= values.mean(axis=0)
    _, directions = np.linalg.eigh(values.T @ values)
    return values @ directions[:, ::-1][:, :DIRECTIONS]


def disagreement(probabilities: NDArray[np.floating], thresholds: NDArray[np.floating]) -> NDArray[np.float64]:
    """How much members' predictions (N, K) differ, 0 to 1: the mean over pairs, each about its own threshold (K,).

    Of one member, which cannot disagree, its own prediction, 0.5 at its threshold: the more, the more a policy is paid.
    """
    centred = np.asarray(expit(log_odds_of(probabilities) - log_odds_of(thresholds)))
    if centred.shape[1] == 1:
        return centred[:, 0]
    first, second = np.triu_indices(centred.shape[1], 1)
    return np.abs(centred[:, first] - centred[:, second]).mean(axis=1)


def density_of(sketches: NDArray[np.float64]) -> NDArray[np.float64]:
    """How common each state is (N,): 1 where its ten nearest are as far as usual, up to e where they are nearer."""
    neighbours = min(NEIGHBOURS + 1, len(sketches))
    near = KDTree(sketches).query(sketches, neighbours)[0].reshape(len(sketches), -1).mean(axis=1)
    return np.asarray(np.exp(1 - near / (np.median(near) or 1.0)))


def to_label(scores: NDArray[np.float64], sketches: NDArray[np.float64], count: int) -> NDArray[np.int64]:
    """The rows of ``count`` states to label next, best first: with a high score, and unlike those before.

    The score (N,), at least 0, times how far the nearest row before is: 0 there, 1 at the usual distance of two states.
    """
    some = sketches[spread_rows(len(sketches), SAMPLE)]
    usual = float(np.median(cdist(some, some))) or 1.0
    rows: list[int] = []
    apart = np.ones(len(scores))
    for _ in range(min(count, len(scores))):
        worth = scores * apart
        worth[rows] = -1
        rows.append(int(worth.argmax()))
        distance = np.linalg.norm(sketches - sketches[rows[-1]], axis=1) / usual
        apart = np.minimum(apart, 1 - np.exp(-(distance**2)))
    return np.array(rows, np.int64)


def member_table(
    labels: NDArray[np.bool_],
    known_scores: NDArray[np.floating],
    scores: NDArray[np.floating],
    thresholds: NDArray[np.floating],
) -> pd.DataFrame:
    """A row for each member: its false positives among known states (N, K), its predictions of others (M, K)."""
    positive = scores > thresholds
    alone = positive & (positive.sum(axis=1, keepdims=True) == 1)
    of_failures = known_scores[~labels]
    return pd.DataFrame(
        {
            "member": np.arange(len(thresholds)),
            "threshold": thresholds.astype(np.float64),
            "negatives": len(of_failures),
            "false_positives": (of_failures > thresholds).sum(axis=0),
            "highest_negative": of_failures.max(axis=0, initial=0.0).astype(np.float64),
            "positive_unlabelled": positive.mean(axis=0),
            "positive_alone": alone.mean(axis=0),
        }
    )
