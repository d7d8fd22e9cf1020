"""Options that are planned and not learned: they go the shortest way to where their member is positive, exactly.

If an engine knows what follows on each action, what an option does depends on its sub-goal alone. So an agent whose
options are planned shows what its hypotheses are worth, independently of how well options are learned.
"""

import numpy as np
from numpy.typing import NDArray

from hypogoal.core.arrays import Bools, Ints
from hypogoal.core.errors import UserError
from hypogoal.domains.base import Engine, Plan
from hypogoal.options.config import OptionConfig
from hypogoal.options.learner import Learner, Transitions
from hypogoal.options.termination import TerminationRule, Terminations

FAR = np.iinfo(np.int32).max // 2  # the number of steps to a place to which no way leads


class PlannedLearner(Learner):
    """A learner whose options go the shortest way to their sub-goals, and take the first of equally good actions.

    The arguments are those of :class:`Learner`. If no way leads to its sub-goal, an option plays the first action.

    Attributes:
        actions: int64 (A,), the engine's actions that the plan knows.
        steps: int32 (N, O), the number of steps from each state of the plan to each option's sub-goal.

    Raises:
        UserError: if the engine does not know what follows on each action.
    """

    CHANGING = ("rng", "positives", *Learner.KEPT)  # no exploration, because planned options do not explore

    def build(self, config: OptionConfig, seed: int) -> None:
        plan = plan_of(self.engine, self.terminations, config)
        self.actions = plan.actions
        self._place = places_of(plan, self.engine)
        self._after = self._place[plan.following]
        self.steps = distances(self.terminations.of(plan.ids), self._after, plan.final)

    @staticmethod
    def reach(config: OptionConfig, options: int) -> int:
        return 0

    def greedy(
        self,
        ids: Ints,
        options: Ints,
        age: Ints,
    ) -> Ints:
        ahead = self.steps[self._after[self._place[ids]], options[:, None]]
        nearest = ahead.argmin(axis=1)
        return self.actions[nearest]

    def observe(self, moved: Transitions) -> None:
        """Count the steps and the sub-goals reached, from which nothing else is learned."""
        self.count_running(moved)


def plan_of(
    engine: Engine,
    terminations: Terminations,
    config: OptionConfig,
    starts: Ints | None = None,
) -> Plan:
    """Return the engine's plan, from the states ``starts`` or from where episodes begin.

    Raises ``UserError`` if options cannot be planned.
    """
    if type(terminations.rule) is not TerminationRule:
        fault = "only options that end at a single positive prediction can be planned"
        raise UserError(fault, f"termination={config.termination}", "Give termination=learned.")
    plan = engine.plan(starts)
    if plan is None:
        fault = "this domain does not know what each action leads to"
        raise UserError(fault, f"network={config.network}", "Give --set network=light.")
    return plan


def places_of(plan: Plan, engine: Engine) -> Ints:
    """Return the index in the plan of each of the engine's states, int64 (n_states,).

    The index is -1 for states that are not in the plan.
    """
    places = np.full(engine.n_states, -1, int)
    places[plan.ids] = np.arange(len(plan.ids))
    return places


def distances(reached: Bools, after: Ints, final: Bools) -> NDArray[np.int32]:
    """Return the number of steps from each state to each option's sub-goal, int32 (N, O).

    The method is breadth-first search from all sub-goals at once, against the direction of time.

    Args:
        reached: bool (N, O), whether each option's sub-goal is reached. The number of steps is 0 there.
        after: int64 (N, A), the state after each action.
        final: bool (N,), whether nothing follows a state.

    Returns:
        The number of steps, or ``FAR`` where no way leads to the sub-goal.
    """
    steps = np.where(reached, 0, FAR).astype(np.int32)
    going = np.flatnonzero(~final)
    while True:
        ahead = steps[after[going]].min(axis=1) + 1
        nearer = np.minimum(steps[going], ahead)
        if (nearer >= steps[going]).all():
            return np.minimum(steps, FAR)
        steps[going] = nearer
