"""Scores that say how well members predict the true sub-goal, and how much members differ.

Some scores take members' predictions at their thresholds, others do without thresholds.
"""

import math

import numpy as np

from hypogoal.core.arrays import Array, Bools, Doubles, Floats, Ints

SAME = 0.99  # two members that agree on this share of unlabelled states are counted as one hypothesis


def member_scores(predictions: Bools, labels: Bools) -> dict[str, Doubles]:
    """Return every member's scores by name, fractions float64 (K,), from predictions (N, K) and labels (N,).

    A score that is undefined is NaN. Recall is undefined without positives, and balanced accuracy without positives or
    negatives. Precision is undefined without positive predictions, and every score is undefined without states.
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
    """Return the area under the ROC curve: how well members rank positives above negatives, without any threshold.

    The area is the share of pairs of a positive and a negative in which the positive has the higher probability. Ties
    count half. The area is NaN if there are no such pairs.

    Args:
        probabilities: the members' probabilities, float (N, K).
        labels: whether the sub-goal holds, bool (N,).

    Returns:
        The area of each member, float64 (K,).
    """
    from pandas import DataFrame  # imported here, because the import is slow and training does without pandas

    positives = labels.sum()
    pairs = positives * (~labels).sum()
    ranks = DataFrame(probabilities).rank().to_numpy()  # ranks begin at 1, and equal values get their mean rank
    won = ranks[labels].sum(0) - positives * (positives + 1) / 2
    return ratio(won, pairs)


def best_threshold(probabilities: Floats, labels: Bools) -> tuple[Floats, Doubles]:
    """Return each member's best threshold for the true sub-goal, and the balanced accuracy at that threshold.

    The threshold is chosen on the labels by which it is scored. So the result is an upper bound, not a method. The
    accuracies are NaN if all labels are of one class.

    Args:
        probabilities: the members' probabilities, float (N, K).
        labels: whether the sub-goal holds, bool (N,).

    Returns:
        Thresholds, float32 (K,), above which predictions are positive.
        Balanced accuracies, float64 (K,).
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
    """Return the share of ``values`` that are above each cut."""
    not_above = np.searchsorted(np.sort(values), cuts, side="right")
    return (len(values) - not_above) / len(values)


def halves(contexts: Ints) -> Bools | None:
    """Split states in two by their contexts (layouts or rooms) (N,).

    Returns bool (N,), whether each state is in the first half, which has every other context by number. Returns None if
    there are fewer than two contexts.
    """
    numbers = np.unique(contexts)
    if len(numbers) < 2:
        return None
    return np.isin(contexts, numbers[::2])


def cross_fitted(first: Doubles, second: Doubles) -> float:
    """Return the score of the best member, picked on one half of the states and scored on the other half.

    The split excludes luck, because no member is scored on the states by which it was picked. Takes members' scores
    (K,) on both halves. Returns the mean of the two directions, or NaN if no member has a score on both halves.
    """
    defined = ~np.isnan(first + second)
    if not defined.any():
        return math.nan
    first, second = first[defined], second[defined]
    return float(second[first.argmax()] + first[second.argmax()]) / 2


def ratio(numerator: Array, denominator: Array) -> Doubles:
    """Return the quotient, float64, element by element, with NaN where the denominator is 0."""
    quotient = np.full(np.shape(numerator), np.nan)
    return np.divide(numerator, denominator, out=quotient, where=denominator != 0)


def best_mean_worst(scores: Doubles) -> dict[str, float]:
    """Return the best, mean and worst of members' scores (K,), leaving out NaN.

    All three are NaN if no score is defined.
    """
    defined = scores[~np.isnan(scores)]
    if not len(defined):
        defined = np.array([math.nan])
    return {"best": float(defined.max()), "mean": float(defined.mean()), "worst": float(defined.min())}


def most_and_least(values: Doubles) -> tuple[int | None, int | None]:
    """Return the index of the member with the highest value, and of the member with the lowest, from values (K,).

    Both are None if all values are NaN.
    """
    if np.isnan(values).all():
        return None, None
    return int(np.nanargmax(values)), int(np.nanargmin(values))


def mean_disagreement(predictions: Bools) -> float:
    """Return the share of states on which two members differ, as a mean over pairs of members.

    Takes predictions, bool (N, K). Returns NaN for a single member, or without states.
    """
    states, members = predictions.shape
    if states == 0 or members == 1:
        return math.nan
    positive = predictions.sum(1)
    differing = positive * (members - positive)  # the number of pairs of members that differ, in each state
    return float(differing.mean()) / math.comb(members, 2)


def idle_members(predictions: Bools, layouts: Ints | None = None) -> list[str]:
    """Return a line for each member that is no hypothesis of its own, from predictions (M, K) on unlabelled states.

    A member is no hypothesis of its own if it predicts one class everywhere, or one class within each of several
    ``layouts`` (M,), or what an earlier member predicts on the share ``SAME`` of the states.
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
