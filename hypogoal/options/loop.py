"""Options at work: many environments, each running one option at a time (Spec A3, A4, D1, D6, E1, E5).

The loop knows nothing of how options are chosen or learned: it asks a chooser and a learner. An option runs at least
one step and its termination is tested on the state it arrives at; it ends when its sub-goal is reached (see
:mod:`.termination`), when its time is up, or when the episode ends. Where every option begins at a start state (Spec
D4), the end of an option is also that of its episode.
"""

from dataclasses import dataclass

import numpy as np

from hypogoal.core.arrays import Bools
from hypogoal.core.checkpoints import Resumable
from hypogoal.core.errors import UserError
from hypogoal.domains.base import Engine, Step
from hypogoal.options.choosers import Chooser, Outcome
from hypogoal.options.config import OptionConfig
from hypogoal.options.learner import Learner, Transitions
from hypogoal.options.parts import answer_of, learned_by
from hypogoal.options.recording import Recorder
from hypogoal.options.termination import Terminations
from hypogoal.options.visited import Visited

NONE = -1


def offered_options(predictions: Bools) -> Bools:
    """Spec D6: options whose sub-goal does not hold yet; all of them where none would be left. bool (n, O)."""
    offered = ~predictions
    offered[~offered.any(1)] = True
    return offered


@dataclass(eq=False, repr=False)
class OptionLoop(Resumable):
    """Steps every environment once per call of :meth:`step`.

    Episodes and choices are told to ``recorder``; ``config`` has timeouts, masks and whether options begin at start
    states, a ``UserError`` where the engine cannot begin an episode when asked. ``gamma`` is the meta-level's discount
    per environment step (E1). ``visited`` is shown every state (B7).
    """

    CHANGING = (
        "engine",
        "terminations",
        "learner",
        "chooser",
        "recorder",
        "visited",
        "option",
        "began",
        "age",
        "inside",
        "returns",
    )

    engine: Engine
    terminations: Terminations
    learner: Learner
    chooser: Chooser
    recorder: Recorder
    config: OptionConfig
    gamma: float
    visited: Visited | None = None

    def __post_init__(self) -> None:
        if self.config.restart_options and not self.engine.restarts:
            raise UserError(
                "this domain's engine cannot begin an episode on request",
                "restart_options=true",
                "Give --set restart_options=false.",
            )
        count = self.engine.count
        self.option = np.full(count, NONE)
        self.began, self.age = np.zeros((2, count), int)  # states in which options were chosen; steps since
        self.inside = np.zeros(count, bool)  # the running option's own sub-goal held where it began
        self.returns = np.zeros(count)
        self.engine.reset()

    def step(self) -> dict[str, float]:
        """One step of every environment, then the updates that are due; returns numbers to log."""
        self.advance()
        return learned_by(self.learner) | learned_by(self.chooser)

    def advance(self, *, learning: bool = True) -> Transitions:
        """One step of every environment, before the updates that are due.

        Without ``learning`` the agent is frozen: options are greedy, and nothing is kept that could be learned from.
        """
        self._choose(learning)
        ids, option = self.engine.ids.copy(), self.option.copy()
        actions = self.learner.act(ids, option, self.age, explore=learning)
        step = self.engine.step(actions)
        log_odds = self.terminations.log_odds(step.next_ids, option)
        reached = self.terminations.reached(log_odds, option.copy(), self.age.copy())
        reached = answer_of(self.terminations, "reached", reached, bool, len(option))
        self.returns += self.gamma**self.age * step.rewards
        self.age += 1
        over = step.terminated | step.truncated
        timed_out = (self.age >= self.config.option_timeout) & ~reached & ~step.terminated  # see meta.training
        ended = reached | timed_out | over  # all that ends an option
        moved = Transitions(
            ids,
            actions,
            step.next_ids,
            step.rewards,
            option,
            step.terminated,
            reached,
            timed_out,
            ended,
        )
        if learning:
            self.learner.observe(moved)
        if self.config.restart_options:
            step = step._replace(truncated=step.truncated | (ended & ~step.terminated))
            self.engine.restart(ended & ~over)
        if self.visited:
            self.visited.see(step.next_ids)
        self.recorder.see(step)
        self._finish_options(step, moved, learning=learning)
        return moved

    def _choose(self, learning: bool) -> None:
        free = np.flatnonzero(self.option == NONE)
        count = len(free)
        if not count:
            return
        ids = self.engine.ids[free]
        offered = np.ones((count, self.terminations.options), bool)
        if self.config.mask_reached:
            offered = offered_options(self.terminations.of(ids))
        chosen = self.chooser.choose(free, ids, offered.copy())
        chosen = answer_of(self.chooser, "choose", chosen, int, count, self.terminations.options - 1)
        if learning and not offered[np.arange(count), chosen].all():
            raise UserError(
                f"choose gave options {chosen}, of which not all are offered",
                type(self.chooser).__name__,
                "Choose where 'offered' is true.",
            )
        self.option[free], self.began[free] = chosen, ids
        self.inside[free] = self.terminations.of_running(ids, chosen)
        self.age[free] = 0
        self.returns[free] = 0.0
        self.recorder.chose(chosen, offered)

    def _finish_options(self, step: Step, moved: Transitions, *, learning: bool) -> None:
        done = np.flatnonzero(moved.ended)
        if not len(done):
            return
        every = Outcome(
            environments=np.arange(self.engine.count),
            options=self.option,
            began=self.began,
            reached=moved.reached,
            inside=self.inside,
            returns=self.returns,
            durations=self.age,
            discounts=np.power(self.gamma, self.age, dtype=float),
            next_ids=step.next_ids,
            terminated=step.terminated,
            truncated=step.truncated,
        )
        outcome = every.at(done)
        if learning:
            self.terminations.finished(done, outcome.options, outcome.reached)
        self.recorder.finished(outcome)
        self.chooser.record(outcome)
        self.option[done] = NONE
