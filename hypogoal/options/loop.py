"""Options at work: many environments, each of which runs one option at a time.

The loop does not know how options are chosen or learned, because it asks a chooser and a learner. Its words are:

- decision: a chooser takes one of the options offered.
- execution: the option runs, from the state in which it was chosen. An execution takes tau steps, at least one.
- outcome: what came of the execution. The outcome has its first state, R (the rewards inside, discounted from the start
  of the execution), gamma ** tau, and the state in which the execution ended. The policy over options learns from
  outcomes alone.

An execution ends at the first of three events. Several of the events can happen at once, and each is told to the
policies that learn:

- ``reached``: the rule (:mod:`.termination`) says that the state reached ends the option. For the option's policy, that
  is a terminal state with a reward of 1. For the policy over options, it is a state like any other, so its value
  counts.
- ``timed_out``: the execution has taken ``option_timeout`` steps, and the episode goes on. The option's policy is
  rewarded 0. Time is not part of a state, so the target of learning is the value of the state, as if the execution went
  on. A return over several steps ends there, too. The policy over options takes R + gamma ** tau V(s'), and its trace
  runs on into the next decision. The next decision is made in that state, and may choose the same option again.
- the episode ends. If it is ``terminated``, the task is over, so the values of what follows are 0 for both policies. If
  it is ``truncated``, the episode is cut, at its ``max_episode_steps`` or at its cap. A cut is no terminal state, so
  the value of the state counts for both policies, but the trace of the policy over options ends. ``chooser=symbols``
  has no such value, and counts the execution as one that led back to where it began.

With ``restart_options``, the end of an execution is also the end of its episode, and the episode counts as cut. With
``experience=shared``, every member of every sub-goal learns from each step, by its own prediction of the state.
"""

from dataclasses import dataclass

import numpy as np

from hypogoal.core.arrays import Bools, Ints
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
    """Return which options are offered, bool (n, O): the options whose sub-goal does not hold yet.

    Where the sub-goals of all options hold, all options are offered.
    """
    offered = ~predictions
    offered[~offered.any(1)] = True
    return offered


@dataclass(eq=False, repr=False)
class OptionLoop(Resumable):
    """A loop that plays options in many environments, and steps every environment once per call of :meth:`step`.

    Attributes:
        engine: the environments.
        terminations: says where the options' sub-goals hold, and ends executions.
        learner: the policies of the options.
        chooser: the policy over options.
        recorder: is told of episodes and choices.
        config: timeouts, masks, and whether options begin at start states.
        gamma: the meta-level's discount per environment step.
        visited: is shown every state. None: nothing is kept.

    Raises:
        UserError: if ``config.restart_options`` is set, and the engine cannot begin an episode on request.
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
        self.began, self.age = np.zeros((2, count), int)  # the states in which options were chosen, and steps since
        self.inside = np.zeros(count, bool)  # whether the running option's sub-goal held in the state where it began
        self.returns = np.zeros(count)
        self._reset()

    def begin_anew(self, chooser: Chooser) -> None:
        """Begin an episode in every environment, with ``chooser``.

        Nothing of earlier episodes and executions is kept.
        """
        chooser.begin_anew()
        self.chooser, self.recorder = chooser, Recorder(self.recorder.options, self.engine)
        self.option[:] = NONE
        self._reset()

    def _reset(self) -> None:
        self.engine.reset()
        self.terminations.rule.begin_episodes(np.arange(self.engine.count))

    def offered(self, ids: Ints) -> Bools:
        """Return which options may begin in states ``ids`` (n,), bool (n, O)."""
        if not self.config.mask_reached:
            return np.ones((len(ids), self.terminations.options), bool)
        return offered_options(self.terminations.of(ids))

    def step(self) -> dict[str, float]:
        """Step every environment once, and then make the updates that are due. Return numbers to log."""
        self.advance()
        return learned_by(self.learner) | learned_by(self.chooser)

    def advance(self, *, learning: bool = True) -> Transitions:
        """Step every environment once, without the updates that are due, and return the step as :class:`Transitions`.

        Without ``learning`` the agent is frozen: options are greedy, and nothing is kept from which the agent could
        learn.
        """
        self._choose(learning)
        ids, option = self.engine.ids.copy(), self.option.copy()
        actions = self.learner.act(ids, option, self.age, explore=learning)
        step = self.engine.step(actions)
        log_odds = self.terminations.log_odds(step.next_ids, option)
        reached = self.terminations.rule.reached(log_odds, option.copy(), self.age.copy())
        reached = answer_of(self.terminations.rule, "reached", reached, bool, len(option))
        self.returns += self.gamma**self.age * step.rewards
        self.age += 1
        over = step.terminated | step.truncated
        timed_out = (self.age >= self.config.option_timeout) & ~reached & ~over
        ended = reached | timed_out | over  # each of the three events ends an execution
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
        self.terminations.rule.begin_episodes(np.flatnonzero(step.terminated | step.truncated))
        return moved

    def _choose(self, learning: bool) -> None:
        free = np.flatnonzero(self.option == NONE)
        count = len(free)
        if not count:
            return
        ids = self.engine.ids[free]
        offered = self.offered(ids)
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
            self.terminations.rule.finished(done, outcome.options, outcome.reached)
        self.recorder.finished(outcome)
        self.chooser.record(outcome)
        self.option[done] = NONE
