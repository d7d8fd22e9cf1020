"""How different an ensemble's hypotheses are (Spec F2): how often two members' verdicts differ."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def pairwise_disagreement(verdicts: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Spec F2: the share of states on which members i and j differ.

    Args:
        verdicts: bool (N, K).

    Returns:
        float64 (K, K), symmetric, 0 on the diagonal; NaN without states.
    """
    states, members = verdicts.shape
    if states == 0:
        return np.full((members, members), np.nan)
    differ = verdicts[:, :, None] != verdicts[:, None, :]
    return differ.mean(axis=0)


def mean_disagreement(verdicts: NDArray[np.bool_]) -> float:
    """Spec F2: the mean over all pairs of different members; NaN for a single member or without states."""
    rates = pairwise_disagreement(verdicts)
    pairs = rates[np.triu_indices(len(rates), k=1)]
    return float(pairs.mean()) if len(pairs) else float("nan")
