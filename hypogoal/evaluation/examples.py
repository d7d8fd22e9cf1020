"""Held-out states worth looking at, and the overlay of the states in which an option stopped."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def pick_examples(
    probabilities: NDArray[np.float32],
    labels: NDArray[np.bool_],
    per_kind: int = 2,
    threshold: float = 0.5,
    verdicts: NDArray[np.bool_] | None = None,
) -> list[tuple[int, str]]:
    """States on which members disagree, all err, or all are right, so that a reader sees each.

    Args:
        probabilities: float (N, K), every member's P(sub-goal reached).
        labels: bool (N,).
        per_kind: states of each kind at most.
        threshold: above which a member says yes.
        verdicts: bool (N, K), what members say, where not all have that threshold.

    Returns:
        (index, kind) with kind ``disagree`` (the widest spread of probabilities first, true and false states in
        turn), ``wrong`` (the most sure errors first), ``right yes`` and ``right no``; fewer where there are none.
    """
    verdicts = probabilities > threshold if verdicts is None else verdicts
    correct = verdicts == labels[:, None]
    spread = probabilities.max(1) - probabilities.min(1)
    disagree = ~(verdicts.all(1) | (~verdicts).all(1))
    wrong = ~correct.any(1)
    error = np.abs(probabilities - labels[:, None]).min(1)
    right = correct.all(1)
    half = -(-per_kind // 2)
    picked = [
        *_first(disagree & labels, -spread, half, "disagree"),
        *_first(disagree & ~labels, -spread, per_kind - half, "disagree"),
        *_first(wrong & labels, -error, half, "wrong"),
        *_first(wrong & ~labels, -error, per_kind - half, "wrong"),
        *_first(right & labels, error, 1, "right yes"),
        *_first(right & ~labels, error, 1, "right no"),
    ]
    return [(int(index), kind) for index, kind in picked]


def pick_to_explain(
    probabilities: NDArray[np.float32], verdicts: NDArray[np.bool_], labels: NDArray[np.bool_]
) -> list[tuple[int, str]]:
    """Figures 2 and 9: the few states whose attributions are drawn.

    Args:
        probabilities: float (N, K), every member's P(sub-goal reached).
        verdicts: bool (N, K).
        labels: bool (N,).

    Returns:
        (index, kind), no state twice: ``true positive``, where the most members are right and, of those, the surest on
        average; ``disagree``, where members differ and their probabilities are the furthest apart; ``false positive``,
        where the most members err, and the surest. Fewer where there are none.
    """
    yes, mean = verdicts.sum(1), probabilities.mean(1)
    spread = probabilities.max(1) - probabilities.min(1)
    picked: list[tuple[int, str]] = []
    for kind, mask, order in (
        ("true positive", labels & (yes > 0), -(yes + mean)),
        ("disagree", (yes > 0) & (yes < verdicts.shape[1]), -spread),
        ("false positive", ~labels & (yes > 0), -(yes + mean)),
    ):
        free = mask.copy()
        free[[index for index, _ in picked]] = False
        picked += _first(free, order, 1, kind)
    return picked


def _first(mask: NDArray[np.bool_], order: NDArray[np.floating], count: int, kind: str) -> list[tuple[int, str]]:
    candidates = np.flatnonzero(mask)
    ranked = candidates[np.argsort(order[candidates], kind="stable")]
    return [(int(index), kind) for index in ranked[:count]]


def overlay(states: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Figures 7 and 8: termination states uint8 (n, H, W, C), n at least 1, laid over each other.

    Pixels that all states share stay as they are; where states differ it is the root of the mean brightness, so that
    what few of them show can still be seen.
    """
    mean = states.astype(np.float32).mean(axis=0)
    varies = states.min(axis=0) != states.max(axis=0)
    return np.where(varies, 255 * np.sqrt(mean / 255), mean).round().astype(np.uint8)
