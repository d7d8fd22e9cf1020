"""Options at work on an engine, put together in a line; a learner and a chooser that do what they are told."""

from typing import Any

import numpy as np

from hypogoal.domains.base import Engine
from hypogoal.options.choosers import Outcome, RandomChooser
from hypogoal.options.config import OptionConfig
from hypogoal.options.learner import load_learner
from hypogoal.options.loop import OptionLoop
from hypogoal.options.recording import Recorder
from hypogoal.options.termination import Terminations, oracle_terminations

# Learning that takes a thousand steps where a stage has a hundred thousand.
QUICK = {"environments": 4, "warm_up": 50, "update_interval": 4, "option_batch": 32, "epsilon_steps": 300}
BEGIN = {"restart_options": True, "mask_reached": False, "experience": "own"}


def loop_of(
    engine: Engine,
    learner: Any = None,
    chooser: Any = None,
    ends: Terminations | None = None,
    *,
    options: int = 2,
    gamma: float = 1.0,
    seed: int = 0,
    config: Any = None,
    **settings: Any,
) -> OptionLoop:
    """A loop with these settings, or this ``config``: true sub-goals, the network's own learner, random choice.

    ``learner`` is an object, or a class that is made with ``seed``.
    """
    config = config or OptionConfig.of(**settings)
    ends = ends or oracle_terminations(engine, range(options))
    learner = learner or load_learner(config.network)
    if isinstance(learner, type):
        learner = learner(engine, ends, config, seed)
    chooser = chooser or RandomChooser(np.random.default_rng(seed))
    return OptionLoop(engine, ends, learner, chooser, Recorder(ends.options, engine), config, gamma)


def played(loop: OptionLoop, steps: int) -> OptionLoop:
    """The same loop after so many more of its steps."""
    for _ in range(steps):
        loop.step()
    return loop


class Scripted:
    """A learner whose options play a list of actions, the last one for ever; it notes what it is told."""

    def __init__(self, *actions: int):
        self.actions = [*actions]
        self.seen: list[Any] = []

    def act(self, ids: Any, options: Any, age: Any, *, explore: bool = True) -> Any:
        action = self.actions.pop(0) if len(self.actions) > 1 else self.actions[0]
        return np.full(len(ids), action)

    def observe(self, moved: Any) -> None:
        self.seen.append(moved)

    def learn(self) -> dict[str, float]:
        return {}


class Chosen:
    """A chooser that takes the options of a list, then the first one offered; it notes what came of them."""

    def __init__(self, *options: int):
        self.options = [*options]
        self.began: list[int] = []
        self.offered: list[np.ndarray] = []
        self.outcomes: list[Outcome] = []

    def choose(self, environments: Any, ids: Any, offered: Any) -> Any:
        self.began.extend(ids.tolist())
        self.offered.append(offered.copy())
        if self.options:
            return np.array([self.options.pop(0) for _ in ids])
        return offered.argmax(1)

    def record(self, outcome: Outcome) -> None:
        self.outcomes.append(outcome)

    def begin_anew(self) -> None:
        pass

    def learn(self) -> dict[str, float]:
        return {}
