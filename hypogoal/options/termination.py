"""Rules that decide when an option has reached its sub-goal. Every loop that plays options asks a rule.

An execution ends at the first of three events (``reached``, ``timed_out``, ``over`` in ``OptionLoop.advance``; they are
the same in ``OptionEnv.step``). Its sub-goal is reached, as :meth:`TerminationRule.reached` says. Or the execution has
taken ``option_timeout`` steps. Or its episode ends.

By default the sub-goal is reached where the prediction of the option's own member is positive, which means that the
member's log-odds lie above its threshold. Another rule is another subclass, which the setting ``termination`` names.
With ``termination=oracle`` the sub-goals' true labels stand in for predictions.

Inside an engine each state is judged once. The reason is that libraries round differently in batches of another size.
So a member whose probability is at its threshold, to the last bits of a float32, may predict differently for a state in
another batch. The first prediction stands, for a run and for a run that resumes it.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar, Self

import numpy as np
import torch

from hypogoal.core.arrays import Bools, Floats, Ints, tensor
from hypogoal.core.checkpoints import Resumable
from hypogoal.core.own_code import load_class
from hypogoal.domains.base import Engine
from hypogoal.hypotheses.ensemble import Ensemble
from hypogoal.hypotheses.networks import as_input
from hypogoal.hypotheses.stacked import StackedMembers
from hypogoal.options.parts import Part, saved_row

THRESHOLDS = "thresholds"  # the name of the thresholds in an artefact, which are log-odds
ORACLE = "oracle"  # the value of the setting ``termination`` for options that end at true sub-goals


class TerminationRule(Part):
    """The rule that an execution ends at the first state in which its own member's prediction is positive (the paper).

    Other rules are subclasses. They override :meth:`reached`, which is called at every step of training, of frozen play
    and of ``OptionEnv``. A rule that learns from executions also overrides :meth:`finished`, which is called in
    training alone.

    What a rule keeps of a running execution is kept by environment, and begins anew where ``age`` is 0. ``OptionEnv``
    has a rule object of its own, in which E is 1. What a rule learns goes into checkpoints by ``CHANGING``, and into
    artefacts by :meth:`state`.

    A rule only ends executions. The rewards and targets of policies, and which options are offered, still follow
    :meth:`positive`, which looks at one state.

    Args:
        thresholds: float32 (O,), the log-odds above which a prediction is positive.
        environments: E, the number of environments.
    """

    CHANGING: ClassVar[tuple[str, ...]] = (THRESHOLDS,)

    def __init__(self, thresholds: Floats, environments: int = 1):
        self.thresholds, self.environments = thresholds, environments
        self.options = len(thresholds)

    def reached(
        self,
        log_odds: Floats,
        options: Ints,
        age: Ints,
    ) -> Bools:
        """Return whether each execution reaches its sub-goal in the state to which it comes, bool (E,).

        The method is called once a step. ``log_odds``, float32 (E,), say how sure the running ``options`` (E,) are that
        their sub-goal holds in the state. ``age`` (E,) is the number of steps that the execution took before this step.
        """
        return self.positive(log_odds, options)

    def finished(
        self,
        environments: Ints,
        options: Ints,
        reached: Bools,
    ) -> None:
        """Learn that executions (n,) ended in training, and which of them reached their sub-goals.

        By default nothing is done.
        """

    def begin_episodes(self, environments: Ints) -> None:
        """Learn that episodes begin in ``environments`` (n,), in training or in play. By default nothing is done."""

    def positive(self, log_odds: Floats, options: Ints | slice = slice(None)) -> Bools:
        """Return whether predictions are positive by today's thresholds, in the shape of ``log_odds``.

        ``log_odds`` are those of ``options`` (n,), or of all options if their shape is (n, O).
        """
        return log_odds > self.thresholds[options]

    def state(self) -> dict[str, torch.Tensor]:
        """Return what an artefact keeps, by name."""
        return {THRESHOLDS: torch.from_numpy(self.thresholds.copy())}

    def load(self, state: Mapping[str, torch.Tensor]) -> None:
        """Load what an artefact kept, to go on from there."""
        self.thresholds = saved_row(state, THRESHOLDS, self.options)


class Terminations(Resumable):
    """Answers where the options' sub-goals hold in an engine, by the ids of states. Each state is judged once.

    Args:
        classify: a function from state ids (n,) to log-odds float32 (n, O).
        rule: the rule, which has the thresholds and ends executions.
        classify_one: a function from state ids (n,) and an option to that option's log-odds (n,). With None,
            ``classify`` is called for all options.
    """

    CHANGING = ("judged", "rule")

    def __init__(
        self,
        classify: Callable[[Ints], Any],
        rule: TerminationRule,
        classify_one: Callable[[Ints, int], Floats] | None = None,
    ):
        self.classify, self.rule, self.classify_one = classify, rule, classify_one
        self.options = rule.options
        self.judged = np.zeros((0, self.options), np.float32)  # log-odds by state id, NaN where not judged yet

    @classmethod
    def of_predictions(cls, predict: Callable[[Ints], Bools], options: int, environments: int = 1) -> Self:
        """Return terminations by ``predict``, a function from state ids (n,) to predictions bool (n, O)."""
        return cls(predict, TerminationRule(np.zeros(options, np.float32), environments))

    def of(self, ids: Ints) -> Bools:
        """Return whether each option's sub-goal holds in states ``ids`` (n,), bool (n, O)."""
        return self.rule.positive(self._all(ids))

    def of_running(self, ids: Ints, options: Ints) -> Bools:
        """Return whether the sub-goals of the running ``options`` (n,) hold in states ``ids`` (n,), bool (n,)."""
        return self.rule.positive(self.log_odds(ids, options), options)

    def log_odds(self, ids: Ints, options: Ints) -> Floats:
        """Return how sure the running ``options`` (n,) are that their sub-goals hold, float32 (n,).

        ``ids`` (n,) are the states in which they run.
        """
        if self.classify_one is None:
            return self._all(ids)[np.arange(len(ids)), options]
        self._grow(ids)
        unknown = np.isnan(self.judged[ids, options])
        for option in np.unique(options[unknown]):
            fresh = np.unique(ids[unknown & (options == option)])
            self.judged[fresh, option] = self.classify_one(fresh, int(option))
        return self.judged[ids, options]

    def _all(self, ids: Ints) -> Floats:
        """Return the log-odds of all options in states ``ids`` (n,), float32 (n, O)."""
        self._grow(ids)
        judged = self.judged[ids]
        unknown = np.isnan(judged).any(axis=1)
        if not unknown.any():
            return judged
        fresh = np.unique(ids[unknown])
        before = self.judged[fresh]
        new = np.isnan(before)
        self.judged[fresh] = np.where(new, self.classify(fresh), before)
        return self.judged[ids]

    def _grow(self, ids: Ints) -> None:
        """Make room for the states ``ids``, at least twice the room there was before."""
        size = len(self.judged)
        missing = ids.max(initial=-1) + 1 - size
        if missing > 0:
            more = max(missing, size, 1024)
            self.judged = np.pad(self.judged, ((0, more), (0, 0)), constant_values=np.nan)


RULES = {"learned": f"{__name__}:TerminationRule"}


def load_rule(name: str) -> type[TerminationRule]:
    """Return the class that the setting ``termination`` names. Raises ``UserError`` if there is no such class."""
    return load_class(name, "termination rule", TerminationRule, RULES)


def saved_rule(termination: str, weights: Mapping[str, torch.Tensor], options: int) -> TerminationRule:
    """Return the rule ``termination`` with the weights of an artefact."""
    rule = load_rule(termination)(np.zeros(options, np.float32))
    rule.load(weights)
    return rule


def oracle_terminations(engine: Engine, columns: Sequence[int]) -> Terminations:
    """Return terminations for one option per sub-goal, which ends where the sub-goal is true.

    ``columns`` are the numbers of the sub-goals. Such options are an upper bound.
    """
    return Terminations.of_predictions(lambda ids: engine.labels(ids)[:, columns], len(columns), engine.count)


def learned_terminations(
    engine: Engine,
    ensembles: Sequence[Ensemble],
    *,
    running_only: bool = False,
    rule: str = "learned",
) -> Terminations:
    """Return terminations of the options of G ensembles with K members each.

    Option g*K + k ends at a positive prediction of member k of the ensemble of sub-goal g.

    Args:
        engine: the engine.
        ensembles: the G ensembles.
        running_only: whether states are classified for the running options only, which costs a K-th of the time.
        rule: the name of the rule, see :func:`load_rule`.
    """
    stacked = StackedMembers(ensembles)
    members = len(ensembles[0])

    def classify_one(ids: Ints, option: int) -> Floats:
        ensemble = ensembles[option // members]
        views = ensemble.see(engine.images(ids))
        with torch.inference_mode():
            logits = stacked.networks[option](as_input(tensor(views, stacked.device)))
            return (logits[:, 1] - logits[:, 0]).cpu().numpy()

    thresholds = np.concatenate([ensemble.thresholds_as_log_odds() for ensemble in ensembles])
    return Terminations(
        lambda ids: stacked.log_odds(engine.images(ids)),
        load_rule(rule)(thresholds, engine.count),
        classify_one if running_only else None,
    )
