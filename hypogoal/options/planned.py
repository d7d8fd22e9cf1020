"""Options that are planned and not learned: the shortest way to where each member is positive, exactly.

Where an engine knows what follows on each action, what an option does is a matter of its sub-goal alone. So an agent
whose options are planned shows what its hypotheses are worth, whatever option learning makes of them.
"""

import numpy as np
from numpy.typing import NDArray

from hypogoal.core.arrays import Bools, Ints
from hypogoal.core.errors import UserError
from hypogoal.domains.base import Engine, Plan
from hypogoal.options.config import OptionConfig
from hypogoal.options.learner import Learner, Transitions
from hypogoal.options.termination import TerminationRule, Terminations

FAR = np.iinfo(np.int32).max // 2  # steps to where nothing leads


class PlannedLearner(Learner):
    """Every option goes the shortest way to its own sub-goal; of equally short ones it takes the first action.

    Arguments as of :class:`Learner`. Where no way leads to its sub-goal it plays the first action.

    Attributes:
        actions: the engine's actions that the plan knows, int64 (A,).
        steps: int32 (N, O), how many steps each option's sub-goal is away from each state of the plan.

    Raises:
        UserError: nobody knows what follows in this engine.
    """

    CHANGING = ("rng", "positives", *Learner.KEPT)  # it does not explore

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
        """Only counted."""
        reached = self.terminations.of_running(moved.next_ids, moved.options)
        np.add.at(self.positives, moved.options[reached], 1)
        self.count(moved.options)


def plan_of(
    engine: Engine,
    terminations: Terminations,
    config: OptionConfig,
    starts: Ints | None = None,
) -> Plan:
    """The engine's plan, from these states or where episodes begin; a ``UserError`` where options cannot be planned."""
    if type(terminations.rule) is not TerminationRule:
        fault = "only options that end at a single positive prediction can be planned"
        raise UserError(fault, f"termination={config.termination}", "Give termination=learned.")
    plan = engine.plan(starts)
    if plan is None:
        fault = "this domain does not know what each action leads to"
        raise UserError(fault, f"network={config.network}", "Give --set network=light.")
    return plan


def places_of(plan: Plan, engine: Engine) -> Ints:
    """Where in a plan each of the engine's states is, int64 (n_states,); -1 of those that are not in it."""
    places = np.full(engine.n_states, -1, int)
    places[plan.ids] = np.arange(len(plan.ids))
    return places


def distances(reached: Bools, after: Ints, final: Bools) -> NDArray[np.int32]:
    """Breadth-first search from all sub-goals at once, against the direction of time: steps to them, int32 (N, O).

    0 where an option's sub-goal is ``reached`` (N, O), ``FAR`` where no way leads there; states ``after`` each action
    are (N, A), and nothing follows a ``final`` one (N,).
    """
    steps = np.where(reached, 0, FAR).astype(np.int32)
    going = np.flatnonzero(~final)
    while True:
        ahead = steps[after[going]].min(axis=1) + 1
        nearer = np.minimum(steps[going], ahead)
        if (nearer >= steps[going]).all():
            return np.minimum(steps, FAR)
        steps[going] = nearer
