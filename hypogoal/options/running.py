"""Verdicts of the running members only: with own experience nobody asks for the others' (Spec D1, D2)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray

from hypogoal.core.compute import tensor
from hypogoal.domains.base import Engine
from hypogoal.hypotheses.networks import as_input, folded
from hypogoal.options.verdicts import Verdicts, learned_terminations, positions_of

if TYPE_CHECKING:
    from hypogoal.hypotheses.ensemble import Ensemble


class MemberVerdicts(Verdicts):
    """Verdicts that can be had member by member: with K members a state costs a K-th.

    Args:
        engine: gives observations of state ids, and positions where the ensembles need them.
        ensembles: G ensembles of K members each.
    """

    def __init__(self, engine: Engine, ensembles: Sequence[Ensemble]):
        self.members = len(ensembles[0])
        super().__init__(learned_terminations(engine, ensembles), len(ensembles) * self.members)
        self.engine, self.ensembles = engine, ensembles
        self._networks = [folded(network) for ensemble in ensembles for network in ensemble.eval().networks()]
        self._asked = np.zeros((1024, self.options), dtype=np.bool_)
        self._said = np.zeros((1024, self.options), dtype=np.bool_)

    def running(self, ids: NDArray[np.int64], options: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Whether each option's own sub-goal holds: bool (n,) for states (n,) and options (n,); each asked once."""
        highest = int(ids.max()) + 1
        if highest > len(self._asked):
            more = np.zeros((max(highest, 2 * len(self._asked)) - len(self._asked), self.options), dtype=np.bool_)
            self._asked, self._said = (np.concatenate([known, more]) for known in (self._asked, self._said))
        fresh = ~self._asked[ids, options]
        for option in np.unique(options[fresh]):
            states = np.unique(ids[fresh & (options == option)])
            self._said[states, option] = self._ask(states, int(option))
            self._asked[states, option] = True
        return self._said[ids, options]

    def _ask(self, ids: NDArray[np.int64], option: int) -> NDArray[np.bool_]:
        ensemble, member = self.ensembles[option // self.members], option % self.members
        positions = positions_of(self.engine, ids) if ensemble.needs_positions else None
        seen = ensemble.see(self.engine.images(ids), positions)
        with torch.inference_mode():
            images = as_input(tensor(seen, ensemble.thresholds.device))
            chance = self._networks[option](images).softmax(-1)[:, 1]
            says_yes: NDArray[np.bool_] = (chance > ensemble.thresholds[member]).cpu().numpy()
        return says_yes

    def snapshot(self) -> dict[str, Any]:
        """As of :class:`Verdicts`."""
        return {**super().snapshot(), "asked": self._asked.copy(), "said": self._said.copy()}

    def restore(self, snapshot: Mapping[str, Any]) -> None:
        """As of :class:`Verdicts`."""
        super().restore(snapshot)
        self._asked, self._said = snapshot["asked"].copy(), snapshot["said"].copy()


def running_verdicts(verdicts: Verdicts, ids: NDArray[np.int64], options: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Whether each option's own sub-goal holds: bool (n,) for states (n,) and options (n,)."""
    if not len(ids):
        return np.empty(0, dtype=np.bool_)
    if isinstance(verdicts, MemberVerdicts):
        return verdicts.running(ids, options)
    return verdicts.of(ids)[np.arange(len(ids)), options]
