"""Who chooses options, and how ``train-options`` and the lower control do it, without learning which."""

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

Offered = Bools  # (n, O), the options that may be chosen
FILE = "meta.safetensors"  # of a chooser's :meth:`Chooser.state` in an artefact


@dataclass(frozen=True)
class Outcome(Columns):
    """Finished option executions, arrays of length n."""

    environments: Ints  # in which they ran
    options: Ints  # that they were of
    began: Ints  # the states in which these were chosen
    reached: Bools  # the options' own classifiers ended them
    inside: Bools  # these were positive already where they began
    returns: Doubles  # the environment's rewards inside the option, discounted from its start
    durations: Ints  # tau, the options' steps
    discounts: Doubles  # gamma ** tau, for the state reached
    next_ids: Ints  # the states reached
    terminated: Bools  # the task is over, nothing follows
    truncated: Bools  # the episode was cut, at its limit or because the next option begins at a start


class Chooser(Part, ABC):
    """A policy over options."""

    @classmethod
    def create(cls, engine: Engine, options: int, config: OptionConfig, seed: int, device: str) -> Self:
        """A fresh one that chooses among so many options; ``seed`` is of weights and draws."""
        return cls()

    @staticmethod
    def reach(config: OptionConfig) -> int:
        """How many states back the chooser looks; by default none."""
        return 0

    @abstractmethod
    def choose(self, environments: Ints, ids: Ints, offered: Offered) -> Ints:
        """For each of n environments in states ``ids`` one of the options offered, bool (n, O): int64 (n,)."""

    def record(self, outcome: Outcome) -> None:
        """The chosen options ended as ``outcome`` says; by default nothing is remembered."""

    def begin_anew(self) -> None:
        """Forget the episodes that were broken off: all environments are at the beginning of one."""

    def learn(self) -> dict[str, float]:
        """The updates that are due; returns numbers to log, empty when none was due."""
        return {}

    def state(self) -> dict[str, Tensor]:
        """Weights, for an artefact."""
        return {}

    def load(self, state: Mapping[str, Tensor]) -> None:
        """Weights of an artefact; by default there are none."""

    def carry(self, state: Mapping[str, Tensor]) -> None:
        """Go on learning, elsewhere, from weights of an artefact; by default from all of them."""
        self.load(state)


class RandomChooser(Chooser):
    """Uniform choice among the options offered, the lower control and the way of ``train-options``."""

    CHANGING = ("rng",)

    def __init__(self, rng: np.random.Generator):
        self.rng = rng

    @classmethod
    def create(cls, engine: Engine, options: int, config: OptionConfig, seed: int, device: str) -> Self:
        return cls(rng_for(seed, "random-choice"))

    def choose(self, environments: Ints, ids: Ints, offered: Offered) -> Ints:
        return np.where(offered, self.rng.random(offered.shape), -1.0).argmax(1)


class EvenChooser(Chooser):
    """The offered option that has had the fewest steps so far, ties broken by ``rng``.

    Uniform choice gives most steps to the options that never reach their sub-goal: their executions are the longest.
    """

    CHANGING = ("rng", "steps")

    def __init__(self, rng: np.random.Generator, options: int):
        self.rng = rng
        self.steps = np.zeros(options, int)  # of each option so far

    @classmethod
    def create(cls, engine: Engine, options: int, config: OptionConfig, seed: int, device: str) -> Self:
        return cls(rng_for(seed, "random-choice"), options)

    def choose(self, environments: Ints, ids: Ints, offered: Offered) -> Ints:
        """For each environment in turn, int64 (n,); an option that runs counts as one step more."""
        chosen = np.empty(len(environments), int)
        for row in range(len(environments)):
            tied = self.steps + self.rng.random(len(self.steps))
            chosen[row] = np.where(offered[row], tied, np.inf).argmin()
            self.steps[chosen[row]] += 1
        return chosen

    def record(self, outcome: Outcome) -> None:
        """The steps that the options took."""
        np.add.at(self.steps, outcome.options, outcome.durations - 1)


def load_chooser(name: str) -> type[Chooser]:
    """The class that the setting ``chooser`` names; a ``UserError`` where it names none."""
    return load_class(name, "chooser", Chooser, CHOOSERS)  # type: ignore[type-abstract]
