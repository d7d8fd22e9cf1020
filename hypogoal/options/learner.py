"""What all learners of intra-option policies do: act, explore, count, and keep it in artefacts."""

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
    """One step of every environment, arrays (E,): what intra-option policies learn from."""

    ids: Ints
    actions: Ints
    next_ids: Ints
    rewards: Floats
    options: Ints  # that were running
    terminated: Bools  # the task is over
    reached: Bools  # the option reached its sub-goal
    timed_out: Bools  # its time was up without that
    ended: Bools  # it stopped here for whatever reason


class Learner(Part, ABC):
    """The intra-option policies of all O options.

    Attributes:
        config: how options are executed.
        settings: how these policies learn, the part ``config.learner``.
        option_steps: int64 (O,), the steps that each learned from.
        positives: int64 (O,), those of them at whose end its sub-goal was reached.
        steps_since_positive: int64 (O,), those since the first one of these, also in a run that this one continues.

    Raises:
        UserError: settings that do not go together, or a replay longer than the engine's memory of states.
    """

    KEPT = ("option_steps", "steps_since_positive")  # in artefacts, beside the weights
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
        """Greedy policies of an artefact; where they need an engine it is a ``UserError``."""
        raise UserError(
            "these options need their domain's engine, which is not in the artefact",
            f"network={options.config['network']}",
            "Load options of the light or the paper's network.",
        )

    @abstractmethod
    def build(self, config: OptionConfig, seed: int) -> None:
        """The policies, once all above is there."""

    @staticmethod
    @abstractmethod
    def reach(config: OptionConfig, options: int) -> int:
        """How many states back the learner looks."""

    @abstractmethod
    def greedy(self, ids: Ints, options: Ints, age: Ints) -> Ints:
        """Which action each option's policy prefers, int64 (E,); arguments as of :meth:`act`."""

    @abstractmethod
    def observe(self, moved: Transitions) -> None:
        """Store one step of every environment."""

    def learn(self) -> dict[str, float]:
        """As many updates as are due; returns the last one's numbers, empty when none was due, as by default."""
        return {}

    def weights(self) -> dict[str, Tensor]:
        """Of all policies, by name; by default there are none."""
        return {}

    def load_weights(self, weights: Mapping[str, Tensor]) -> None:
        """Those of :meth:`weights` among tensors of an artefact."""

    def epsilon(self) -> Doubles:
        """Every option's exploration, float (O,)."""
        settings = self.config.part(LearnerConfig)
        steps = self.steps_since_positive if settings.epsilon_from == "first-positive" else self.option_steps
        return double_dqn.linear_epsilon(steps, settings.epsilon_steps, settings.epsilon_final)

    def health(self, last: double_dqn.Updated, replay: int) -> dict[str, float]:
        """Numbers to log of the last update, and of a replay with so many transitions."""
        return {
            "option_loss": last.loss,
            "option_q": last.q,
            "option_td_error": float(last.errors.mean()),
            "exploration_rate": float(self.epsilon().mean()),
            "replay_size": replay,
        }

    def act(self, ids: Ints, options: Ints, age: Ints, *, explore: bool = True) -> Ints:
        """Actions int64 (E,) of the running options (E,) in states (E,), ``age`` (E,) steps after they began."""
        chosen = self.greedy(ids, options.copy(), age.copy())
        chosen = answer_of(self, "greedy", chosen, int, len(ids), self.engine.n_actions - 1)
        if explore and self.settings:
            chosen = self.exploration.mix(chosen, self.epsilon()[options], age)
        return chosen

    def count(self, options: Ints) -> None:
        """Steps of these options (n,) were learned from, after those that reached their sub-goals are counted."""
        np.add.at(self.option_steps, options, 1)
        reached = (self.positives > 0) | (self.steps_since_positive > 0)
        np.add.at(self.steps_since_positive, options, reached[options])

    def state(self) -> dict[str, Tensor]:
        """Weights and exploration counters, for an artefact."""
        counters = {name: torch.from_numpy(getattr(self, name).copy()) for name in self.KEPT}
        return self.weights() | counters

    def load(self, state: Mapping[str, Tensor]) -> None:
        """Continue from the weights and counters of an artefact; replays start empty. What does not fit is a
        ``UserError``.
        """
        self.load_weights(state)
        for name in self.KEPT:
            setattr(self, name, saved_row(state, name, self.options))


def load_learner(name: str) -> type[Learner]:
    """The class that the setting ``network`` names; a ``UserError`` where it names none."""
    return load_class(name, "option learner", Learner, LEARNERS)  # type: ignore[type-abstract]


def make_policies(config: Values, weights: Mapping[str, Tensor], ensemble_config: Values) -> saved.Policies:
    """Greedy policies from an options artefact's configuration and weights and its ensembles' configuration."""
    if config["termination"] == ORACLE:
        raise UserError(
            "these options end at the true sub-goals, which only the domain's engine can see",
            "termination=oracle",
            "Load options that were trained with learned members.",
        )
    shape = tuple(ensemble_config["observation_shape"])
    return load_learner(config["network"]).policies(saved.SavedOptions(config, weights, shape))
