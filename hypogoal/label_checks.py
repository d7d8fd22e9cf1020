"""Whether labels suffice to train and to judge classifiers: both classes are there, and neither is rare.

Also whether sub-goals have names that can be used for files.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hypogoal.core.arrays import Bools
from hypogoal.core.errors import UserError
from hypogoal.core.files import NO_FILE_NAME, plain_names

GET_MORE = "Collect more steps or other layouts, or bring a policy that gets there."
FEW = 10  # with fewer labelled states of a class, a warning is given
RARE = 0.05  # with a smaller share of a class among the labelled states, a warning is given


class Unmet(UserError):
    """An error because play did not reach the states needed."""


def doubts_of(labelled: Bools, heldout: Bools, goals: Sequence[str]) -> list[str]:
    """Return a line for each doubt whether the labels suffice.

    A sub-goal is in doubt if a class has few labelled states, or if the held-out states are of one class only.
    ``labelled`` (N, G) and ``heldout`` (M, G) are labels.
    """
    lines = []
    for goal, column, judged in zip(goals, labelled.T, heldout.T, strict=True):
        positives, count = int(column.sum()), len(column)
        if min(positives, count - positives) < max(FEW, RARE * count):
            lines.append(f"{goal} has {positives} positives among {count} labelled states: classes are unbalanced")
        if len(np.unique(judged)) < 2:
            lines.append(f"{goal} has one class only in the held-out states, so it cannot be judged by them")
    return lines


def require_classes(labels: Bools, goals: Sequence[str], where: object, do: str) -> None:
    """Raise ``Unmet`` if the labels (N, G) of labelled states are of one class only for a sub-goal.

    ``where`` and ``do`` are parts of the error.
    """
    for goal, column in zip(goals, labels.T, strict=True):
        if len(np.unique(column)) < 2:
            lacking = "negatives" if column.any() else "positives"
            raise Unmet(f"{goal} has no {lacking} among {len(labels)} labelled states", where, do)


def require_names(sub_goals: Sequence[str]) -> None:
    """Raise ``UserError`` if there are no names, if a name is not plain, or if two names differ only in case."""
    if not plain_names(sub_goals):
        do = f"Give one or more, different even if case is ignored, without separators and {' '.join(NO_FILE_NAME)}"
        raise UserError("sub-goals need different names that are usable as file names", ", ".join(sub_goals), f"{do}.")
