"""Choosers, which are policies over options. The choosers in this module do not learn.

They are the choosers of ``train-options`` and of the lower control.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Self

import numpy as np

from hypogoal.core.arrays import Bools, Columns, Doubles, Ints
from hypogoal.core.own_code import load_class
from hypogoal.core.seeding import rng_for
from hypogoal.options.parts import Part

if TYPE_CHECKING:
    from torch import Tensor

    from hypogoal.domains.base import Engine
    from hypogoal.options.config import OptionConfig

CHOOSERS = {
    "random": f"{__name__}:RandomChooser",
    "even": f"{__name__}:EvenChooser",
    "ppo": "hypogoal.meta.ppo:MetaPolicy",
    "symbols": "hypogoal.meta.symbols:SymbolsChooser",
}

Offered = Bools  # (n, O), whether each option may be chosen
FILE = "meta.safetensors"  # the file with a chooser's :meth:`Chooser.state` in an artefact


@dataclass(frozen=True)
class Outcome(Columns):
    """Finished executions of options, as arrays of length n."""

    environments: Ints  # the environments in which the options ran
    options: Ints  # the options that ran
    began: Ints  # the states in which the options were chosen
    reached: Bools  # whether the option's own classifier ended the execution
    inside: Bools  # whether that classifier was positive already where the execution began
    returns: Doubles  # the environment's rewards during the execution, discounted from its start
    durations: Ints  # tau, the number of steps
    discounts: Doubles  # gamma ** tau, the discount of the state reached
    next_ids: Ints  # the states reached
    terminated: Bools  # whether the task is over, so that nothing follows
    truncated: Bools  # whether the episode was cut, at its limit or because the next option begins at a start state


class Chooser(Part, ABC):
    """A policy over options."""

    @classmethod
    def create(cls, engine: Engine, options: int, config: OptionConfig, seed: int, device: str) -> Self:
        """Return a new chooser for ``options`` options.

        ``seed`` is the seed of the chooser's weights and of its random choices.
        """
        return cls()

    @staticmethod
    def reach(config: OptionConfig) -> int:
        """Return how many states back the chooser looks. By default it looks at no earlier states."""
        return 0

    @abstractmethod
    def choose(self, environments: Ints, ids: Ints, offered: Offered) -> Ints:
        """Choose an option for each of n environments, int64 (n,).

        ``environments`` are the numbers of the environments, and ``ids`` are their states. Only options may be chosen
        for which ``offered``, bool (n, O), is true. For ``symbols``, ``offered`` is also what it knows of the state.
        """

    def record(self, outcome: Outcome) -> None:
        """Learn that the chosen options ended as ``outcome`` says. By default nothing is remembered."""

    def begin_anew(self) -> None:
        """Forget the episodes that were broken off, because all environments are now at the beginning of an episode."""

    def learn(self) -> dict[str, float]:
        """Make the updates that are due. Return numbers to log, an empty dictionary if no update was due."""
        return {}

    def state(self) -> dict[str, Tensor]:
        """Return the weights that an artefact keeps, by name."""
        return {}

    def load(self, state: Mapping[str, Tensor]) -> None:
        """Load the weights of an artefact. By default there are none."""

    def carry(self, state: Mapping[str, Tensor]) -> None:
        """Load the weights of an artefact to go on learning elsewhere. By default all weights are loaded."""
        self.load(state)


class RandomChooser(Chooser):
    """A chooser that draws uniformly among the options offered, as in ``train-options`` and in the lower control."""

    CHANGING = ("rng",)

    def __init__(self, rng: np.random.Generator):
        self.rng = rng

    @classmethod
    def create(cls, engine: Engine, options: int, config: OptionConfig, seed: int, device: str) -> Self:
        return cls(rng_for(seed, "random-choice"))

    def choose(self, environments: Ints, ids: Ints, offered: Offered) -> Ints:
        return np.where(offered, self.rng.random(offered.shape), -1.0).argmax(1)


class EvenChooser(Chooser):
    """A chooser that takes the offered option with the fewest steps so far, and breaks ties by ``rng``.

    A uniform choice would give most steps to the options that never reach their sub-goal, because their executions are
    the longest.
    """

    CHANGING = ("rng", "steps")

    def __init__(self, rng: np.random.Generator, options: int):
        self.rng = rng
        self.steps = np.zeros(options, int)  # the number of steps of each option so far

    @classmethod
    def create(cls, engine: Engine, options: int, config: OptionConfig, seed: int, device: str) -> Self:
        return cls(rng_for(seed, "random-choice"), options)

    def choose(self, environments: Ints, ids: Ints, offered: Offered) -> Ints:
        """Choose for each environment in turn, int64 (n,). An option that begins to run counts as one step more."""
        chosen = np.empty(len(environments), int)
        for row in range(len(environments)):
            tied = self.steps + self.rng.random(len(self.steps))
            chosen[row] = np.where(offered[row], tied, np.inf).argmin()
            self.steps[chosen[row]] += 1
        return chosen

    def record(self, outcome: Outcome) -> None:
        """Count the steps that the options took."""
        np.add.at(self.steps, outcome.options, outcome.durations - 1)


def load_chooser(name: str) -> type[Chooser]:
    """Return the class that the setting ``chooser`` names. Raises ``UserError`` if there is no such class."""
    return load_class(name, "chooser", Chooser, CHOOSERS)  # type: ignore[type-abstract]
