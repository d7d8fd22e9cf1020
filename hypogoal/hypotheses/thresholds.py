"""Rules by name that set members' thresholds without labels from other contexts (beyond the paper).

Their results on DoorKey: ``docs/results/thresholds-doorkey.md``.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

PAPER = "0.5"
CERTAIN = 1e-12  # probabilities are clipped this far from 0 and 1
ENOUGH, NEXT, LEAST = 0.05, 0.75, 0.5  # of thresholds that fall, see :func:`fallen`
Probabilities = NDArray[np.float32]  # (states,), one member's
Rule = Callable[[Probabilities, Probabilities, Probabilities], np.floating]


def log_odds_of(probabilities: NDArray[Any]) -> NDArray[np.float64]:
    """The log-odds of probabilities (...,), always finite."""
    exact = probabilities.astype(np.float64).clip(CERTAIN, 1 - CERTAIN)
    return np.asarray(np.log(exact) - np.log1p(-exact))


def fallen(
    thresholds: NDArray[np.float32], first: NDArray[np.float32], highest: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Thresholds (K,), log-odds, where less than ``ENOUGH`` was reached: ``NEXT`` of the highest log-odds met.

    They never fall below ``LEAST`` of what they were at ``first``, nor rise.
    """
    return np.minimum(thresholds, np.maximum(LEAST * first, NEXT * highest))


def _unlabelled_q95(positives: Probabilities, negatives: Probabilities, unlabelled: Probabilities) -> np.floating:
    """Predict 5 % of the unlabelled states positive.

    In unknown rooms, members that see a window are sure of negatives and unsure of bases.
    """
    return np.quantile(unlabelled, 0.95, method="higher")


def unlabelled_split(positives: Probabilities, negatives: Probabilities, unlabelled: Probabilities) -> np.floating:
    """Otsu (1979): the cut of the unlabelled states' log-odds into two classes with the least variance within."""
    logits = log_odds_of(np.sort(unlabelled))
    if len(logits) < 2:
        return np.float64(0.5)
    below = np.arange(1, len(logits))
    sums = logits.cumsum()[:-1]
    apart = sums / below - (logits.sum() - sums) / (len(logits) - below)
    cut = (apart**2 * below * (len(logits) - below)).argmax()
    return np.float64(1 / (1 + np.exp(-logits[cut : cut + 2].mean())))


def _positives_median(positives: Probabilities, negatives: Probabilities, unlabelled: Probabilities) -> np.floating:
    """Predict half of the labelled positives positive.

    A policy exploits its classifier's false positives, so precision matters more than recall.
    """
    return np.median(positives)


RULES: dict[str, Rule] = {
    PAPER: lambda *_: np.float32(0.5),
    "unlabelled-q95": _unlabelled_q95,
    "unlabelled-split": unlabelled_split,
    "positives-median": _positives_median,
}
NEED_UNLABELLED = ("unlabelled-q95", "unlabelled-split")


def thresholds(
    name: str, labelled: NDArray[np.float32], labels: NDArray[np.bool_], unlabelled: NDArray[np.float32]
) -> NDArray[np.float32]:
    """The thresholds float32 (K,) that a rule sets.

    A threshold stays below 1, so a member that is certain of more states than the rule allows still predicts them
    positive. The prediction for the state whose probability is the threshold depends on rounding, see
    :meth:`Ensemble.predictions`.

    Args:
        name: of the rule.
        labelled: float32 (N, K), the members' probabilities of the labelled states.
        labels: bool (N,), which of them are positive.
        unlabelled: float32 (M, K), the members' probabilities of the unlabelled states.
    """
    rule = RULES[name]
    members = zip(labelled.T, unlabelled.T, strict=True)
    rows = [rule(on_labelled[labels], on_labelled[~labels], on_unlabelled) for on_labelled, on_unlabelled in members]
    return np.minimum(np.array(rows, dtype=np.float32), np.nextafter(np.float32(1), np.float32(0)))
