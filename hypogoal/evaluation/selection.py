"""Which members the meta-policy prefers, and whether they are the good ones (Spec F6, the paper's question 5)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import rankdata


def preference(chosen: NDArray[Any], expected: NDArray[np.float64]) -> NDArray[np.float64]:
    """Spec F6: chosen / expected under uniform choice among the options offered.

    A raw share is confounded: a member that always fires is masked nearly always, one that never fires is offered
    always. This ratio is 1 for a chooser that does not care, whatever is offered how often.

    Args:
        chosen: (..., O), decisions that chose each option.
        expected: float (..., O), the sum of 1 / (options offered) over the decisions that offered it.

    Returns:
        float64 (..., O); NaN where an option was never offered.
    """
    safe = np.where(expected > 0, expected, 1.0)
    return np.where(expected > 0, chosen / safe, np.nan)


def shares(chosen: NDArray[Any]) -> NDArray[np.float64]:
    """Spec F6: the share of all decisions that chose each option, (O,); NaN without decisions."""
    total = chosen.sum()
    return chosen / total if total > 0 else np.full(chosen.shape, np.nan)


def rank_correlation(first: NDArray[np.float64], second: NDArray[np.float64]) -> float:
    """Spec F6: Spearman's rank correlation of (n,) and (n,), ties sharing their mean rank.

    Pairs with a NaN are left out. NaN where fewer than two pairs are left or one side is constant: then there is no
    ranking to compare.
    """
    known = ~(np.isnan(first) | np.isnan(second))
    if known.sum() < 2:
        return float("nan")
    ranks = rankdata(first[known]), rankdata(second[known])
    deviations = [rank - rank.mean() for rank in ranks]
    spread = np.sqrt((deviations[0] ** 2).sum() * (deviations[1] ** 2).sum())
    return float((deviations[0] * deviations[1]).sum() / spread) if spread > 0 else float("nan")


def rank_correlations(values: NDArray[np.float64], match: NDArray[np.float64], members: int) -> dict[str, float]:
    """Spec F6: rank correlation between members' values (their preference, say) and their match with the true sub-goal.

    Args:
        values: float (G*K,), in the order of the options: sub-goal * K + member.
        match: float (G*K,), balanced accuracy on the layout.
        members: K.

    Returns:
        ``all``: over all options at once; ``within``: the mean over sub-goals of the correlation among its own K
        members, so that a sub-goal that is chosen often does not count; NaN where not defined.
    """
    by_goal = [
        rank_correlation(values[start : start + members], match[start : start + members])
        for start in range(0, len(values), members)
    ]
    known = [value for value in by_goal if not np.isnan(value)]
    within = float(np.mean(known)) if known else float("nan")
    return {"all": rank_correlation(values, match), "within": within}


def most_and_least(values: NDArray[np.float64]) -> tuple[int | None, int | None]:
    """Figures 7 and 8: which of the members (K,) has the highest and which the lowest value; None without any."""
    known = np.flatnonzero(~np.isnan(values))
    if len(known) == 0:
        return None, None
    return int(known[values[known].argmax()]), int(known[values[known].argmin()])
