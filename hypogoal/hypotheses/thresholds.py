"""Where a member says yes: rules that set its threshold without a label of another context, by name (beyond the paper).

What each is worth on DoorKey: ``docs/results/thresholds-doorkey.md``.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

PAPER = "0.5"
CERTAIN = 1e-12  # probabilities nearer to 0 or 1 are taken as this near
Probabilities = NDArray[np.float32]  # (states,), one member's
Rule = Callable[[Probabilities, Probabilities, Probabilities], np.floating]


def log_odds_of(probabilities: NDArray[Any]) -> NDArray[np.float64]:
    """Of probabilities (...,), always finite."""
    exact = probabilities.astype(np.float64).clip(CERTAIN, 1 - CERTAIN)
    return np.asarray(np.log(exact) - np.log1p(-exact))


def _unlabelled_q95(positives: Probabilities, negatives: Probabilities, unlabelled: Probabilities) -> np.floating:
    """Yes to 5 % of the unlabelled states.

    Members of a crop are sure of what is no base and unsure of what is one in a room they do not know.
    """
    return np.quantile(unlabelled, 0.95, method="higher")


def unlabelled_split(positives: Probabilities, negatives: Probabilities, unlabelled: Probabilities) -> np.floating:
    """Otsu (1979): the cut of the unlabelled states' logits into two classes that leaves least variance within them."""
    logits = log_odds_of(np.sort(unlabelled))
    if len(logits) < 2:
        return np.float64(0.5)
    below = np.arange(1, len(logits))
    sums = logits.cumsum()[:-1]
    apart = sums / below - (logits.sum() - sums) / (len(logits) - below)
    cut = (apart**2 * below * (len(logits) - below)).argmax()
    return np.float64(1 / (1 + np.exp(-logits[cut : cut + 2].mean())))


def _positives_median(positives: Probabilities, negatives: Probabilities, unlabelled: Probabilities) -> np.floating:
    """Yes to half of the labelled positives.

    A policy looks for its classifier's mistakes: what it needs is that yes is right, not that each base is found.
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

    A threshold stays below 1: a member that is certain of more states than the rule grants goes on saying yes to them.
    The state whose probability it is lies at its edge: see :meth:`Ensemble.verdicts`.

    Args:
        name: of the rule.
        labelled: float32 (N, K), the members' probabilities of the labelled states.
        labels: bool (N,), which of those are positives.
        unlabelled: float32 (M, K).
    """
    rule = RULES[name]
    rows = [rule(own[labels], own[~labels], other) for own, other in zip(labelled.T, unlabelled.T, strict=True)]
    return np.minimum(np.array(rows, dtype=np.float32), np.nextafter(np.float32(1), np.float32(0)))
