"""Spec H1: how well members separate planted factors. Pure functions of their probabilities on crossed states."""

from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from hypogoal.core.rounding import at_least
from hypogoal.hypotheses.scores import best_threshold, member_scores, ranking

THRESHOLD = 0.5  # probability above which a member's prediction is positive
ORDERS = 200  # random orders in which states are labelled
MOST_LABELS = 100
SURE = 0.9  # required probability of picking the right member
NEAR = 0.01  # in ranking: members this near to the best one are right, too

Table = NDArray[np.float64]  # (K, F)


def rankings(probabilities: NDArray[np.float32], factors: NDArray[np.bool_]) -> Table:
    """Area under the ROC curve of every member (N, K) on every factor (N, F), float64 (K, F).

    Every combination of factors is equally frequent, so .5 means that a member is blind to a factor.
    """
    return np.stack([ranking(probabilities, truth) for truth in factors.T], axis=1)


def balanced_accuracies(probabilities: NDArray[np.float32], factors: NDArray[np.bool_]) -> tuple[Table, Table]:
    """Balanced accuracy of every member on every factor, (K, F): at 0.5, and at the best threshold."""
    predictions = probabilities > THRESHOLD
    plain = [member_scores(predictions, truth)["balanced_accuracy"] for truth in factors.T]
    best = [best_threshold(probabilities, truth)[1] for truth in factors.T]
    return np.stack(plain, axis=1), np.stack(best, axis=1)


def owned(ranked: Table, high: float = 0.95, low: float = 0.6) -> NDArray[np.bool_]:
    """Which member owns which factor, bool (K, F): it ranks by this factor, at least ``high``, and by no other.

    By no other, neither way round: all others lie within 1 - ``low`` and ``low``. ``ranked``, ``high`` and ``low``
    (at least .5) are areas under the ROC curve, see :func:`rankings`.
    """
    separated, ignored = at_least(ranked, high), at_least(low - 0.5, np.abs(ranked - 0.5))
    return separated & (ignored.sum(axis=1, keepdims=True) == ranked.shape[1] - 1)


def redundancy(ranked: Table) -> float:
    """The share of pairs of members that rank most by the same factor, either way round; NaN for one member.

    Members with random factors have 1 / F.
    """
    most = np.abs(ranked - 0.5).argmax(axis=1)
    same = [most[a] == most[b] for a, b in combinations(range(len(most)), 2)]
    return float(np.mean(same)) if same else float("nan")


def calibration_gap(ranked: Table, at_half: Table, at_best: Table) -> float:
    """Balanced accuracy at the best threshold minus that at 0.5, on each member's best factor; mean over members."""
    rows, best = np.arange(len(ranked)), ranked.argmax(axis=1)
    return float((at_best - at_half)[rows, best].mean())


def labels_needed(
    probabilities: NDArray[np.float32], factors: NDArray[np.bool_], ranked: Table, rng: np.random.Generator
) -> NDArray[np.int64]:
    """How many labels identify the right member, for each factor as the true one.

    States are labelled one by one in random order. The member whose predictions at 0.5 agree with most labels so far is
    picked, ties at random. The right members are those that rank the true factor best, up to ``NEAR``.

    Of probabilities (N, K) on factors (N, F) and :func:`rankings` (K, F) gives int64 (F,): the least number of labels
    from which on, up to ``MOST_LABELS`` (or N), the pick is right with a probability of ``SURE``; 0 if no label is
    needed, one more than the most if they do not suffice.
    """
    predictions = probabilities > THRESHOLD
    most = min(MOST_LABELS, len(predictions))
    orders = np.stack([rng.permutation(len(predictions))[:most] for _ in range(ORDERS)])  # (R, n)
    right = at_least(ranked, ranked.max(axis=0) - NEAR)  # (K, F)
    needed = []
    for factor, truth in enumerate(factors.T):
        hits = (predictions == truth[:, None])[orders].cumsum(axis=1)  # (R, n, K)
        picked = hits == hits.max(axis=2, keepdims=True)
        sure = (picked & right[:, factor]).sum(axis=2) / picked.sum(axis=2)
        probability = np.concatenate([[right[:, factor].mean()], sure.mean(axis=0)])
        failing = np.flatnonzero(~at_least(probability, SURE))
        needed.append(failing[-1] + 1 if len(failing) else 0)
    return np.array(needed, dtype=np.int64)
