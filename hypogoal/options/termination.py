"""When options end: whether their sub-goals hold in states, each of which is judged once (Spec D1, D2).

A member that is as sure as its threshold, to the last bits of a float32, may say yes to a state among some and no to it
among others: libraries round otherwise in batches of another size. So the first verdict stands, for a run and for what
resumes it.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray

from hypogoal.core.checkpoints import Resumable
from hypogoal.core.compute import tensor
from hypogoal.core.errors import UserError
from hypogoal.core.tensors import AGAIN
from hypogoal.dataset import Observations
from hypogoal.domains.base import Engine
from hypogoal.hypotheses.ensemble import Ensemble
from hypogoal.hypotheses.networks import as_input, folded
from hypogoal.hypotheses.stacked import StackedMembers

THRESHOLDS = "thresholds"  # in an artefact: log-odds
MANY = 256  # states from which each ensemble's own prediction, which computes distinct patches once, is faster


class Terminations(Resumable):
    """Which options' sub-goals hold in states; of each state and option a classifier is asked once.

    An execution ends at the first state in which its own sub-goal holds (the paper). Other rules are subclasses, which
    are told how many ``environments`` there are, and their ``length``.

    Args:
        classify: state ids (n,) -> log-odds float32 (n, O), or verdicts, bool (n, O).
        classify_one: state ids (n,) and an option -> (n, ``together``), where that costs less; None, where it does not.
        together: how many options on end it judges at once, of which the option given is the first.
        thresholds: float32 (O,), the log-odds above which it is a yes; 0 where None, which fits verdicts, too.
    """

    CHANGING: ClassVar[tuple[str, ...]] = ("_log_odds", "thresholds")
    SHARED = True  # whether it is enough to judge a state, so that options can learn from what others visit

    def __init__(
        self,
        classify: Callable[[NDArray[np.int64]], NDArray[np.float32] | NDArray[np.bool_]],
        options: int,
        classify_one: Callable[[NDArray[np.int64], int], NDArray[np.float32]] | None = None,
        thresholds: NDArray[np.float32] | None = None,
        environments: int = 0,
        length: int = 0,
        together: int = 1,
    ):
        self.together = together
        self.classify, self.options, self.classify_one = classify, options, classify_one
        self.thresholds = np.zeros(options, dtype=np.float32) if thresholds is None else thresholds
        self.environments, self.length = environments, length
        self._log_odds = np.full((1024, options), np.nan, dtype=np.float32)  # NaN: not asked yet

    def items(self) -> dict[str, Any]:
        return {"_log_odds": self._log_odds[:1]}

    def of(self, ids: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Whether each option's sub-goal holds: bool (n, O) for states (n,)."""
        self._grow(ids)
        unknown = np.isnan(self._log_odds[ids]).any(1)
        if unknown.any():
            fresh = np.unique(ids[unknown])
            known = self._log_odds[fresh]
            self._log_odds[fresh] = np.where(np.isnan(known), self.classify(fresh), known)
        says_yes: NDArray[np.bool_] = self._log_odds[ids] > self.thresholds
        return says_yes

    def of_running(self, ids: NDArray[np.int64], options: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Whether the sub-goals of the options that run hold: bool (n,) for states (n,) and options (n,)."""
        says_yes: NDArray[np.bool_] = self.log_odds(ids, options) > self.thresholds[options]
        return says_yes

    def log_odds(self, ids: NDArray[np.int64], options: NDArray[np.int64]) -> NDArray[np.float32]:
        """How sure the options that run are that their sub-goals hold: float32 (n,)."""
        self._grow(ids)
        if self.classify_one is None:
            self.of(ids)
        unknown = np.isnan(self._log_odds[ids, options])
        firsts = options - options % self.together
        for first in np.unique(firsts[unknown]):
            assert self.classify_one is not None
            fresh = np.unique(ids[unknown & (firsts == first)])
            judged = self.classify_one(fresh, int(first)).reshape(len(fresh), self.together)
            self._log_odds[fresh, first : first + self.together] = judged
        return self._log_odds[ids, options]

    def reached(self, ids: NDArray[np.int64], options: NDArray[np.int64], age: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Whether executions reach their sub-goals in the states they come to: bool (E,), asked once a step.

        ``age`` (E,) steps were made before this one.
        """
        return self.of_running(ids, options)

    def finished(self, environments: NDArray[np.int64], options: NDArray[np.int64], reached: NDArray[np.bool_]) -> None:
        """Executions (n,) that ended, and which of them reached their sub-goals."""

    def judged(
        self,
        options: NDArray[np.int64],
        ids: NDArray[np.int64],
        next_ids: NDArray[np.int64],
        reached: NDArray[np.bool_],
    ) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Of transitions (n,) of the past, as of today: whether they begin and end in their option's sub-goal.

        ``reached`` says whether its execution reached it then.
        """
        return self.of_running(ids, options), self.of_running(next_ids, options)

    def state(self) -> dict[str, torch.Tensor]:
        """What an artefact keeps."""
        return {THRESHOLDS: torch.from_numpy(self.thresholds.copy())}

    def load(self, state: Mapping[str, torch.Tensor]) -> None:
        """Go on with the thresholds of an artefact; where it is from before there were any, with the ensemble's."""
        if THRESHOLDS in state:
            self.thresholds = thresholds_in(state, self.options)

    def _grow(self, ids: NDArray[np.int64]) -> None:
        size, highest = len(self._log_odds), int(ids.max(initial=-1))
        if highest >= size:
            more = np.full((max(highest + 1 - size, size), self.options), np.nan, dtype=np.float32)
            self._log_odds = np.concatenate([self._log_odds, more])


def thresholds_in(state: Mapping[str, torch.Tensor], options: int) -> NDArray[np.float32]:
    """The log-odds float32 (O,) that an artefact keeps; a ``UserError`` where they are none."""
    saved = state.get(THRESHOLDS)
    if saved is None or saved.shape != (options,) or saved.dtype != torch.float32 or not saved.isfinite().all():
        raise UserError(f"the weights do not fit the manifest (at {THRESHOLDS})", f"{options} options", AGAIN)
    return saved.numpy().copy()


class Patience(Terminations):
    """An option that hardly ever gets to its sub-goal becomes content with less (ours).

    After every ``length`` steps of an option in which under ``ENOUGH`` of its executions reached, its threshold falls
    to ``NEXT`` of the highest log-odds that it saw meanwhile, never below ``LEAST`` of the first threshold.
    """

    CHANGING = (*Terminations.CHANGING, "_first", "_best", "_steps", "_executions", "_reaches", "_highest")
    ENOUGH, NEXT, LEAST = 0.05, 0.75, 0.5

    def __init__(self, *arguments: Any, **more: Any):
        super().__init__(*arguments, **more)
        self._first = self.thresholds.copy()
        self._best = np.full(self.environments, -np.inf, dtype=np.float32)  # of each running execution
        self._steps, self._executions, self._reaches = np.zeros((3, self.options), dtype=np.int64)
        self._highest = np.full(self.options, -np.inf, dtype=np.float32)

    def reached(self, ids: NDArray[np.int64], options: NDArray[np.int64], age: NDArray[np.int64]) -> NDArray[np.bool_]:
        now = self.log_odds(ids, options)
        self._best = np.where(age == 0, now, np.maximum(self._best, now))
        np.add.at(self._steps, options, 1)
        says_yes: NDArray[np.bool_] = now > self.thresholds[options]
        return says_yes

    def finished(self, environments: NDArray[np.int64], options: NDArray[np.int64], reached: NDArray[np.bool_]) -> None:
        """As of :class:`Terminations`; then options whose time has come are judged."""
        np.add.at(self._executions, options, 1)
        np.add.at(self._reaches, options, reached)
        np.maximum.at(self._highest, options, self._best[environments])
        due = self._steps >= self.length
        content = self._reaches >= self.ENOUGH * self._executions
        less = np.maximum(self.LEAST * self._first, self.NEXT * self._highest)
        self.thresholds = np.where(due & ~content, np.minimum(self.thresholds, less), self.thresholds)
        for counted in (self._steps, self._executions, self._reaches):
            counted[due] = 0
        self._highest[due] = -np.inf


class Dwell(Terminations):
    """An execution ends where its sub-goal has held in so many states on end, ``length`` of them."""

    CHANGING = (*Terminations.CHANGING, "_held")
    SHARED = False

    def __init__(self, *arguments: Any, **more: Any):
        super().__init__(*arguments, **more)
        self._held = np.zeros(self.environments, dtype=np.int64)

    def reached(self, ids: NDArray[np.int64], options: NDArray[np.int64], age: NDArray[np.int64]) -> NDArray[np.bool_]:
        self._held = np.where(self.of_running(ids, options), np.where(age == 0, 0, self._held) + 1, 0)
        long: NDArray[np.bool_] = self._held >= self.length
        return long

    def judged(
        self,
        options: NDArray[np.int64],
        ids: NDArray[np.int64],
        next_ids: NDArray[np.int64],
        reached: NDArray[np.bool_],
    ) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """As of :class:`Terminations`; a state alone says nothing."""
        return np.zeros_like(reached), reached


RULES: dict[str, type[Terminations]] = {"learned": Terminations, "patience": Patience, "dwell": Dwell}


def rule_of(termination: str) -> tuple[type[Terminations], int]:
    """The rule and its number of ``learned``, ``patience:10000``, ``dwell:3``; a ``UserError`` where it is none."""
    name, colon, number = termination.partition(":")
    known = name in RULES and (number.isdecimal() and int(number) > 0 if name != "learned" else not colon)
    if not known:
        do = "Give learned, patience:STEPS, dwell:STEPS or oracle."
        raise UserError("unknown termination", f"termination={termination}", do)
    return RULES[name], int(number or 0)


def oracle_terminations(engine: Engine, columns: Sequence[int]) -> Terminations:
    """Spec E6: the true predicates of these sub-goals, by number, one option each; an upper bound, never the method."""
    return Terminations(lambda ids: engine.labels(ids)[:, columns], len(columns))


def learned_terminations(
    engine: Engine, ensembles: Sequence[Ensemble], *, running_only: bool = False, rule: str = "learned"
) -> Terminations:
    """Spec D1: option g*K + k terminates where member k of sub-goal g's ensemble, of G with K members each, says yes.

    ``running_only``: nobody asks for other options than the running ones: with K members a state costs a K-th.
    ``rule``: see :func:`rule_of`.
    """
    stacked = StackedMembers(ensembles, repeats=engine.tiles is not None)
    networks = [folded(network) for ensemble in ensembles for network in ensemble.eval().networks]
    members = len(ensembles[0])
    shared = ensembles[0].trunk is not None  # all members cost little more than one

    def seen(ids: NDArray[np.int64], needs_positions: bool) -> tuple[Observations, NDArray[np.int64] | None]:
        if needs_positions and not engine.position_names:
            what = "the ensemble needs the agent's positions (localiser=ram)"
            raise UserError(what, None, "Train it with localiser=learned.")
        return engine.images(ids), engine.positions(ids) if needs_positions else None

    def classify(ids: NDArray[np.int64]) -> NDArray[np.float32]:
        states = seen(ids, stacked.needs_positions)
        if len(ids) < MANY:
            return stacked.log_odds(*states)
        return np.concatenate([ensemble.log_odds(*states) for ensemble in ensembles], axis=1)

    def classify_one(ids: NDArray[np.int64], option: int) -> NDArray[np.float32]:
        ensemble = ensembles[option // members]
        if shared:
            return ensemble.log_odds(*seen(ids, ensemble.needs_positions))
        views = ensemble.see(*seen(ids, ensemble.needs_positions))
        with torch.inference_mode():
            logits = networks[option](as_input(tensor(views, ensemble.thresholds.device)))
            log_odds: NDArray[np.float32] = (logits[:, 1] - logits[:, 0]).cpu().numpy()
        return log_odds

    kind, length = rule_of(rule)
    return kind(
        classify,
        len(networks),
        classify_one if running_only else None,
        np.concatenate([ensemble.thresholds_as_log_odds() for ensemble in ensembles]),
        engine.count,
        length,
        members if shared else 1,
    )
