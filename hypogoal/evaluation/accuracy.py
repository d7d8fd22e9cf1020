"""How well members' verdicts match the true sub-goal (Spec F1), and how different they are (Spec F2)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.stats import rankdata

Scores = dict[str, NDArray[np.float64]]
METRICS = ("balanced_accuracy", "precision", "recall", "accuracy", "f1")


def member_scores(verdicts: NDArray[np.bool_], labels: NDArray[np.bool_]) -> Scores:
    """Spec F1: every member's scores on labelled states.

    Args:
        verdicts: bool (N, K), member k says that the sub-goal is reached.
        labels: bool (N,), it is.

    Returns:
        For each name in ``METRICS`` float64 (K,), fractions. NaN where a score is not defined: balanced accuracy and
        recall without positives (or, the former, negatives), precision of a member that never says yes, anything
        without states.

    Raises:
        ValueError: the numbers of states differ.
    """
    if verdicts.shape[0] != labels.shape[0]:
        raise ValueError(f"{verdicts.shape[0]} verdicts for {labels.shape[0]} labels")
    truth = labels.astype(np.bool_)[:, None]
    hits = (verdicts & truth).sum(0)
    false_alarms = (verdicts & ~truth).sum(0)
    misses = (~verdicts & truth).sum(0)
    rejections = (~verdicts & ~truth).sum(0)
    recall = _ratio(hits, hits + misses)
    return {
        "balanced_accuracy": (recall + _ratio(rejections, rejections + false_alarms)) / 2,
        "precision": _ratio(hits, hits + false_alarms),
        "recall": recall,
        "accuracy": _ratio(hits + rejections, np.full_like(hits, len(labels))),
        "f1": _ratio(2 * hits, 2 * hits + false_alarms + misses),
    }


def ranking(probabilities: NDArray[np.float32], labels: NDArray[np.bool_]) -> NDArray[np.float64]:
    """How well members tell positives from negatives whatever their thresholds: the area under the ROC curve.

    Args:
        probabilities: float (N, K), that the sub-goal is reached.
        labels: bool (N,), it is.

    Returns:
        float64 (K,): the share of pairs of a positive and a negative in which the positive has the higher probability,
        ties counted half; NaN where there are no such pairs.
    """
    positives = int(labels.sum())
    pairs = positives * (len(labels) - positives)
    if not pairs:
        return np.full(probabilities.shape[1], np.nan)
    ranks: NDArray[np.float64] = rankdata(probabilities, axis=0)[labels].sum(axis=0)
    return (ranks - positives * (positives + 1) / 2) / pairs


def _ratio(numerator: NDArray[np.int64], denominator: NDArray[np.int64]) -> NDArray[np.float64]:
    """The quotient, NaN where the denominator is 0."""
    safe = np.where(denominator == 0, 1, denominator)
    return np.where(denominator == 0, np.nan, numerator / safe)


def scores_by_layout(
    verdicts: NDArray[np.bool_], labels: NDArray[np.bool_], layout_seeds: NDArray[np.int64]
) -> dict[int, Scores]:
    """Spec F1: ``member_scores`` of each layout's states alone; arguments (N, K), (N,), (N,)."""
    return {
        int(seed): member_scores(verdicts[layout_seeds == seed], labels[layout_seeds == seed])
        for seed in np.unique(layout_seeds)
    }


def best_mean_worst(scores: NDArray[np.float64]) -> dict[str, float]:
    """Spec F1: best, mean and worst of the members' scores (K,), those not defined left out; NaN when none is."""
    known = scores[~np.isnan(scores)]
    if len(known) == 0:
        return {"best": float("nan"), "mean": float("nan"), "worst": float("nan")}
    return {"best": float(known.max()), "mean": float(known.mean()), "worst": float(known.min())}


def pairwise_disagreement(verdicts: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Spec F2: the share of states on which members i and j differ.

    Args:
        verdicts: bool (N, K).

    Returns:
        float64 (K, K), symmetric, 0 on the diagonal; NaN without states.
    """
    states, members = verdicts.shape
    if states == 0:
        return np.full((members, members), np.nan)
    differ = verdicts[:, :, None] != verdicts[:, None, :]
    return differ.mean(axis=0)


def mean_disagreement(verdicts: NDArray[np.bool_]) -> float:
    """Spec F2: the mean over all pairs of different members; NaN for a single member or without states."""
    rates = pairwise_disagreement(verdicts)
    pairs = rates[np.triu_indices(len(rates), k=1)]
    return float(pairs.mean()) if len(pairs) else float("nan")
