"""How well members predict the true sub-goal (Spec F1), also whatever their thresholds, and how they differ (F2)."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

Scores = dict[str, NDArray[np.float64]]


def member_scores(predictions: NDArray[np.bool_], labels: NDArray[np.bool_]) -> Scores:
    """Spec F1: every member's scores by name, fractions float64 (K,), from predictions (N, K) and labels (N,).

    Undefined scores are NaN: recall without positives, balanced accuracy without positives or negatives, precision
    without positive predictions, any score without states. ``ValueError`` if the two Ns differ.
    """
    if predictions.shape[0] != labels.shape[0]:
        raise ValueError(f"{predictions.shape[0]} predictions for {labels.shape[0]} labels")
    truth = labels.astype(np.bool_)[:, None]
    true_positives = (predictions & truth).sum(0)
    false_positives = (predictions & ~truth).sum(0)
    false_negatives = (~predictions & truth).sum(0)
    true_negatives = (~predictions & ~truth).sum(0)
    recall = ratio(true_positives, true_positives + false_negatives)
    return {
        "balanced_accuracy": (recall + ratio(true_negatives, true_negatives + false_positives)) / 2,
        "precision": ratio(true_positives, true_positives + false_positives),
        "recall": recall,
        "accuracy": ratio(true_positives + true_negatives, np.full_like(true_positives, len(labels))),
        "f1": ratio(2 * true_positives, 2 * true_positives + false_positives + false_negatives),
    }


def ranking(probabilities: NDArray[np.float32], labels: NDArray[np.bool_]) -> NDArray[np.float64]:
    """The area under the ROC curve: how well members rank positives above negatives, whatever their thresholds.

    Takes probabilities (N, K) and labels (N,). Returns float64 (K,): the share of pairs of a positive and a negative in
    which the positive has the higher probability, ties counted half; NaN without such pairs.
    """
    positives = int(labels.sum())
    pairs = positives * (len(labels) - positives)
    if not pairs:
        return np.full(probabilities.shape[1], np.nan)
    by_member = zip(probabilities[labels].T, np.sort(probabilities[~labels], axis=0).T, strict=True)
    wins = [sum(np.searchsorted(low, high, side).sum() for side in ("left", "right")) for high, low in by_member]
    return np.array(wins) / (2 * pairs)


def best_threshold(
    probabilities: NDArray[np.float32], labels: NDArray[np.bool_]
) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
    """Each member's best threshold for the true sub-goal, and its balanced accuracy there.

    It is chosen on the labels (N,) that it is scored by, so it is a bound, not a method. Takes probabilities (N, K).
    Returns thresholds (K,), above which predictions are positive, and balanced accuracies (K,), NaN without a class.
    """
    positives, members = int(labels.sum()), np.arange(probabilities.shape[1])
    negatives = len(labels) - positives
    if not (positives and negatives):
        return np.full(len(members), 0.5, dtype=np.float32), np.full(len(members), np.nan)
    order = np.argsort(-probabilities, axis=0, kind="stable")
    nothing = np.full((1, len(members)), np.nextafter(probabilities.min(), np.float32(-1)))
    ordered = np.concatenate([np.take_along_axis(probabilities, order, axis=0), nothing])  # row n: the first negative
    true_positives = np.concatenate([np.zeros((1, len(members)), dtype=np.int64), labels[order].cumsum(axis=0)])
    false_positives = np.arange(len(labels) + 1)[:, None] - true_positives
    accuracy = (true_positives / positives + 1 - false_positives / negatives) / 2
    accuracy[1:-1][ordered[:-2] == ordered[1:-1]] = 0.0  # no threshold separates equal probabilities
    best = accuracy.argmax(axis=0)
    return ordered[best, members].astype(np.float32), accuracy[best, members]


def halves(contexts: NDArray[np.int64]) -> NDArray[np.bool_] | None:
    """Split states by their contexts (layouts or rooms) (N,): whether each is in the first half, bool (N,).

    That is every other context by number; None with fewer than two.
    """
    numbers = np.unique(contexts)
    return np.isin(contexts, numbers[::2]) if len(numbers) > 1 else None


def cross_fitted(first: NDArray[np.float64], second: NDArray[np.float64]) -> float:
    """The best member's score, picked on one half of the states and scored on the other, to exclude luck.

    Takes members' scores (K,) on both halves; returns the mean of both directions, NaN if one has no score.
    """
    scores = []
    for picking, scoring in ((first, second), (second, first)):
        defined = ~np.isnan(picking) & ~np.isnan(scoring)
        if not defined.any():
            return float("nan")
        scores.append(float(scoring[defined][picking[defined].argmax()]))
    return sum(scores) / 2


def ratio(numerator: NDArray[Any], denominator: NDArray[Any]) -> NDArray[np.float64]:
    """The quotient, element by element; NaN where the denominator is 0."""
    safe = np.where(denominator == 0, 1, denominator)
    return np.where(denominator == 0, np.nan, numerator / safe)


def best_mean_worst(scores: NDArray[np.float64]) -> dict[str, float]:
    """Spec F1: best, mean and worst of members' scores (K,) without undefined ones; NaN if none is defined."""
    defined = scores[~np.isnan(scores)]
    if len(defined) == 0:
        return dict.fromkeys(("best", "mean", "worst"), math.nan)
    return {"best": float(defined.max()), "mean": float(defined.mean()), "worst": float(defined.min())}


def most_and_least(values: NDArray[np.float64]) -> tuple[int | None, int | None]:
    """The members (K,) with the highest and with the lowest value; None without any."""
    defined = np.flatnonzero(~np.isnan(values))
    if len(defined) == 0:
        return None, None
    return int(defined[values[defined].argmax()]), int(defined[values[defined].argmin()])


def mean_disagreement(predictions: NDArray[np.bool_]) -> float:
    """Spec F2: from predictions (N, K), the share of states on which two members differ, mean over pairs of members.

    NaN for a single member or without states.
    """
    states, members = predictions.shape
    if states == 0 or members == 1:
        return math.nan
    rates = (predictions[:, :, None] != predictions[:, None, :]).mean(axis=0)
    return float(rates[np.triu_indices(members, k=1)].mean())
