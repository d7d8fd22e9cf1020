"""The base of all learners of intra-option policies: they act, explore, count steps, and are kept in artefacts."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor

from hypogoal.core.arrays import Bools, Columns, Doubles, Floats, Ints
from hypogoal.core.config import Values
from hypogoal.core.errors import UserError
from hypogoal.core.own_code import load_class
from hypogoal.core.seeding import rng_for
from hypogoal.domains.base import Engine
from hypogoal.options import double_dqn, saved
from hypogoal.options.config import LearnerConfig, OptionConfig
from hypogoal.options.exploration import Exploration
from hypogoal.options.parts import Part, answer_of, saved_row
from hypogoal.options.termination import ORACLE, Terminations

LEARNERS = {
    "light": "hypogoal.options.light:LightLearner",
    "paper": "hypogoal.options.conv_gru:PaperLearner",
    "planned": "hypogoal.options.planned:PlannedLearner",
}


@dataclass(frozen=True)
class Transitions(Columns):
    """One step of every environment, as arrays (E,), from which intra-option policies learn."""

    ids: Ints
    actions: Ints
    next_ids: Ints
    rewards: Floats
    options: Ints  # the options that were running
    terminated: Bools  # whether the task is over
    reached: Bools  # whether the option reached its sub-goal
    timed_out: Bools  # whether the option's time was up, though neither its sub-goal nor the episode's end was reached
    ended: Bools  # whether the option stopped here, for whatever reason


class Learner(Part, ABC):
    """The intra-option policies of all O options, and how they are learned.

    Attributes:
        config: how options are executed.
        settings: how the policies learn, which is the part ``config.learner``.
        option_steps: int64 (O,), the number of steps from which each option's policy learned.
        positives: int64 (O,), the number of steps among ``option_steps`` at whose end the option's sub-goal was
            reached.
        steps_since_positive: int64 (O,), the number of steps since the first step at whose end the sub-goal was
            reached. If this run continues another run, the steps of that run are included.

    Raises:
        UserError: if settings do not go together, or if the replay is longer than the engine's memory of states.
    """

    KEPT = ("option_steps", "steps_since_positive")  # what artefacts keep beside the weights
    CHANGING: ClassVar[tuple[str, ...]] = ("exploration", "rng", "positives", *KEPT)

    def __init__(
        self,
        engine: Engine,
        terminations: Terminations,
        config: OptionConfig,
        seed: int,
        device: torch.device | str = "cpu",
    ):
        self.refuse(config, engine)
        self.engine, self.terminations, self.config = engine, terminations, config
        self.settings = config.learner
        self.options, self.device = terminations.options, torch.device(device)
        self.rng = rng_for(seed, "options")
        if config.learner:
            self.exploration = Exploration(config.learner, engine.count, engine.n_actions, self.rng)
        self.option_steps, self.positives, self.steps_since_positive = np.zeros((3, self.options), int)
        self.build(config, seed)
        reach = self.reach(config, self.options)
        if engine.memory is not None and reach > engine.memory:
            replay = config.part(LearnerConfig).replay
            raise UserError(
                f"the replay reaches back {reach} states, the engine remembers {engine.memory}",
                f"replay={replay}",
                f"Give --set replay={max(100, replay - (reach - engine.memory))} or less.",
            )

    @classmethod
    def policies(cls, options: saved.SavedOptions) -> saved.Policies:
        """Return the greedy policies of an artefact's options. Raises ``UserError`` if the policies need an engine."""
        raise UserError(
            "these options need their domain's engine, which is not in the artefact",
            f"network={options.config['network']}",
            "Load options of the light or the paper's network.",
        )

    @abstractmethod
    def build(self, config: OptionConfig, seed: int) -> None:
        """Build the policies. This is called once all other attributes are set."""

    @staticmethod
    @abstractmethod
    def reach(config: OptionConfig, options: int) -> int:
        """Return how many states back the learner looks."""

    @abstractmethod
    def greedy(self, ids: Ints, options: Ints, age: Ints) -> Ints:
        """Return the action that each running option's policy prefers, int64 (E,).

        The arguments are those of :meth:`act`.
        """

    @abstractmethod
    def observe(self, moved: Transitions) -> None:
        """Store one step of every environment."""

    def learn(self) -> dict[str, float]:
        """Make as many updates as are due. Return the numbers of the last update.

        The result is an empty dictionary if no update was due. By default there are no updates.
        """
        return {}

    def weights(self) -> dict[str, Tensor]:
        """Return the weights of all policies, by name. By default there are none."""
        return {}

    def load_weights(self, weights: Mapping[str, Tensor]) -> None:
        """Load the weights that :meth:`weights` returns, from the tensors of an artefact."""

    def epsilon(self) -> Doubles:
        """Return every option's probability of exploration, float64 (O,)."""
        settings = self.config.part(LearnerConfig)
        steps = self.steps_since_positive if settings.epsilon_from == "first-positive" else self.option_steps
        return double_dqn.linear_epsilon(steps, settings.epsilon_steps, settings.epsilon_final)

    def health(self, last: double_dqn.Updated, replay: int) -> dict[str, float]:
        """Return numbers to log of the last update, and of a replay with ``replay`` transitions."""
        return {
            "option_loss": last.loss,
            "option_q": last.q,
            "option_td_error": float(last.errors.mean()),
            "exploration_rate": float(self.epsilon().mean()),
            "replay_size": replay,
        }

    def act(self, ids: Ints, options: Ints, age: Ints, *, explore: bool = True) -> Ints:
        """Return the actions, int64 (E,), of the running ``options`` (E,) in states ``ids`` (E,).

        ``age`` (E,) is the number of steps since each option began. Without ``explore``, the actions are greedy.
        """
        chosen = self.greedy(ids, options.copy(), age.copy())
        chosen = answer_of(self, "greedy", chosen, int, len(ids), self.engine.n_actions - 1)
        if explore and self.settings:
            chosen = self.exploration.mix(chosen, self.epsilon()[options], age)
        return chosen

    def count_running(self, moved: Transitions) -> None:
        """Count a step for each running option, and the steps after which the option's own member says yes."""
        reached = self.terminations.of_running(moved.next_ids, moved.options)
        np.add.at(self.positives, moved.options[reached], 1)
        self.count(moved.options)

    def count(self, options: Ints) -> None:
        """Count one step of learning for each of ``options`` (n,).

        Call this after ``positives`` has been updated.
        """
        np.add.at(self.option_steps, options, 1)
        reached = (self.positives > 0) | (self.steps_since_positive > 0)
        np.add.at(self.steps_since_positive, options, reached[options])

    def state(self) -> dict[str, Tensor]:
        """Return the weights and the exploration counters that an artefact keeps, by name."""
        counters = {name: torch.from_numpy(getattr(self, name).copy()) for name in self.KEPT}
        return self.weights() | counters

    def load(self, state: Mapping[str, Tensor]) -> None:
        """Load the weights and counters of an artefact, to go on learning. Replays start empty.

        Raises ``UserError`` if the weights or counters do not fit.
        """
        self.load_weights(state)
        for name in self.KEPT:
            setattr(self, name, saved_row(state, name, self.options))


def load_learner(name: str) -> type[Learner]:
    """Return the class that the setting ``network`` names. Raises ``UserError`` if there is no such class."""
    return load_class(name, "option learner", Learner, LEARNERS)  # type: ignore[type-abstract]


def make_policies(config: Values, weights: Mapping[str, Tensor], ensemble_config: Values) -> saved.Policies:
    """Return the greedy policies of an options artefact.

    ``config`` and ``weights`` are those of the artefact. ``ensemble_config`` is the configuration of its ensembles.
    Raises ``UserError`` if the options end at true sub-goals, or if the policies need an engine.
    """
    if config["termination"] == ORACLE:
        raise UserError(
            "these options end at the true sub-goals, which only the domain's engine can see",
            "termination=oracle",
            "Load options that were trained with learned members.",
        )
    shape = tuple(ensemble_config["observation_shape"])
    return load_learner(config["network"]).policies(saved.SavedOptions(config, weights, shape))
