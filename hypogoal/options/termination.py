"""What decides that an option ends: a rule, which every loop that plays options asks.

An execution ends at the first of three things (``reached``, ``timed_out``, ``over`` in ``OptionLoop.advance`` and
``OptionEnv.step``): its sub-goal is reached, as :meth:`TerminationRule.reached` says; it has taken ``option_timeout``
steps; its episode ends.
By default the sub-goal is reached where the prediction of the option's own member is positive: where the member's
log-odds lie above its threshold. Another rule is another subclass, named by the setting ``termination``; with
``termination=oracle`` the sub-goals' true labels stand in for predictions.

Inside an engine each state is judged once. Libraries round differently in batches of another size. So a member whose
probability is at its threshold, to the last bits of a float32, may give a state another prediction in another batch.
The first prediction stands, for a run and for what resumes it.
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

THRESHOLDS = "thresholds"  # in an artefact: log-odds
ORACLE = "oracle"  # the setting ``termination`` of options that end at true sub-goals


class TerminationRule(Part):
    """An execution ends at the first state in which its own member's prediction is positive (the paper).

    Other rules are subclasses: :meth:`reached`, asked at every step of training, of frozen play and of ``OptionEnv``,
    and :meth:`finished`, called in training alone, where a rule learns from executions. What it keeps of a running
    execution is by environment, and begins anew where ``age`` is 0; in ``OptionEnv``, which has its own object, E is 1.
    What it learns goes into checkpoints by ``CHANGING`` and into artefacts by :meth:`state`. A rule ends executions;
    rewards and targets of policies, and which options are offered, go by :meth:`positive`, of one state, all the same.

    Args:
        thresholds: float32 (O,), log-odds above which a prediction is positive.
        environments: E.
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
        """Whether executions reach their sub-goals in the states they come to: bool (E,), called once a step.

        ``log_odds`` float32 (E,) are how sure the running ``options`` (E,) are of these states, ``age`` (E,) their
        steps before this one.
        """
        return self.positive(log_odds, options)

    def finished(
        self,
        environments: Ints,
        options: Ints,
        reached: Bools,
    ) -> None:
        """Executions (n,) that ended in training, and which of them reached their sub-goals."""

    def begin_episodes(self, environments: Ints) -> None:
        """Episodes begin in these environments (n,), in training and in play; by default nothing is remembered."""

    def positive(self, log_odds: Floats, options: Ints | slice = slice(None)) -> Bools:
        """Predictions by today's thresholds, of options (n,), or of all where the log-odds are (n, O)."""
        return log_odds > self.thresholds[options]

    def state(self) -> dict[str, torch.Tensor]:
        """What an artefact keeps."""
        return {THRESHOLDS: torch.from_numpy(self.thresholds.copy())}

    def load(self, state: Mapping[str, torch.Tensor]) -> None:
        """Go on with what an artefact kept."""
        self.thresholds = saved_row(state, THRESHOLDS, self.options)


class Terminations(Resumable):
    """Where the options' sub-goals hold in an engine, by its states' ids; each state is judged once.

    Args:
        classify: state ids (n,) -> log-odds float32 (n, O).
        rule: has the thresholds, and ends executions.
        classify_one: state ids (n,) and an option -> its log-odds (n,); None: classify for all options.
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
        self.judged = np.zeros((0, self.options), np.float32)  # log-odds of states by id; NaN: not judged yet

    @classmethod
    def of_predictions(cls, predict: Callable[[Ints], Bools], options: int, environments: int = 1) -> Self:
        """Where predictions say so: state ids (n,) -> bool (n, O)."""
        return cls(predict, TerminationRule(np.zeros(options, np.float32), environments))

    def of(self, ids: Ints) -> Bools:
        """Whether each option's sub-goal holds: bool (n, O) for states (n,)."""
        return self.rule.positive(self._all(ids))

    def of_running(self, ids: Ints, options: Ints) -> Bools:
        """Whether the sub-goals of the options that run hold: bool (n,), of states (n,)."""
        return self.rule.positive(self.log_odds(ids, options), options)

    def log_odds(self, ids: Ints, options: Ints) -> Floats:
        """How sure the options that run are that their sub-goals hold: float32 (n,)."""
        if self.classify_one is None:
            return self._all(ids)[np.arange(len(ids)), options]
        self._grow(ids)
        unknown = np.isnan(self.judged[ids, options])
        for option in np.unique(options[unknown]):
            fresh = np.unique(ids[unknown & (options == option)])
            self.judged[fresh, option] = self.classify_one(fresh, int(option))
        return self.judged[ids, options]

    def _all(self, ids: Ints) -> Floats:
        """Log-odds (n, O)."""
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
        """Room for these states, twice as much as before at least."""
        size = len(self.judged)
        missing = ids.max(initial=-1) + 1 - size
        if missing > 0:
            more = max(missing, size, 1024)
            self.judged = np.pad(self.judged, ((0, more), (0, 0)), constant_values=np.nan)


RULES = {"learned": f"{__name__}:TerminationRule"}


def load_rule(name: str) -> type[TerminationRule]:
    """The class that the setting ``termination`` names; a ``UserError`` where it names none."""
    return load_class(name, "termination rule", TerminationRule, RULES)


def saved_rule(termination: str, weights: Mapping[str, torch.Tensor], options: int) -> TerminationRule:
    """That of an artefact with such weights."""
    rule = load_rule(termination)(np.zeros(options, np.float32))
    rule.load(weights)
    return rule


def oracle_terminations(engine: Engine, columns: Sequence[int]) -> Terminations:
    """One option for each of these sub-goals, by number, that ends where it is true; an upper bound."""
    return Terminations.of_predictions(lambda ids: engine.labels(ids)[:, columns], len(columns), engine.count)


def learned_terminations(
    engine: Engine,
    ensembles: Sequence[Ensemble],
    *,
    running_only: bool = False,
    rule: str = "learned",
) -> Terminations:
    """Option g*K + k ends at a positive prediction of member k of sub-goal g's ensemble, of G with K members.

    ``running_only``: states are classified for the running options only, which costs a K-th.
    ``rule``: see :func:`load_rule`.
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
