"""One run's table of choices against how well each member fits that layout (Spec E5, F6)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hypogoal.evaluation.selection import most_and_least, preference, rank_correlations, shares

LATE = 0.25  # the last part of training that is looked at by itself
PARTS = 20  # of training, in which choices are counted apart


@dataclass(frozen=True)
class Choices:
    """Rows of ``choices.csv``, arrays (n,): one row per option and window of steps that ends at ``step``."""

    step: NDArray[np.int64]
    option: NDArray[np.int64]
    offered: NDArray[np.int64]
    chosen: NDArray[np.int64]
    expected: NDArray[np.float64]
    reached: NDArray[np.int64]
    duration: NDArray[np.int64]

    def since(self, step: float) -> Choices:
        """The windows that end after ``step``."""
        late = self.step > step
        return Choices(*(getattr(self, name)[late] for name in self.__dataclass_fields__))

    def total(self, name: str, options: int) -> NDArray[np.float64]:
        """The sum of column ``name`` over all windows, (O,)."""
        return np.bincount(self.option, weights=getattr(self, name), minlength=options).astype(np.float64)


def over_training(choices: Choices, options: int, parts: int = PARTS) -> dict[str, NDArray[np.float64]]:
    """Spec E5, F6: choices counted in equal parts of training, in the order of time.

    Args:
        choices: windows, each counted in the part in which it ends.
        options: O.
        parts: at most; as many as there are windows where those are fewer.

    Returns:
        ``step``, where each part ends (P,), and ``chosen`` and ``expected``, (P, O) each.
    """
    windows = np.unique(choices.step)
    parts = min(parts, len(windows))
    ends = np.array([part[-1] for part in np.array_split(windows, parts)]) if parts else np.zeros(0)
    part = np.searchsorted(ends, choices.step)
    found = {"step": ends.astype(np.float64)}
    for name in ("chosen", "expected"):
        counts = np.bincount(part * options + choices.option, getattr(choices, name), minlength=parts * options)
        found[name] = counts.reshape(parts, options).astype(np.float64)
    return found


def selection_of_run(
    choices: Choices, match: NDArray[np.float64], sub_goals: Sequence[str], members: int
) -> dict[str, Any]:
    """Spec F6: how often each member was offered and chosen, beside how well it matches the true sub-goal here.

    Args:
        choices: the run's table of choices.
        match: float (G*K,), each member's balanced accuracy on the layout's reachable states.
        sub_goals: G names.
        members: K.

    Returns:
        ``sub_goals``: a row per member (option, offered, chosen, expected, preference, late_preference, share, reached,
        mean duration in steps, match), the most and the least preferred member; ``rank_correlation`` of preference,
        late preference (the last quarter of training) and raw share with the match, each over all options and within
        sub-goals. NaN where not defined.
    """
    options = len(sub_goals) * members
    names = ("offered", "chosen", "expected", "reached", "duration")
    totals = {name: choices.total(name, options) for name in names}
    begin, end = (choices.step.min(), choices.step.max()) if len(choices.step) else (0, 0)
    late = choices.since(end - LATE * (end - begin))
    values = {
        "preference": preference(totals["chosen"], totals["expected"]),
        "late_preference": preference(late.total("chosen", options), late.total("expected", options)),
        "share": shares(totals["chosen"]),
    }
    duration = np.divide(totals["duration"], totals["chosen"], out=np.full(options, np.nan), where=totals["chosen"] > 0)
    by_goal = []
    for index, sub_goal in enumerate(sub_goals):
        start = index * members
        most, least = most_and_least(values["preference"][start : start + members])
        rows = [
            {
                "member": option - start,
                "option": option,
                "offered": int(totals["offered"][option]),
                "chosen": int(totals["chosen"][option]),
                "expected": float(totals["expected"][option]),
                "reached": int(totals["reached"][option]),
                "duration": float(duration[option]),
                "match": float(match[option]),
                **{name: float(value[option]) for name, value in values.items()},
            }
            for option in range(start, start + members)
        ]
        by_goal.append({"sub_goal": sub_goal, "members": rows, "most": most, "least": least})
    correlations = {name: rank_correlations(value, match, members) for name, value in values.items()}
    return {"sub_goals": by_goal, "rank_correlation": correlations}
