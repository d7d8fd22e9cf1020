"""A chooser, a learner and a termination rule of one's own: one class each, and no other file."""

import itertools
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from command_line import refuses, run, settings
from option_loops import loop_of

from hypogoal.core.artefacts import open_artefact
from hypogoal.domains.doorkey.engine import DoorKeyEngine
from hypogoal.hypotheses.ensemble import Ensemble
from hypogoal.meta.episodes import agent_of, play_episode
from hypogoal.options.choosers import load_chooser
from hypogoal.options.config import OptionConfig
from hypogoal.options.env import OptionEnv, Options
from hypogoal.options.learner import make_policies
from hypogoal.options.reward import SubgoalReward
from hypogoal.options.tables import ChoiceCounts
from hypogoal.options.termination import learned_terminations, saved_rule

FEW = [*settings("steps=300", "environments=4", "max_episode_steps=30"), "-q"]


def train(stage: str, source: Path, out: Path, *pairs: str) -> dict[str, Any]:
    """The configuration of what a stage makes with these settings."""
    run(stage, source / "ensemble", "--out", out, *FEW, *settings(*pairs))
    return open_artefact(out).config


OWN = {"chooser": "odd_parts:First", "network": "odd_parts:Straight", "termination": "odd_parts:AtLeast"}


@pytest.mark.parametrize("stage", ["train-options", "train-meta"])
def test_one_file_is_enough(stage: str, corridor_run: Path, tmp_path: Path) -> None:
    """Spec A3, A4, G2: the settings name the classes; what is trained is played again where the user allows it."""
    made = train(stage, corridor_run, tmp_path / "made", *(f"{setting}={name}" for setting, name in OWN.items()))
    assert {setting: made[setting] for setting in OWN} == OWN
    choices = ChoiceCounts.read(tmp_path / "made" / "choices.csv")
    np.testing.assert_array_equal(choices.total("chosen", 1)[0], choices.total("offered", 1)[0])
    if stage == "train-meta":
        assert len(play_episode(agent_of(open_artefact(tmp_path / "made"), seed=0), 2)) > 1


@pytest.mark.parametrize(
    ("pairs", "fault"),
    [
        (["network=odd_parts:Straight", "experience=own"], "straight options have no experience: experience=own"),
        (["chooser=odd_parts:Straight"], "this is no chooser"),
        (["chooser=odd_parts:Missing"], "the chooser cannot be loaded"),
        (["chooser=odd_parts:Beyond"], "choose gave 4 to 4: Beyond"),
        (["termination=odd_parts:Counts"], "reached gave int64 (4,): Counts"),
    ],
)
def test_what_does_not_fit_is_one_line(pairs: list[str], fault: str, corridor_run: Path, tmp_path: Path) -> None:
    """Spec G2."""
    words = [corridor_run / "ensemble", "--out", tmp_path / "out", *FEW, *settings(*pairs)]
    refuses(fault, "train-options", *words)


def ensembles_on(engine: DoorKeyEngine) -> list[Ensemble]:
    """Two of two members each, that are positive in a part of the states, surely."""
    pictures, ensembles = engine.images(engine.reachable()), []
    for number in range(2):
        generator = torch.Generator().manual_seed(number)
        ensemble = Ensemble("doorkey", engine.observation_shape, 2, generator).eval()
        chances = np.sort(ensemble.predict(pictures), axis=0)
        middle = chances[len(chances) // 4 : 3 * len(chances) // 4]
        widest = np.diff(middle, axis=0).argmax(0)
        ensemble.thresholds.copy_(
            torch.from_numpy(np.take_along_axis(middle, widest + np.array([[0], [1]]), 0).mean(0))
        )
        ensembles.append(ensemble)
    return ensembles


class Watched(gymnasium.Wrapper):  # type: ignore[type-arg]
    """It notes the actions that are played."""

    def __init__(self, env: gymnasium.Env[Any, Any], played: list[int]):
        super().__init__(env)
        self.played = played

    def step(self, action: int) -> Any:
        self.played.append(action)
        return self.env.step(action)


def door_key() -> gymnasium.Env[Any, Any]:
    return gymnasium.make("hypogoal.envs:hypogoal/DoorKey-8x8-v0", layout_seed=100)


@pytest.mark.filterwarnings("ignore:an episode begins where")
@pytest.mark.parametrize("rule", ["learned", "odd_parts:AtLeast", "odd_parts:Never"])
def test_other_loops_end_options_as_training_does(rule: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Spec D1, H4: step by step, one's own learner and chooser in the loop, in ``OptionEnv`` and as a reward."""
    monkeypatch.setenv("HYPOGOAL_TRUST", "1")
    network, timeout = "odd_parts:Straight", 6
    engine = DoorKeyEngine(100, 1)
    ensembles = ensembles_on(engine)
    config = OptionConfig.of(network=network, termination=rule, option_timeout=timeout, environments=1)
    ends = learned_terminations(engine, ensembles, rule=rule)
    chooser = load_chooser("odd_parts:First").create(engine, 4, config, 0, "cpu")
    loop = loop_of(engine, chooser=chooser, ends=ends, config=config)
    steps = [loop.advance(learning=False) for _ in range(150)]
    executions = sorted(itertools.chain(*loop.recorder.executions), key=lambda execution: execution.step)

    weights = loop.learner.state() | ends.rule.state()
    named = config.model_dump() | {"sub_goals": ["a", "b"], "members": 2}
    policies = make_policies(named, weights, {"observation_shape": engine.observation_shape})
    options = Options(("a", "b"), 2, ensembles, policies, saved_rule(rule, weights, 4), timeout, True, "", {})
    played: list[int] = []
    env = OptionEnv(Watched(door_key(), played), options)
    env.reset(seed=0)
    for execution in executions:
        option = chooser.choose(np.zeros(1, np.int64), np.zeros(1, np.int64), env.action_masks()[None])[0]
        *_, terminated, truncated, info = env.step(option)
        assert (option, info["duration"], info["reached"]) == (execution.option, execution.duration, execution.reached)
        if terminated or truncated:
            env.reset(seed=0)
    assert played == [int(moved.actions[0]) for moved in steps[: len(played)]]

    alone = replace(options, mask_reached=False, timeout=30)
    for option in range(4):
        env = OptionEnv(door_key(), alone)
        env.reset(seed=0)
        info = env.step(option)[4]
        rewarded = SubgoalReward(ensembles[option // 2], by=option % 2, termination=rule).wrap(door_key(), start="paid")
        observation, _ = rewarded.reset(seed=0)
        act, held = policies(option), []
        while len(held) < info["duration"]:
            observation, *_, paid = rewarded.step(act(observation))
            held.append(paid["subgoal"]["predicted"])
        assert held == [False] * (len(held) - 1) + [info["reached"]]
    reached = [execution.reached for execution in executions]
    assert any(reached) == (rule != "odd_parts:Never") and (rule == "learned" or not all(reached))
