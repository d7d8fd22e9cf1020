"""Choosers, learners, termination rules, views and teachers as strangers write them: right ones, and one fault each."""

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hypogoal.core.errors import UserError
from hypogoal.hypotheses.views import View
from hypogoal.options.choosers import Chooser
from hypogoal.options.learner import Learner
from hypogoal.options.termination import TerminationRule

NOBODYS = np.random.default_rng(5)
Pictures = NDArray[np.uint8]


class First(Chooser):
    """The first option offered, as a list, which is as good as an array."""

    def choose(self, environments: Any, ids: Any, offered: Any) -> Any:
        return offered.argmax(1).tolist()


class Abstract(Chooser):
    """It does not choose."""


class Fractions(First):
    def choose(self, environments: Any, ids: Any, offered: Any) -> Any:
        return offered.argmax(1) + 0.4


class Last(First):
    """Whatever is offered."""

    def choose(self, environments: Any, ids: Any, offered: Any) -> Any:
        offered[:] = True  # a copy
        return np.full(len(ids), offered.shape[1] - 1)


class Beyond(First):
    def choose(self, environments: Any, ids: Any, offered: Any) -> Any:
        return np.full(len(ids), offered.shape[1])


class Forgetful(First):
    """It does not return the numbers of its updates."""

    def learn(self) -> Any:
        pass


class Moody(First):
    """It draws from nobody's seed."""

    def choose(self, environments: Any, ids: Any, offered: Any) -> Any:
        return np.where(offered, NOBODYS.random(offered.shape), -1.0).argmax(1)


class Turning(First):
    """It counts its choices, which a checkpoint does not know."""

    def __init__(self) -> None:
        self.count = 0

    def choose(self, environments: Any, ids: Any, offered: Any) -> Any:
        self.count += 1
        turned = (np.arange(offered.shape[1]) + self.count) % offered.shape[1]
        return np.where(offered, turned, -1).argmax(1)


class Unnamed(First):
    CHANGING = ("memory",)


class Straight(Learner):
    """Every option plays by its number and the sum of the pixels; it counts the steps and learns nothing."""

    @classmethod
    def policies(cls, saved: Any) -> Any:
        return lambda option: lambda picture: preferred(picture, option, 7)

    @classmethod
    def refuse(cls, config: Any, engine: Any) -> None:
        super().refuse(config, engine)
        if config.experience != "shared":
            raise UserError("straight options have no experience", f"experience={config.experience}", "Leave it out.")

    @staticmethod
    def reach(config: Any, options: int) -> int:
        return 0

    def build(self, config: Any, seed: int) -> None:
        self.table = torch.zeros(self.options)

    def greedy(self, ids: Any, options: Any, age: Any) -> Any:
        pairs = zip(self.engine.images(ids), options.tolist(), strict=True)
        return np.array([preferred(picture, option, self.engine.n_actions) for picture, option in pairs])

    def observe(self, moved: Any) -> None:
        self.count(moved.options)


def preferred(picture: Pictures, option: int, actions: int) -> int:
    return (int(picture.sum()) // 7 + option) % actions


class Unsaved(Straight):
    """What it learned is saved, and not loaded."""

    CHANGING = (*Straight.CHANGING, "table")

    def observe(self, moved: Any) -> None:
        super().observe(moved)
        self.table += 1

    def weights(self) -> dict[str, Tensor]:
        return {"table": self.table.clone()}


class Negative(Straight):
    def greedy(self, ids: Any, options: Any, age: Any) -> Any:
        return np.arange(len(ids)) - 1


class Twice(TerminationRule):
    """Two positive predictions in a row; a threshold falls with every execution."""

    CHANGING = (*TerminationRule.CHANGING, "row")

    def __init__(self, *arguments: Any, **more: Any):
        super().__init__(*arguments, **more)
        self.row = np.zeros(self.environments, dtype=np.int64)

    def reached(self, log_odds: Any, options: Any, age: Any) -> Any:
        self.row = np.where(self.positive(log_odds, options), self.row * (age > 0) + 1, 0)
        return self.row >= 2

    def finished(self, environments: Any, options: Any, reached: Any) -> None:
        self.thresholds = self.thresholds - np.float32(0.001)


class AtLeast(TerminationRule):
    """No execution reaches its sub-goal in its first two steps."""

    def reached(self, log_odds: Any, options: Any, age: Any) -> Any:
        return self.positive(log_odds, options) & (age >= 2)


class Never(TerminationRule):
    def reached(self, log_odds: Any, options: Any, age: Any) -> Any:
        return np.zeros(len(options), np.bool_)


class Counts(TerminationRule):
    def reached(self, log_odds: Any, options: Any, age: Any) -> Any:
        return (log_odds > 0).astype(np.int64)


class Whole(View):
    """All of a picture."""

    def __init__(self, observation_shape: tuple[int, ...], settings: object):
        super().__init__()
        self.shape = observation_shape


class Unready(View):
    def __init__(self, observation_shape: tuple[int, ...], settings: object):
        super().__init__()


class Few(View):
    def __init__(self, observation_shape: tuple[int, ...]):
        super().__init__()


class OneRow(Whole):
    def see(self, observations: Pictures) -> Any:
        return observations[:1]


class Blackened(Whole):
    def see(self, observations: Pictures) -> Any:
        observations[:] = 0
        return observations


class ByBatch(Whole):
    def see(self, observations: Pictures) -> Any:
        return np.where(observations > observations.mean(), 255, 0).astype(np.uint8)


class Mean(Whole):
    """What it learned is no buffer."""

    mean = 0

    def fit(self, labelled: Any, unlabelled: Any, origins: Any, seed: int) -> None:
        self.mean = int(labelled.mean())

    def see(self, observations: Pictures) -> Any:
        return np.maximum(observations, self.mean) - np.uint8(self.mean)


class Half(Whole):
    changes = True

    def change(self, batch: Any, rng: Any) -> Any:
        return batch[:, ::2] if rng else batch


class Bright(Whole):
    changes = True

    def change(self, batch: Any, rng: Any) -> Any:
        return batch.astype(np.float32) if rng else batch


class Always(Whole):
    """It changes what a trained member sees, too."""

    changes = True

    def change(self, batch: Any, rng: Any) -> Any:
        return 255 - batch


class AnyState(Whole):
    def pools(self, labels: Any, origins: Any) -> Any:
        return [np.arange(len(labels))], 0.5


class Share(Whole):
    def pools(self, labels: Any, origins: Any) -> Any:
        return [np.flatnonzero(labels)], 1


def shade(observations: Any, labels: Any, unlabelled: Any, members: int, seed: int) -> Any:
    """Each member is told to tell bright pictures, surer and surer."""
    brightness = unlabelled.mean((1, 2, 3))
    return np.arange(1, members + 1)[:, None] * (brightness - brightness.mean())


def turned(observations: Any, labels: Any, unlabelled: Any, members: int, seed: int) -> Any:
    return np.ones((len(unlabelled), members))


def words(observations: Any, labels: Any, unlabelled: Any, members: int, seed: int) -> Any:
    return [["yes"] * len(unlabelled)] * members


def blackens(observations: Any, labels: Any, unlabelled: Any, members: int, seed: int) -> Any:
    unlabelled[:] = 0
    return np.ones((members, len(unlabelled)))


def moody(observations: Any, labels: Any, unlabelled: Any, members: int, seed: int) -> Any:
    return NOBODYS.normal(size=(members, len(unlabelled)))
