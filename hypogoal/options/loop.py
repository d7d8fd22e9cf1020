"""Options at work: many environments, each running one option at a time.

The loop knows nothing of how options are chosen or learned: it asks a chooser and a learner. It works in these steps:

- decision: a chooser takes one of the options offered.
- execution: that option at work, from the state in which it was chosen. It takes tau steps, at least one.
- outcome: what came of it: its first state, R (the rewards inside, discounted from its start), gamma ** tau, the state
  in which it ended. The policy over options learns from these alone.

An execution ends at the first of three things. They are not exclusive, and each is told to those that learn:

- ``reached``: the rule (:mod:`.termination`) says so of the state that it came to. For the option's policy that is a
  terminal state, with a reward of 1. For the policy over options it is a state like any other: its value counts.
- ``timed_out``: it has taken ``option_timeout`` steps, and the episode goes on. The option's policy is rewarded 0.
  Time is not part of a state, so its target is the value of that state, as if it went on; a return over several steps
  ends there, too. The policy over options takes R + gamma ** tau V(s'), and its trace runs on into the next decision,
  which is made in the same state: the same option may be chosen again.
- the episode ends. ``terminated``: the task is over, so the values of what follows are 0 for both policies.
  ``truncated``: the episode is cut, at its ``max_episode_steps`` or at its cap. That is no terminal state, so the
  value of the state counts for both policies, but the trace of the policy over options ends.

With ``restart_options`` the end of an execution is that of its episode, too: the episode counts as cut.
With ``experience=shared`` every member of a sub-goal learns from a step, each by its own prediction of the state.
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
    """Options whose sub-goal does not hold yet; all of them where none would be left. bool (n, O)."""
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
        self._reset()

    def begin_anew(self, chooser: Chooser) -> None:
        """Begin an episode in every environment, with this chooser; of earlier episodes and options nothing is left."""
        chooser.begin_anew()
        self.chooser, self.recorder = chooser, Recorder(self.recorder.options, self.engine)
        self.option[:] = NONE
        self._reset()

    def _reset(self) -> None:
        self.engine.reset()
        self.terminations.rule.begin_episodes(np.arange(self.engine.count))

    def offered(self, ids: Ints) -> Bools:
        """Which options may begin in states (n,): bool (n, O)."""
        if not self.config.mask_reached:
            return np.ones((len(ids), self.terminations.options), bool)
        return offered_options(self.terminations.of(ids))

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
        reached = self.terminations.rule.reached(log_odds, option.copy(), self.age.copy())
        reached = answer_of(self.terminations.rule, "reached", reached, bool, len(option))
        self.returns += self.gamma**self.age * step.rewards
        self.age += 1
        over = step.terminated | step.truncated
        timed_out = (self.age >= self.config.option_timeout) & ~reached & ~step.terminated
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
