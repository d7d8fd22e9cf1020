"""What decides that an option ends: one object, which every loop that plays options asks (Spec D1, D2, H4).

An execution ends at the first of three things (``reached``, ``timed_out``, ``over`` in ``OptionLoop.advance`` and
``OptionEnv.step``): its sub-goal is reached, as :meth:`Terminations.reached` says; it has taken ``option_timeout``
steps; its episode ends.
By default the sub-goal is reached where the prediction of the option's own member is positive: where the member's
log-odds lie above its threshold. Another rule is another subclass, named by the setting ``termination``; with
``termination=oracle`` the sub-goals' true labels stand in for predictions.

Inside an engine each state is judged once. Libraries round differently in batches of another size. So a member whose
probability is at its threshold, to the last bits of a float32, may give a state another prediction in another batch.
The first prediction stands, for a run and for what resumes it.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
import torch

from hypogoal.core.arrays import Bools, Floats, Ints, tensor
from hypogoal.core.own_code import load_class
from hypogoal.domains.base import Engine
from hypogoal.hypotheses.ensemble import Ensemble
from hypogoal.hypotheses.networks import as_input
from hypogoal.hypotheses.stacked import StackedMembers
from hypogoal.options.parts import Part, saved_row

THRESHOLDS = "thresholds"  # in an artefact: log-odds
ORACLE = "oracle"  # the setting ``termination`` of options that end at true sub-goals


class Terminations(Part):
    """An execution ends at the first state in which its own member's prediction is positive (the paper).

    Other rules are subclasses: :meth:`reached`, asked at every step of training, of frozen play and of ``OptionEnv``,
    and :meth:`finished`, called in training alone, where a rule learns from executions. What it keeps of a running
    execution is by environment, and begins anew where ``age`` is 0; in ``OptionEnv``, which has its own object, E is 1.
    What it learns goes into checkpoints by ``CHANGING`` and into artefacts by :meth:`state`. A rule ends executions;
    rewards and targets of policies, and which options are offered, go by :meth:`positive`, of one state, all the same.

    Args:
        classify: state ids (n,) -> log-odds float32 (n, O), or predictions, bool (n, O); None without an engine.
        classify_one: state ids (n,) and an option -> its log-odds (n,); None: classify for all options.
        thresholds: float32 (O,), log-odds above which a prediction is positive; None: 0, which fits predictions, too.
        environments: E.
    """

    CHANGING: ClassVar[tuple[str, ...]] = ("judged", THRESHOLDS)

    def __init__(
        self,
        classify: Callable[[Ints], Any] | None,
        options: int,
        classify_one: Callable[[Ints, int], Floats] | None = None,
        thresholds: Floats | None = None,
        environments: int = 1,
    ):
        self.classify: Any = classify
        self.classify_one = classify_one
        self.options = options
        self.thresholds = np.zeros(options, np.float32) if thresholds is None else thresholds
        self.environments = environments
        self.judged = np.zeros((0, options), np.float32)  # log-odds of states by id; NaN: not judged yet

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

    def positive(self, log_odds: Floats, options: Ints | slice = slice(None)) -> Bools:
        """Predictions by today's thresholds, of options (n,), or of all where the log-odds are (n, O)."""
        return log_odds > self.thresholds[options]

    def of(self, ids: Ints) -> Bools:
        """Whether each option's sub-goal holds: bool (n, O) for states (n,)."""
        return self.positive(self._all(ids))

    def of_running(self, ids: Ints, options: Ints) -> Bools:
        """Whether the sub-goals of the options that run hold: bool (n,), of states (n,)."""
        return self.positive(self.log_odds(ids, options), options)

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

    def state(self) -> dict[str, torch.Tensor]:
        """What an artefact keeps."""
        return {THRESHOLDS: torch.from_numpy(self.thresholds.copy())}

    def load(self, state: Mapping[str, torch.Tensor]) -> None:
        """Go on with what an artefact kept."""
        self.thresholds = saved_row(state, THRESHOLDS, self.options)

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


RULES = {"learned": f"{__name__}:Terminations"}


def load_rule(name: str) -> type[Terminations]:
    """The class that the setting ``termination`` names; a ``UserError`` where it names none."""
    return load_class(name, "termination rule", Terminations, RULES)


def saved_terminations(termination: str, weights: Mapping[str, torch.Tensor], options: int) -> Terminations:
    """Those of an artefact with such weights, for one environment that is no engine's."""
    ends = load_rule(termination)(None, options)
    ends.load(weights)
    return ends


def oracle_terminations(engine: Engine, columns: Sequence[int]) -> Terminations:
    """Spec E6: one option for each of these sub-goals, by number, that ends where it is true; an upper bound."""
    return Terminations(lambda ids: engine.labels(ids)[:, columns], len(columns))


def learned_terminations(
    engine: Engine,
    ensembles: Sequence[Ensemble],
    *,
    running_only: bool = False,
    rule: str = "learned",
) -> Terminations:
    """Spec D1: option g*K + k ends at a positive prediction of member k of sub-goal g's ensemble, of G with K members.

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

    thresholds = [ensemble.thresholds_as_log_odds() for ensemble in ensembles]
    return load_rule(rule)(
        lambda ids: stacked.log_odds(engine.images(ids)),
        len(stacked.networks),
        classify_one if running_only else None,
        np.concatenate(thresholds),
        engine.count,
    )
