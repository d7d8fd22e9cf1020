"""Where a member says yes: rules that set its threshold without a label of another context, by name (beyond the paper).

What each is worth on DoorKey: ``docs/results/thresholds-doorkey.md``.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

PAPER = "0.5"
Probabilities = NDArray[np.float32]  # (states,), one member's
Rule = Callable[[Probabilities, Probabilities, Probabilities], np.floating]


def _half(positives: Probabilities, negatives: Probabilities, unlabelled: Probabilities) -> np.floating:
    return np.float32(0.5)


def _unlabelled_q95(positives: Probabilities, negatives: Probabilities, unlabelled: Probabilities) -> np.floating:
    """Yes to 5 % of the unlabelled states.

    Members of a crop are sure of what is no base and unsure of what is one in a room they do not know.
    """
    return np.quantile(unlabelled, 0.95, method="higher")


def _base_rate(positives: Probabilities, negatives: Probabilities, unlabelled: Probabilities) -> np.floating:
    """Yes to as large a share of the unlabelled states as of the labelled ones are positives."""
    return np.quantile(unlabelled, len(negatives) / (len(positives) + len(negatives)), method="higher")


RULES: dict[str, Rule] = {PAPER: _half, "unlabelled-q95": _unlabelled_q95, "base-rate": _base_rate}


def thresholds(
    name: str,
    labelled: NDArray[np.float32],
    labels: NDArray[np.bool_],
    unlabelled: NDArray[np.float32],
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
