"""How well members predict the true sub-goal, also whatever their thresholds, and how they differ."""

import math

import numpy as np

from hypogoal.core.arrays import Array, Bools, Doubles, Floats, Ints

SAME = 0.99  # of unlabelled states: a member that predicts so many as another one does is no other hypothesis


def member_scores(predictions: Bools, labels: Bools) -> dict[str, Doubles]:
    """Every member's scores by name, fractions float64 (K,), from predictions (N, K) and labels (N,).

    Undefined scores are NaN: recall without positives, balanced accuracy without positives or negatives, precision
    without positive predictions, any score without states.
    """
    truth = labels.astype(bool)[:, None]
    hits = (predictions & truth).sum(0)
    false_alarms = (predictions & ~truth).sum(0)
    misses = (~predictions & truth).sum(0)
    rejections = (~predictions & ~truth).sum(0)
    recall = ratio(hits, hits + misses)
    specificity = ratio(rejections, rejections + false_alarms)
    states = hits + false_alarms + misses + rejections
    return {
        "balanced_accuracy": (recall + specificity) / 2,
        "precision": ratio(hits, hits + false_alarms),
        "recall": recall,
        "accuracy": ratio(hits + rejections, states),
        "f1": ratio(2 * hits, 2 * hits + false_alarms + misses),
    }


def ranking(probabilities: Floats, labels: Bools) -> Doubles:
    """The area under the ROC curve: how well members rank positives above negatives, whatever their thresholds.

    Takes probabilities (N, K) and labels (N,). Returns float64 (K,): the share of pairs of a positive and a negative in
    which the positive has the higher probability, ties counted half; NaN without such pairs.
    """
    from pandas import DataFrame  # takes longer to import than training needs it

    positives = labels.sum()
    pairs = positives * (~labels).sum()
    ranks = DataFrame(probabilities).rank().to_numpy()  # from 1 on, of equals the mean
    won = ranks[labels].sum(0) - positives * (positives + 1) / 2
    return ratio(won, pairs)


def best_threshold(probabilities: Floats, labels: Bools) -> tuple[Floats, Doubles]:
    """Each member's best threshold for the true sub-goal, and its balanced accuracy there.

    It is chosen on the labels (N,) that it is scored by, so it is a bound, not a method. Takes probabilities (N, K).
    Returns thresholds (K,), above which predictions are positive, and balanced accuracies (K,), NaN without a class.
    """
    thresholds = np.full(probabilities.shape[1], 0.5, np.float32)
    accuracies = np.full(len(thresholds), np.nan)
    if labels.all() or not labels.any():
        return thresholds, accuracies
    below_all = np.nextafter(probabilities.min(), np.float32(-1))
    for member, of_member in enumerate(probabilities.T):
        cuts = np.unique(np.append(of_member, below_all))[::-1]
        recall = _share_above(of_member[labels], cuts)
        false_alarms = _share_above(of_member[~labels], cuts)
        accuracy = (recall + 1 - false_alarms) / 2
        best = accuracy.argmax()
        thresholds[member], accuracies[member] = cuts[best], accuracy[best]
    return thresholds, accuracies


def _share_above(values: Floats, cuts: Floats) -> Doubles:
    """The share of values that are above each cut."""
    not_above = np.searchsorted(np.sort(values), cuts, side="right")
    return (len(values) - not_above) / len(values)


def halves(contexts: Ints) -> Bools | None:
    """Split states by their contexts (layouts or rooms) (N,): whether each is in the first half, bool (N,).

    That is every other context by number; None with fewer than two.
    """
    numbers = np.unique(contexts)
    if len(numbers) < 2:
        return None
    return np.isin(contexts, numbers[::2])


def cross_fitted(first: Doubles, second: Doubles) -> float:
    """The best member's score, picked on one half of the states and scored on the other, to exclude luck.

    Takes members' scores (K,) on both halves; returns the mean of both directions, NaN if one has no score.
    """
    defined = ~np.isnan(first + second)
    if not defined.any():
        return math.nan
    first, second = first[defined], second[defined]
    return float(second[first.argmax()] + first[second.argmax()]) / 2


def ratio(numerator: Array, denominator: Array) -> Doubles:
    """The quotient, element by element; NaN where the denominator is 0."""
    quotient = np.full(np.shape(numerator), np.nan)
    return np.divide(numerator, denominator, out=quotient, where=denominator != 0)


def best_mean_worst(scores: Doubles) -> dict[str, float]:
    """Best, mean and worst of members' scores (K,) without undefined ones; NaN if none is defined."""
    defined = scores[~np.isnan(scores)]
    if not len(defined):
        defined = np.array([math.nan])
    return {"best": float(defined.max()), "mean": float(defined.mean()), "worst": float(defined.min())}


def most_and_least(values: Doubles) -> tuple[int | None, int | None]:
    """The members (K,) with the highest and with the lowest value; None without any."""
    if np.isnan(values).all():
        return None, None
    return int(np.nanargmax(values)), int(np.nanargmin(values))


def mean_disagreement(predictions: Bools) -> float:
    """From predictions (N, K), the share of states on which two members differ, mean over pairs of members.

    NaN for a single member or without states.
    """
    states, members = predictions.shape
    if states == 0 or members == 1:
        return math.nan
    positive = predictions.sum(1)
    differing = positive * (members - positive)  # pairs of members, in each state
    return float(differing.mean()) / math.comb(members, 2)


def idle_members(predictions: Bools, layouts: Ints | None = None) -> list[str]:
    """A line for each member that is no hypothesis of its own, from predictions (M, K) on unlabelled states.

    It is constant, or constant within each of several ``layouts`` (M,), or the same as an earlier member on ``SAME`` of
    the states.
    """
    lines = []
    kinds = [] if layouts is None else [layouts == layout for layout in np.unique(layouts)]
    for member, positive in enumerate(predictions.T):
        alike = [other for other in range(member) if (predictions[:, other] == positive).mean() >= SAME]
        if positive.all() or not positive.any():
            lines.append(f"member {member} predicts {'positive' if positive.all() else 'negative'} everywhere")
        elif len(kinds) > 1 and all(len(np.unique(positive[inside])) == 1 for inside in kinds):
            lines.append(f"member {member} tells layouts apart, not states")
        elif alike:
            lines.append(f"member {member} predicts what member {alike[0]} does")
    return lines
