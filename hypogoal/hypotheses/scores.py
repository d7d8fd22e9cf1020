"""How well members know the true sub-goal (Spec F1), whatever their thresholds too, and how they differ (Spec F2)."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Scores = dict[str, NDArray[np.float64]]


def member_scores(verdicts: NDArray[np.bool_], labels: NDArray[np.bool_]) -> Scores:
    """Spec F1: by name every member's score, float64 (K,), a fraction, from "reached" verdicts (N, K) and labels (N,).

    NaN where a score is not defined: recall without positives, balanced accuracy without positives or negatives,
    precision of a member that never says yes, any score without states. ``ValueError`` where the two Ns differ.
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

    Takes probabilities (N, K) and labels (N,). Returns float64 (K,): the share of pairs of a positive and a negative in
    which the positive has the higher probability, ties counted half; NaN where there are no such pairs.
    """
    positives = int(labels.sum())
    pairs = positives * (len(labels) - positives)
    if not pairs:
        return np.full(probabilities.shape[1], np.nan)
    counted = zip(probabilities[labels].T, np.sort(probabilities[~labels], axis=0).T, strict=True)
    wins = [sum(np.searchsorted(no, yes, side).sum() for side in ("left", "right")) for yes, no in counted]
    return np.array(wins) / (2 * pairs)


def best_threshold(
    probabilities: NDArray[np.float32], labels: NDArray[np.bool_]
) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
    """Each member's best threshold for the true sub-goal: what it knows apart from where to say yes.

    It is set on the labels (N,) that it is judged by, so it is a bound, not a method. Members with probabilities (N, K)
    say yes above it. Returns thresholds (K,) and the balanced accuracy there (K,), NaN where a class is missing.
    """
    positives, members = int(labels.sum()), np.arange(probabilities.shape[1])
    negatives = len(labels) - positives
    if not (positives and negatives):
        return np.full(len(members), 0.5, dtype=np.float32), np.full(len(members), np.nan)
    order = np.argsort(-probabilities, axis=0, kind="stable")
    nothing = np.full((1, len(members)), np.nextafter(probabilities.min(), np.float32(-1)))
    ordered = np.concatenate([np.take_along_axis(probabilities, order, axis=0), nothing])  # row n: the first not called
    hits = np.concatenate([np.zeros((1, len(members)), dtype=np.int64), labels[order].cumsum(axis=0)])
    false_alarms = np.arange(len(labels) + 1)[:, None] - hits
    accuracy = (hits / positives + 1 - false_alarms / negatives) / 2
    accuracy[1:-1][ordered[:-2] == ordered[1:-1]] = 0.0  # no threshold parts states of the same probability
    best = accuracy.argmax(axis=0)
    return ordered[best, members].astype(np.float32), accuracy[best, members]


def halves(contexts: NDArray[np.int64]) -> NDArray[np.bool_] | None:
    """Two halves of the contexts (layouts or rooms) that states (N,) are of: bool (N,), in the first one.

    Every other context by its number; None where there are fewer than two.
    """
    numbers = np.unique(contexts)
    return np.isin(contexts, numbers[::2]) if len(numbers) > 1 else None


def cross_fitted(first: NDArray[np.float64], second: NDArray[np.float64]) -> float:
    """The best member's score, picked on other states than it is scored on, to exclude luck of the pick.

    Takes members' scores (K,) on two halves of the contexts, returns the mean of both directions; NaN where one has
    no score.
    """
    scores = []
    for picking, scoring in ((first, second), (second, first)):
        known = ~np.isnan(picking) & ~np.isnan(scoring)
        if not known.any():
            return float("nan")
        scores.append(float(scoring[known][picking[known].argmax()]))
    return sum(scores) / 2


def _ratio(numerator: NDArray[np.int64], denominator: NDArray[np.int64]) -> NDArray[np.float64]:
    """The quotient, NaN where the denominator is 0."""
    safe = np.where(denominator == 0, 1, denominator)
    return np.where(denominator == 0, np.nan, numerator / safe)


def by_member(scores: Scores) -> list[dict[str, float]]:
    """Arrays (K,) of scores as K rows of numbers."""
    return [dict(zip(scores, row, strict=True)) for row in zip(*(of.tolist() for of in scores.values()), strict=True)]


def best_mean_worst(scores: NDArray[np.float64]) -> dict[str, float]:
    """Spec F1: best, mean and worst of the members' scores (K,), undefined ones left out; NaN when none is defined."""
    defined = scores[~np.isnan(scores)]
    if len(defined) == 0:
        return dict.fromkeys(("best", "mean", "worst"), math.nan)
    return {"best": float(defined.max()), "mean": float(defined.mean()), "worst": float(defined.min())}


def most_and_least(values: NDArray[np.float64]) -> tuple[int | None, int | None]:
    """Which of the members (K,) has the highest and which the lowest value; None without any."""
    defined = np.flatnonzero(~np.isnan(values))
    if len(defined) == 0:
        return None, None
    return int(defined[values[defined].argmax()]), int(defined[values[defined].argmin()])


def mean_disagreement(verdicts: NDArray[np.bool_]) -> float:
    """Spec F2: from verdicts (N, K), the share of states on which two members differ, mean over all pairs of members.

    NaN for a single member or without states.
    """
    states, members = verdicts.shape
    if states == 0 or members == 1:
        return math.nan
    rates = (verdicts[:, :, None] != verdicts[:, None, :]).mean(axis=0)
    return float(rates[np.triu_indices(members, k=1)].mean())
