"""The weights of diversity that ``auto`` tries, and what it judges them by. :mod:`hypogoal.hypotheses.auto` searches.

Members bear a weight if every member is as right about held-out labels as members without diversity, within a standard
error (Breiman et al. 1984, section 3.4.3)::

    accuracy >= a - s
    a = (right_1 / n_1 + right_0 / n_0) / 2
    s = sqrt(q_1 (1 - q_1) / n_1 + q_0 (1 - q_0) / n_0) / 2,  q_c = (right_c + 1) / (n_c + 2)

Of the ``n_c`` held-out states of class c, ``right_c`` are predicted right without diversity. q_c is Laplace's rule of
succession, because with the plain share a member without a fault would have s = 0.
"""

from dataclasses import dataclass
from math import sqrt
from typing import Any

import numpy as np

from hypogoal.core import seeding
from hypogoal.core.arrays import Bools, Doubles, Floats, Ints
from hypogoal.hypotheses import scores

WEIGHTS = (1.0, 0.3, 0.1, 0.03, 0.01, 0.003, 0.001, 3e-4, 1e-4)
FOLDS = 4  # one state in FOLDS is held out
# A fold needs this many held-out states of each class: with fewer, every fold is held out in turn. If a class has fewer
# labelled states in all, no weight is tried.
FEWEST = 8
SMALL = 1e-9  # probabilities are raised to this at least, because log 0 is not finite
FEW = "{} labels of a class are too few to choose the diversity weight by, so it is {}"
SINGLE = "too few groups have both classes, so single states are held out: near copies make them easy"


@dataclass(frozen=True)
class Tried:
    """Result of one tried weight: the worst member's held-out accuracy, and how members differ on unlabelled states."""

    weight: float
    accuracy: float
    disagreement: float | None  # None if there is one member
    constant: bool  # some member predicts one class for all unlabelled states
    contrary: bool  # members differ on more than half of the unlabelled states
    kept: bool


def held_out(labels: Bools, groups: Ints | None, seed: int) -> tuple[list[Bools], str]:
    """Choose which labelled states are held out.

    States are assigned to ``FOLDS`` folds at random. Every fold has about the same share of each class. All states of a
    group are in the same fold, unless fewer than ``FOLDS`` groups have states of a class.

    Returns the folds, a list of bool (N,) arrays that are true for held-out states, and a remark that a user should
    know. The list has one fold, or all folds if the first fold has fewer than ``FEWEST`` states of a class. The list is
    empty if a class has fewer than ``FEWEST`` labels in all. The remark is empty if there is nothing to know.
    """
    fewest = min(labels.sum(), (~labels).sum())
    if fewest < FEWEST:
        return [], FEW.format(fewest, WEIGHTS[-1])
    remark = ""
    units = np.arange(len(labels))
    if groups is not None:
        holding = [len(np.unique(groups[inside])) for inside in (labels, ~labels)]
        remark = SINGLE if min(holding) < FOLDS else ""
        units = units if remark else np.unique(groups, return_inverse=True)[1]
    positives, sizes = np.bincount(units, labels), np.bincount(units)
    kinds = np.stack([positives > 0, positives < sizes], axis=1)
    fold_of = np.empty(len(sizes), int)
    rng = seeding.rng_for(seed, "folds")
    for kind in np.unique(kinds, axis=0):
        alike = np.flatnonzero((kinds == kind).all(axis=1))
        fold_of[rng.permutation(alike)] = np.arange(len(alike)) % FOLDS
    folds = [fold_of[units] == number for number in range(FOLDS)]
    held = labels[folds[0]]
    is_enough = min(held.sum(), (~held).sum()) >= FEWEST
    return folds[:1] if is_enough else folds, remark


def accuracies_of(right: Bools, labels: Bools) -> Doubles:
    """Return the members' balanced accuracies, float64 (K,), given which predictions are ``right``, bool (N, K)."""
    return scores.member_scores(right == labels[:, None], labels)["balanced_accuracy"]


def lowest_kept(right: Bools, labels: Bools) -> float:
    """Return a - s, the balanced accuracy that members trained with diversity must keep.

    ``right``, bool (N, K), says which predictions of members without diversity are right. a and s are those of the
    worst of these K members.
    """
    accuracies = accuracies_of(right, labels)
    worst = accuracies.argmin()
    variance = 0.0
    for inside in (labels, ~labels):
        count = inside.sum()
        share = (right[inside, worst].sum() + 1) / (count + 2)
        variance += share * (1 - share) / count
    return float(accuracies[worst] - sqrt(variance) / 2)


def information_of(probabilities: Floats) -> float:
    """Return the mutual information of state and prediction, in nats, from a member's probabilities (M,).

    It is H(mean p) - mean H(p) (Bridle et al. 1991). It is low for a mixture, because a mixture is in doubt where its
    features part, or says no to most states.
    """

    def entropy(positive: Any) -> Any:
        both = np.clip(np.stack([positive, 1 - positive]), SMALL, 1)
        return -(both * np.log(both)).sum(axis=0)

    return float(entropy(probabilities.mean()) - entropy(probabilities).mean())
