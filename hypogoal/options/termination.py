"""When options end: whether their sub-goals hold in states, each of which is judged once (Spec D1, D2).

A member that is as sure as its threshold, to the last bits of a float32, may say yes to a state among some and no to it
among others: libraries round otherwise in batches of another size. So the first verdict stands, for a run and for what
resumes it.
"""

from collections.abc import Callable, Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from hypogoal.core.checkpoints import Resumable
from hypogoal.core.compute import tensor
from hypogoal.core.errors import UserError
from hypogoal.domains.base import Engine
from hypogoal.hypotheses.ensemble import Ensemble
from hypogoal.hypotheses.networks import as_input, folded
from hypogoal.hypotheses.stacked import StackedMembers

UNKNOWN = -1  # no verdict yet
MANY = 256  # states from which each ensemble's own prediction, which computes distinct patches once, is faster


class Terminations(Resumable):
    """Which options' sub-goals hold in states; of each state and option a classifier is asked once.

    Args:
        classify: state ids (n,) -> bool (n, O).
        options: the number of options, O.
        classify_one: state ids (n,) and an option -> bool (n,), where that costs less; None, where it does not.
    """

    CHANGING = ("_said",)

    def __init__(
        self,
        classify: Callable[[NDArray[np.int64]], NDArray[np.bool_]],
        options: int,
        classify_one: Callable[[NDArray[np.int64], int], NDArray[np.bool_]] | None = None,
    ):
        self.classify, self.options, self.classify_one = classify, options, classify_one
        self._said = np.full((1024, options), UNKNOWN, dtype=np.int8)

    def of(self, ids: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Whether each option's sub-goal holds: bool (n, O) for states (n,)."""
        self._grow(ids)
        unknown = (self._said[ids] == UNKNOWN).any(1)
        if unknown.any():
            fresh = np.unique(ids[unknown])
            said = self._said[fresh]
            self._said[fresh] = np.where(said == UNKNOWN, self.classify(fresh), said)
        return self._said[ids] == 1

    def of_running(self, ids: NDArray[np.int64], options: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Whether the sub-goals of the options that run hold: bool (n,) for states (n,) and options (n,)."""
        if self.classify_one is None:
            return self.of(ids)[np.arange(len(ids)), options]
        self._grow(ids)
        unknown = self._said[ids, options] == UNKNOWN
        for option in np.unique(options[unknown]):
            fresh = np.unique(ids[unknown & (options == option)])
            self._said[fresh, option] = self.classify_one(fresh, int(option))
        return self._said[ids, options] == 1

    def _grow(self, ids: NDArray[np.int64]) -> None:
        size, highest = len(self._said), int(ids.max(initial=-1))
        if highest >= size:
            more = np.full((max(highest + 1 - size, size), self.options), UNKNOWN, dtype=np.int8)
            self._said = np.concatenate([self._said, more])


def oracle_terminations(engine: Engine, columns: Sequence[int]) -> Terminations:
    """Spec E6: the true predicates of these sub-goals, by number, one option each; an upper bound, never the method."""
    return Terminations(lambda ids: engine.labels(ids)[:, columns], len(columns))


def learned_terminations(engine: Engine, ensembles: Sequence[Ensemble], *, running_only: bool = False) -> Terminations:
    """Spec D1: option g*K + k terminates where member k of sub-goal g's ensemble, of G with K members each, says yes.

    ``running_only``: nobody asks for other options than the running ones: with K members a state costs a K-th.
    """
    stacked = StackedMembers(ensembles, repeats=engine.tiles is not None)
    networks = [folded(network) for ensemble in ensembles for network in ensemble.eval().networks()]
    members = len(ensembles[0])

    def seen(ids: NDArray[np.int64], needs_positions: bool) -> tuple[NDArray[np.uint8], NDArray[np.int64] | None]:
        if needs_positions and not engine.position_names:
            what = "the ensemble needs the agent's positions (localiser=ram)"
            raise UserError(what, None, "Train it with localiser=learned.")
        return engine.images(ids), engine.positions(ids) if needs_positions else None

    def classify(ids: NDArray[np.int64]) -> NDArray[np.bool_]:
        states = seen(ids, stacked.needs_positions)
        if len(ids) < MANY:
            return stacked.verdicts(*states)
        return np.concatenate([ensemble.verdicts(*states) for ensemble in ensembles], axis=1)

    def classify_one(ids: NDArray[np.int64], option: int) -> NDArray[np.bool_]:
        ensemble, member = ensembles[option // members], option % members
        views = ensemble.see(*seen(ids, ensemble.needs_positions))
        with torch.inference_mode():
            images = as_input(tensor(views, ensemble.thresholds.device))
            chance = networks[option](images).softmax(-1)[:, 1]
            says_yes: NDArray[np.bool_] = (chance > ensemble.thresholds[member]).cpu().numpy()
        return says_yes

    return Terminations(classify, len(networks), classify_one if running_only else None)
