"""The contracts of an agent's parts (:mod:`hypogoal.options.parts`): a part is made, played, resumed and kept."""

import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch

from hypogoal.check.domains import SEEDED, require_same
from hypogoal.check.verdict import Verdict, promise, verdicts
from hypogoal.core.arrays import Floats, Ints
from hypogoal.core.checkpoints import Checkpoints
from hypogoal.domains.base import Domain, Engine
from hypogoal.domains.find import load_domain
from hypogoal.meta.config import TrainMetaConfig
from hypogoal.meta.setup import Setup, assemble
from hypogoal.observations import PICTURE, standard_of
from hypogoal.options.loop import OptionLoop
from hypogoal.options.termination import Terminations, load_rule

STEPS = 60  # joint steps
SMALL = {"environments": 4, "max_episode_steps": 30, "option_timeout": 5, "warm_up": 40, "option_batch": 8}
SOURCE = {"sub_goals": ("one", "other"), "members": 2, "domain_config": {}}
PLAYED_AS = {  # where a loop has the part of a setting
    "chooser": attrgetter("chooser"),
    "network": attrgetter("learner"),
    "termination": attrgetter("terminations.rule"),
}


def check_part(setting: str, name: str, domain: Domain | None = None, seed: int = 0) -> Iterator[Verdict]:
    """Check whether a chooser, an option learner (``network``) or a termination rule, by its ``module:Class``, works.

    The part is played for some steps, in DoorKey by default, beside built-in parts. Four options aim at made-up
    sub-goals, each of which holds in a third of the states.
    """
    part = _PlayedPart(setting, name, domain or load_domain("doorkey"), seed)
    laws = [
        _PlayedPart.plays,
        _PlayedPart.again,
        _PlayedPart.resumes,
        _PlayedPart.is_kept,
    ]
    return verdicts(laws, part)


@dataclass
class _PlayedPart:
    """A part by its setting and name, and where it is played."""

    setting: str
    name: str
    domain: Domain
    seed: int

    def plays(self) -> str:
        """The part's answers have the shapes, types and ranges that are asked for, at every step."""
        recorder = self.played().recorder
        if self.setting == "termination" and not any(recorder.stops):
            warnings.warn(f"no option reached its sub-goal in {recorder.steps} steps", stacklevel=1)
        return f"{recorder.steps} steps"

    def again(self) -> None:
        """The same seed plays the same."""
        first, second = self.loop(), self.loop()
        require_same(_play(first), _play(second), SEEDED)

    def resumes(self) -> str | None:
        """From a checkpoint, play goes on as if there had been no break."""
        loop, resumed = self.played(), self.loop()
        if not loop.engine.resumes:
            return "not looked at: this domain cannot be resumed"
        with TemporaryDirectory() as folder:
            checkpoints = Checkpoints(Path(folder, "state"))
            checkpoints.save(loop.snapshot())
            saved = checkpoints.load()
        promise(saved is not None, "no checkpoint could be kept", "Keep finite numbers in what CHANGING names.")
        assert saved is not None
        resumed.restore(saved)
        require_same(_play(loop), _play(resumed), "Name in CHANGING all that changes.")
        return None

    def is_kept(self) -> str:
        """A fresh part loads what an artefact keeps of the part."""
        part = self.part(self.played())
        kept = {name: torch.as_tensor(values) for name, values in part.state().items()}
        fresh = self.part(self.loop())
        fresh.load(kept)
        for name, values in fresh.state().items():
            is_same = torch.equal(torch.as_tensor(values), kept[name])
            promise(is_same, f"{name} is another one when loaded", "Give all in 'state' or 'weights', and load it.")
        return f"{len(kept)} arrays"

    def played(self) -> OptionLoop:
        """Return a loop with the part and other parts, after some steps."""
        loop = self.loop()
        for _ in _play(loop):
            pass
        return loop

    def part(self, loop: OptionLoop) -> Any:
        """Return the checked part of a loop."""
        return PLAYED_AS[self.setting](loop)

    def loop(self) -> OptionLoop:
        """Return a fresh loop with the part and other parts."""
        settings = SMALL | {"network": "light", "chooser": "random", self.setting: self.name}
        config = TrainMetaConfig.of(**settings)
        setup = Setup(self.domain, SOURCE, Path(), config, self.seed)
        return assemble(setup, _made_up)


def _made_up(setup: Setup, engine: Engine) -> Terminations:
    """Return terminations of sub-goals that depend on the state's number alone."""
    rule = load_rule(setup.config.termination)
    rule.refuse(setup.config, engine)
    if engine.observation_dtype != PICTURE:
        engine.standard = standard_of(engine.observation_shape)
    options = np.arange(1, 1 + setup.options)

    def log_odds(ids: Ints) -> Floats:
        waves = np.sin(ids[:, None] * options)
        return (8 * waves - 4).astype(np.float32)

    return Terminations(log_odds, rule(np.zeros(setup.options, np.float32), engine.count))


def _play(loop: OptionLoop) -> Iterator[dict[str, Any]]:
    """Yield what every step leads to."""
    for _ in range(STEPS):
        loop.step()
        yield {"options": loop.option.copy(), "states": loop.engine.ids.copy()}
