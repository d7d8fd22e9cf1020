"""Members' verdicts on states (is your sub-goal reached?), cached by state id where states repeat."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from hypogoal.core.errors import UserError
from hypogoal.domains.base import Engine
from hypogoal.hypotheses.ensemble import THRESHOLD as THRESHOLD  # for those who import it from here
from hypogoal.hypotheses.stacked import StackedMembers

if TYPE_CHECKING:
    from hypogoal.hypotheses.ensemble import Ensemble

Classifier = Callable[[NDArray[np.int64]], NDArray[np.bool_]]
MANY = 256  # states from which each ensemble's own prediction, which computes distinct patches once, is faster


def learned_terminations(engine: Engine, ensembles: Sequence[Ensemble]) -> Classifier:
    """Spec D1: option g*K + k terminates where member k of sub-goal g's ensemble says yes.

    Returns:
        A function from state ids (n,) to verdicts bool (n, G*K).
    """

    stacked = StackedMembers(ensembles, repeats=engine.tiles is not None)

    def classify(ids: NDArray[np.int64]) -> NDArray[np.bool_]:
        images = engine.images(ids)
        positions = positions_of(engine, ids) if stacked.needs_positions else None
        if len(ids) < MANY:
            return stacked.verdicts(images, positions)
        return np.concatenate([ensemble.verdicts(images, positions) for ensemble in ensembles], axis=1)

    return classify


def positions_of(engine: Engine, ids: NDArray[np.int64]) -> NDArray[np.int64]:
    """Where the agent is in states, for ensembles that need it.

    Raises:
        UserError: the engine does not know it.
    """
    if not engine.position_names:
        raise UserError(
            "the ensemble needs the agent's positions (localiser=ram)", None, "Train it with localiser=learned."
        )
    return engine.positions(ids)


def oracle_terminations(engine: Engine, columns: Sequence[int] | None = None) -> Classifier:
    """Spec E6: the true sub-goal predicates, one option per sub-goal; an upper bound, never the method.

    Args:
        engine: knows them.
        columns: which of its sub-goals, in this order; None: all.
    """
    return engine.labels if columns is None else lambda ids: engine.labels(ids)[:, columns]


class Verdicts:
    """A classifier of states with a cache: each state is judged once.

    Args:
        classify: state ids (n,) -> bool (n, O).
        options: the number of options, O.
    """

    def __init__(self, classify: Classifier, options: int):
        self.classify, self.options = classify, options
        self._known = np.zeros(1024, dtype=np.bool_)
        self._rows = np.zeros((1024, options), dtype=np.bool_)

    def of(self, ids: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Verdicts bool (n, O) of states (n,)."""
        highest = int(ids.max()) + 1
        if highest > len(self._known):
            size = max(highest, 2 * len(self._known))
            self._known = np.concatenate([self._known, np.zeros(size - len(self._known), dtype=np.bool_)])
            self._rows = np.concatenate([self._rows, np.zeros((size - len(self._rows), self.options), dtype=np.bool_)])
        known = self._known[ids]
        if not known.all():
            fresh = np.unique(ids[~known])
            self._rows[fresh] = self.classify(fresh)
            self._known[fresh] = True
        return self._rows[ids]

    def snapshot(self) -> dict[str, Any]:
        """What was said so far. A verdict at the edge may depend on which states were judged together."""
        return {"known": self._known.copy(), "rows": self._rows.copy()}

    def restore(self, snapshot: Mapping[str, Any]) -> None:
        """Stand by what was said in a ``snapshot``."""
        self._known, self._rows = snapshot["known"].copy(), snapshot["rows"].copy()
