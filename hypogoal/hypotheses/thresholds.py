"""Rules that set members' thresholds without labels from other contexts (beyond the paper)."""

from collections.abc import Callable
from typing import Any

import numpy as np

from hypogoal.core.arrays import Array, Bools, Doubles, Floats
from hypogoal.core.errors import UserError
from hypogoal.core.own_code import load

PAPER = "0.5"
SPLIT = "unlabelled-split"
RULES = {SPLIT: f"{__name__}:unlabelled_split"}
ENTRY_POINTS = "hypogoal.thresholds"  # with which other packages add rules
CERTAIN = 1e-12  # probabilities are clipped this far from 0 and 1
BELOW_ONE = np.nextafter(np.float32(1), np.float32(0))
Probabilities = Floats  # (states, K)


def log_odds_of(probabilities: Array) -> Doubles:
    """The log-odds of probabilities (...,), always finite."""
    exact = probabilities.astype(float).clip(CERTAIN, 1 - CERTAIN)
    return np.log(exact) - np.log1p(-exact)


def unlabelled_split(
    labelled: Probabilities,
    labels: Bools,
    unlabelled: Probabilities,
) -> Any:
    """Where each member's log-odds of the unlabelled states fall into two classes best, (K,)."""
    return np.array([_cut(log_odds_of(np.sort(of_member))) for of_member in unlabelled.T])


def _cut(logits: Doubles) -> float:
    """Otsu (1979): the cut of rising log-odds into two classes with the least variance within, as a probability."""
    if len(logits) < 2:
        return 0.5
    below = np.arange(1, len(logits))
    above = len(logits) - below
    sums = logits.cumsum()[:-1]
    apart = sums / below - (logits.sum() - sums) / above
    cut = (apart**2 * below * above).argmax()
    return float(1 / (1 + np.exp(-logits[cut : cut + 2].mean())))


def threshold_rule(name: str) -> Callable[[Probabilities, Bools, Probabilities], Any]:
    """The rule of a setting; what is no number between 0 and 1, no rule and no function is a ``UserError``."""
    try:
        number = float(name)
    except ValueError:
        number = 0.0
    if 0 < number < 1:
        return lambda labelled, *_: np.full(labelled.shape[1], number)
    return load(name, "threshold", ENTRY_POINTS, RULES)


def thresholds(
    name: str,
    labelled: Probabilities,
    labels: Bools,
    unlabelled: Probabilities,
) -> Floats:
    """The thresholds float32 (K,) that a rule sets.

    A threshold stays below 1, so a member that is certain of more states than the rule allows still predicts them
    positive. The prediction for the state whose probability is the threshold depends on rounding, see
    :meth:`Ensemble.predictions`.

    Args:
        name: a number, ``unlabelled-split``, or ``module:function`` of the other arguments.
        labelled: float32 (N, K), the members' probabilities of the labelled states.
        labels: bool (N,), which of them are positive.
        unlabelled: float32 (M, K), the members' probabilities of the unlabelled states.
    """
    rule, members = threshold_rule(name), labelled.shape[1]
    chosen = np.asarray(rule(labelled, labels, unlabelled))
    if chosen.shape != (members,) or not ((chosen >= 0) & (chosen <= 1)).all():
        raise UserError(
            f"the threshold rule gave {chosen}",
            name,
            f"Give probabilities ({members},).",
        )
    return np.minimum(chosen.astype(np.float32), BELOW_ONE)
