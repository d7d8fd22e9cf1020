"""A chooser, a learner and a termination rule of one's own: one class each, and no other file."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import refuses, run, settings
from numpy.typing import NDArray
from torch import Tensor

from hypogoal.core.artefacts import open_artefact
from hypogoal.core.errors import UserError
from hypogoal.domains.base import Engine
from hypogoal.meta.episodes import agent_of, play_episode
from hypogoal.options.choosers import Chooser, Offered
from hypogoal.options.learner import Learner, Transitions
from hypogoal.options.parts import Ids
from hypogoal.options.tables import Choices
from hypogoal.options.termination import Terminations

FEW = [*settings("steps=300", "environments=4", "random_episodes=5"), "-q"]


class FirstOffered(Chooser):
    """It takes the first option offered."""

    def choose(self, environments: Ids, ids: Ids, offered: Offered) -> Ids:
        return offered.argmax(1)


class Straight(Learner):
    """Every option plays its number modulo the actions; it counts the steps and learns nothing."""

    @classmethod
    def refuse(cls, config: Any, engine: Engine) -> None:
        super().refuse(config, engine)
        if config.experience != "shared":
            raise UserError("straight options have no experience", f"experience={config.experience}", "Leave it out.")

    def build(self, config: Any, seed: int) -> None:
        self.preferred = np.arange(self.options) % self.engine.n_actions

    @staticmethod
    def reach(config: Any, options: int) -> int:
        return 0

    def greedy(self, ids: Ids, options: Ids, age: Ids) -> Ids:
        return self.preferred[options]

    def observe(self, moved: Transitions) -> None:
        self.count(moved.options)

    def learn(self) -> dict[str, float]:
        return {}

    def weights(self) -> dict[str, Tensor]:
        return {}

    def load_weights(self, weights: Mapping[str, Tensor]) -> None:
        pass


class AtLeast(Terminations):
    """No execution reaches its sub-goal in its first ``length`` steps."""

    NUMBERED = True

    def reached(self, ids: NDArray[np.int64], options: NDArray[np.int64], age: NDArray[np.int64]) -> NDArray[np.bool_]:
        return self.of_running(ids, options) & (age >= self.length)


def train(stage: str, source: Path, out: Path, *pairs: str) -> dict[str, Any]:
    """The configuration of what a stage makes with these settings."""
    run(stage, source / "ensemble", "--out", out, *FEW, *settings(*pairs))
    return open_artefact(out).config


OWN = {"chooser": "FirstOffered", "network": "Straight", "termination": "AtLeast:3"}


@pytest.mark.parametrize("stage", ["train-options", "train-meta"])
@pytest.mark.parametrize("setting", OWN)
def test_one_file_is_enough(setting: str, stage: str, corridor_run: Path, tmp_path: Path) -> None:
    """Spec A3, A4, G2: the setting names the class; what is trained is played again where the user allows it."""
    name = f"{__name__}:{OWN[setting]}"
    assert train(stage, corridor_run, tmp_path / "made", f"{setting}={name}")[setting] == name
    if setting == "chooser":
        choices = Choices.read(tmp_path / "made" / "choices.csv")
        np.testing.assert_array_equal(choices.total("chosen", 1)[0], choices.total("offered", 1)[0])
    if stage == "train-meta":
        assert len(play_episode(agent_of(open_artefact(tmp_path / "made"), seed=0), 2)) > 1


@pytest.mark.parametrize(
    ("pairs", "fault"),
    [
        (["network={}:Straight", "experience=own"], "straight options have no experience: experience=own"),
        (["chooser={}:Straight"], "this is no chooser"),
        (["chooser={}:Missing"], "the chooser cannot be loaded"),
        (["termination={}:AtLeast"], "unknown termination"),
    ],
)
def test_what_does_not_fit_is_one_line(pairs: list[str], fault: str, corridor_run: Path, tmp_path: Path) -> None:
    """Spec G2."""
    own = settings(*(pair.format(__name__) for pair in pairs))
    refuses(fault, "train-options", corridor_run / "ensemble", "--out", tmp_path / "out", *FEW, *own)


@pytest.mark.parametrize(("pair", "without"), [("entropy=0.1", "chooser=random"), ("replay=500", "network=planned")])
def test_settings_that_do_nothing_are_refused(pair: str, without: str, corridor_run: Path, tmp_path: Path) -> None:
    """Spec G2: where they were given; those of a preset, or of an experiment for all its cells, pass."""
    command = ["train-meta", corridor_run / "ensemble", "--out", tmp_path / "out", *FEW]
    refuses(
        f"has this setting only beside another choice: {pair.partition('=')[0]}", *command, *settings(pair, without)
    )
    preset = tmp_path / "all.toml"
    preset.write_text("[train-meta]\nentropy = 0.1\n")
    run(*command, "--preset", preset, "--set", "chooser=random")


@pytest.mark.parametrize("name", ["train-options", "train-meta"])
def test_what_is_complete_is_not_built_again(
    name: str, corridor_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Spec A6, G1: ``--resume`` looks at the manifest, and makes neither engine nor networks."""
    command = [name, corridor_run / "ensemble", "--out", tmp_path / "out", *FEW]
    run(*command)
    monkeypatch.setattr("hypogoal.meta.training.assemble", None)
    run(*command, "--resume")
