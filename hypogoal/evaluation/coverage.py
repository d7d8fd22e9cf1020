"""Spec H1: which planted features the members of an ensemble have found, for studies of objectives.

Pure functions of probabilities on states in which all features are crossed, see ``domains.rooms.states``.
"""

import numpy as np
from numpy.typing import NDArray

from hypogoal.evaluation.numbers import at_least
from hypogoal.hypotheses.scores import ranking

Table = NDArray[np.float64]  # (K, F)


def rankings(probabilities: NDArray[np.float32], factors: NDArray[np.bool_]) -> Table:
    """Area under the ROC curve of every member (N, K) on every factor (N, F), float64 (K, F).

    Every combination of factors is equally frequent, so .5 means that a member is blind to a factor.
    """
    return np.stack([ranking(probabilities, truth) for truth in factors.T], axis=1)


def owned(ranked: Table, high: float = 0.95, low: float = 0.6) -> NDArray[np.bool_]:
    """Which member owns which factor, bool (K, F): it ranks by this factor, at least ``high``, and by no other.

    By no other, neither way round: all others lie within 1 - ``low`` and ``low``. ``ranked``, ``high`` and ``low``
    (at least .5) are areas under the ROC curve, see :func:`rankings`. Coverage is the share of factors with an owner.
    """
    separated, ignored = at_least(ranked, high), at_least(low - 0.5, np.abs(ranked - 0.5))
    return separated & (ignored.sum(axis=1, keepdims=True) == ranked.shape[1] - 1)
