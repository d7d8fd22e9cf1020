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
ENTRY_POINTS = "hypogoal.thresholds"  # the entry point group by which other packages add rules
CERTAIN = 1e-12  # probabilities are clipped to stay at least this far from 0 and 1
BELOW_ONE = np.nextafter(np.float32(1), np.float32(0))
Probabilities = Floats  # (states, K)


def log_odds_of(probabilities: Array) -> Doubles:
    """Return the log-odds of probabilities (...,), float64, always finite."""
    exact = probabilities.astype(float).clip(CERTAIN, 1 - CERTAIN)
    return np.log(exact) - np.log1p(-exact)


def unlabelled_split(
    labelled: Probabilities,
    labels: Bools,
    unlabelled: Probabilities,
) -> Any:
    """Return the thresholds (K,) at which each member's log-odds of unlabelled states fall into two classes best."""
    return np.array([_cut(log_odds_of(np.sort(of_member))) for of_member in unlabelled.T])


def _cut(logits: Doubles) -> float:
    """Return the probability that best cuts rising log-odds into two classes (Otsu 1979).

    The best cut has the least variance within the classes.
    """
    if len(logits) < 2:
        return 0.5
    below = np.arange(1, len(logits))
    above = len(logits) - below
    sums = logits.cumsum()[:-1]
    apart = sums / below - (logits.sum() - sums) / above
    cut = (apart**2 * below * above).argmax()
    return float(1 / (1 + np.exp(-logits[cut : cut + 2].mean())))


def threshold_rule(name: str) -> Callable[[Probabilities, Bools, Probabilities], Any]:
    """Return the function that a setting names.

    A number between 0 and 1 gives a rule that sets this number for all members. Raises ``UserError`` if ``name`` is
    neither such a number nor a rule nor a function.
    """
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
    """Return the thresholds, float32 (K,), that a rule sets.

    A threshold stays below 1. So a member that is certain of more states than the rule allows still predicts those
    states positive. If the probability of a state equals the threshold, the prediction depends on rounding, see
    :meth:`Ensemble.predictions`.

    Args:
        name: a number, ``unlabelled-split``, or a ``module:function`` that takes the other arguments.
        labelled: float32 (N, K), the members' probabilities for the labelled states.
        labels: bool (N,), whether each labelled state is positive.
        unlabelled: float32 (M, K), the members' probabilities for the unlabelled states.

    Raises:
        UserError: if the rule is unknown, or does not give K probabilities.
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
