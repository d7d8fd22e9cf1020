"""When options end: whether their sub-goals hold in states, each of which is judged once (Spec D1, D2).

Libraries round differently in batches of another size. So a member whose probability is at its threshold, to the last
bits of a float32, may give a state another prediction in another batch. The first prediction stands, for a run and for
what resumes it.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import ClassVar

import numpy as np
import torch
from numpy.typing import NDArray

from hypogoal.core.arrays import tensor
from hypogoal.core.artefacts import AGAIN
from hypogoal.core.errors import UserError
from hypogoal.domains.base import Engine
from hypogoal.hypotheses.ensemble import Ensemble
from hypogoal.hypotheses.networks import as_input, folded
from hypogoal.hypotheses.stacked import StackedMembers
from hypogoal.options.parts import Part, load_part

THRESHOLDS = "thresholds"  # in an artefact: log-odds
ORACLE = "oracle"  # the setting ``termination`` of options that end at true sub-goals
MANY = 256  # states from which each ensemble's own prediction, which computes distinct patches once, is faster


class Terminations(Part):
    """Which options' sub-goals hold in states; each state is classified once for each option.

    An execution ends at the first state in which its own sub-goal holds (the paper). Other rules are subclasses, by
    which an execution ends otherwise.

    Args:
        classify: state ids (n,) -> log-odds float32 (n, O), or predictions, bool (n, O).
        classify_one: state ids (n,) and an option -> its log-odds (n,); None: classify for all options.
        thresholds: float32 (O,), log-odds above which a prediction is positive; None: 0, which fits predictions, too.
        environments: E.
        length: the number behind the rule's name.

    Attributes:
        NUMBERED: whether a number, ``length``, stands behind the rule's name.
    """

    CHANGING: ClassVar[tuple[str, ...]] = ("_log_odds", "thresholds")
    NUMBERED: ClassVar[bool] = False

    def __init__(
        self,
        classify: Callable[[NDArray[np.int64]], NDArray[np.float32] | NDArray[np.bool_]],
        options: int,
        classify_one: Callable[[NDArray[np.int64], int], NDArray[np.float32]] | None = None,
        thresholds: NDArray[np.float32] | None = None,
        environments: int = 0,
        length: int = 0,
    ):
        self.classify, self.options, self.classify_one = classify, options, classify_one
        self.thresholds = np.zeros(options, dtype=np.float32) if thresholds is None else thresholds
        self.environments, self.length = environments, length
        self._log_odds = np.full((1024, options), np.nan, dtype=np.float32)  # NaN: not classified yet

    def of(self, ids: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Whether each option's sub-goal holds: bool (n, O) for states (n,)."""
        self._grow(ids)
        unknown = np.isnan(self._log_odds[ids]).any(1)
        if unknown.any():
            fresh = np.unique(ids[unknown])
            before = self._log_odds[fresh]
            self._log_odds[fresh] = np.where(np.isnan(before), self.classify(fresh), before)
        positive: NDArray[np.bool_] = self._log_odds[ids] > self.thresholds
        return positive

    def of_running(self, ids: NDArray[np.int64], options: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Whether the sub-goals of the options that run hold, by today's thresholds: bool (n,), of states (n,)."""
        positive: NDArray[np.bool_] = self.log_odds(ids, options) > self.thresholds[options]
        return positive

    def log_odds(self, ids: NDArray[np.int64], options: NDArray[np.int64]) -> NDArray[np.float32]:
        """How sure the options that run are that their sub-goals hold: float32 (n,)."""
        self._grow(ids)
        if self.classify_one is None:
            self.of(ids)
        unknown = np.isnan(self._log_odds[ids, options])
        for option in np.unique(options[unknown]):
            assert self.classify_one is not None
            fresh = np.unique(ids[unknown & (options == option)])
            self._log_odds[fresh, option] = self.classify_one(fresh, int(option))
        return self._log_odds[ids, options]

    def reached(self, ids: NDArray[np.int64], options: NDArray[np.int64], age: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Whether executions reach their sub-goals in the states they come to: bool (E,), called once a step.

        ``age`` (E,) is their steps before this one.
        """
        return self.of_running(ids, options)

    def finished(self, environments: NDArray[np.int64], options: NDArray[np.int64], reached: NDArray[np.bool_]) -> None:
        """Executions (n,) that ended, and which of them reached their sub-goals."""

    def state(self) -> dict[str, torch.Tensor]:
        """What an artefact keeps."""
        return {THRESHOLDS: torch.from_numpy(self.thresholds.copy())}

    def load(self, state: Mapping[str, torch.Tensor]) -> None:
        """Go on with the thresholds of an artefact."""
        self.thresholds = thresholds_in(state, self.options)

    def _grow(self, ids: NDArray[np.int64]) -> None:
        size, highest = len(self._log_odds), int(ids.max(initial=-1))
        if highest >= size:
            more = np.full((max(highest + 1 - size, size), self.options), np.nan, dtype=np.float32)
            self._log_odds = np.concatenate([self._log_odds, more])


def thresholds_in(state: Mapping[str, torch.Tensor], options: int) -> NDArray[np.float32]:
    """The log-odds float32 (O,) that an artefact keeps; a ``UserError`` where they are missing or damaged."""
    saved = state.get(THRESHOLDS)
    if saved is None or saved.shape != (options,) or saved.dtype != torch.float32 or not saved.isfinite().all():
        raise UserError(f"the weights do not fit the manifest (at {THRESHOLDS})", f"{options} options", AGAIN)
    return saved.numpy().copy()


def set_thresholds(ensembles: Sequence[Ensemble], weights: Mapping[str, torch.Tensor]) -> None:
    """Give ensembles the thresholds at which the options of an artefact with these weights end."""
    ends = thresholds_in(weights, sum(map(len, ensembles))).reshape(len(ensembles), -1)
    for ensemble, log_odds in zip(ensembles, ends, strict=True):
        ensemble.set_thresholds((1 / (1 + np.exp(-log_odds))).astype(np.float32))


RULES = {"learned": f"{__name__}:Terminations"}


def rule_of(termination: str) -> tuple[type[Terminations], int]:
    """The rule and its number, of ``learned``, ``module:Class``, ``module:Class:3``.

    Anything else is a ``UserError``.
    """
    name, _, number = termination.rpartition(":")
    if not number.isdecimal():
        name, number = termination, ""
    do = "Give learned, oracle or module:Class."
    if name not in RULES and (":" not in name or name.partition(":")[0] in RULES):
        raise UserError("unknown termination", f"termination={termination}", do)
    rule = load_part(name, "termination rule", Terminations, RULES)
    if bool(number) != rule.NUMBERED or (number and int(number) < 1):
        raise UserError("unknown termination", f"termination={termination}", do)
    return rule, int(number or 0)


def oracle_terminations(engine: Engine, columns: Sequence[int]) -> Terminations:
    """Spec E6: one option for each of these sub-goals, by number, that ends where it is true; an upper bound."""
    return Terminations(lambda ids: engine.labels(ids)[:, columns], len(columns))


def learned_terminations(
    engine: Engine, ensembles: Sequence[Ensemble], *, running_only: bool = False, rule: str = "learned"
) -> Terminations:
    """Spec D1: option g*K + k ends at a positive prediction of member k of sub-goal g's ensemble, of G with K members.

    ``running_only``: states are classified for the running options only, which costs a K-th.
    ``rule``: see :func:`rule_of`.
    """
    stacked = StackedMembers(ensembles)
    networks = [folded(network) for ensemble in ensembles for network in ensemble.eval().networks]
    members = len(ensembles[0])

    def classify(ids: NDArray[np.int64]) -> NDArray[np.float32]:
        states = engine.images(ids)
        if len(ids) < MANY:
            return stacked.log_odds(states)
        return np.concatenate([ensemble.log_odds(states) for ensemble in ensembles], axis=1)

    def classify_one(ids: NDArray[np.int64], option: int) -> NDArray[np.float32]:
        ensemble = ensembles[option // members]
        views = ensemble.see(engine.images(ids))
        with torch.inference_mode():
            logits = networks[option](as_input(tensor(views, ensemble.thresholds.device)))
            log_odds: NDArray[np.float32] = (logits[:, 1] - logits[:, 0]).cpu().numpy()
        return log_odds

    termination, length = rule_of(rule)
    return termination(
        classify,
        len(networks),
        classify_one if running_only else None,
        np.concatenate([ensemble.thresholds_as_log_odds() for ensemble in ensembles]),
        engine.count,
        length,
    )
