"""Spec D2, D8, E1, E2: settings on the real DoorKey engine, and what training from an options artefact begins with."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from command_line import run, settings
from loops import loop_of

from hypogoal.baselines.agents import make_agent
from hypogoal.baselines.engine_env import EngineEnv
from hypogoal.baselines.settings import PPOSettings
from hypogoal.core.errors import UserError
from hypogoal.core.tensors import save_tensors
from hypogoal.domains.doorkey.engine import DoorKeyEngine
from hypogoal.meta.config import TrainMetaConfig
from hypogoal.meta.networks import LightMetaNetwork
from hypogoal.meta.setup import frames_kept
from hypogoal.meta.training import continue_with
from hypogoal.options.config import OptionConfig
from hypogoal.options.conv_gru import PaperLearner
from hypogoal.options.light import LightLearner
from hypogoal.options.loop import Transitions
from hypogoal.options.termination import oracle_terminations

GOALS = 5
QUICK: dict[str, Any] = {"environments": 2, "warm_up": 20, "update_interval": 4, "option_batch": 8, "replay": 200}


def learner_of(kind: type, **changes: Any) -> Any:
    engine = DoorKeyEngine(100, 2, max_steps=50)
    verdicts = oracle_terminations(engine, range(GOALS))
    network = "paper" if kind is PaperLearner else "light"
    return kind(engine, verdicts, OptionConfig.of(**{"network": network, **QUICK, **changes}), seed=0)


def walk(learner: Any, steps: int) -> None:
    """So many steps of option 0 in both environments, none of which reaches anything."""
    engine = learner.engine
    options, rng = np.zeros(2, dtype=np.int64), np.random.default_rng(0)
    nothing, ends = np.zeros(2, dtype=np.bool_), np.ones(2, dtype=np.bool_)
    for age in range(steps):
        if isinstance(learner, PaperLearner):  # which keeps the states of running executions
            learner.act(engine.ids, options, np.full(2, age))
        ids, actions = engine.ids.copy(), rng.integers(2, size=2)  # it only turns
        step = engine.step(actions)
        learner.observe(
            Transitions(ids, actions, step.next_ids, step.rewards, options, nothing, nothing, nothing, ends)
        )
        learner.learn()


@pytest.mark.usefixtures("small_gru")
def test_the_papers_preset_plays_and_learns(tiny_run: Path, tmp_path: Path) -> None:
    """Spec E1, E2, Tables 3 to 5: its networks on the real engine, options and meta-policy updated."""
    out, few = tmp_path / "meta", settings("steps=120", "decisions=8", "warm_up=8", "option_batch=4")
    run("train-meta", tiny_run / "ensemble", "--out", out, "--preset", "paper", *few, "-q")
    assert (out / "meta.safetensors").is_file()
    assert (out / "choices.csv").read_text().count("\n") > 1


@pytest.mark.usefixtures("small_gru")
@pytest.mark.parametrize("kind", [LightLearner, PaperLearner])
def test_exploration_goes_on_falling_where_options_go_on(kind: type) -> None:
    """Spec D8: a member that found its sub-goal in the run before has found it; one that never did has not."""
    own = {"experience": "own", "mask_reached": False} if kind is PaperLearner else {}
    learner = learner_of(kind, epsilon_from="first-positive", epsilon_steps=1000, **own)
    state = {**learner.state(), "option_steps": torch.full((GOALS,), 500)}
    state["steps_since_positive"] = torch.tensor([300, 0, 0, 0, 0])
    learner.load(state)
    before = learner.epsilon()
    walk(learner, 40)
    assert learner.epsilon()[0] < before[0] < 1
    fresh = learner_of(kind, epsilon_from="first-positive", epsilon_steps=1000, **own)
    walk(fresh, 40)
    assert (fresh.epsilon() == 1).all()


@pytest.mark.usefixtures("small_gru")
def test_a_continued_paper_learner_fills_its_replay_first() -> None:
    """Spec D2: updates begin when the replay has ``warm_up`` transitions, not when earlier runs had so many steps."""
    learner = learner_of(PaperLearner, experience="own", mask_reached=False)
    learner.load({**learner.state(), "option_steps": torch.full((GOALS,), 5000)})
    walk(learner, 9)
    assert learner.members[0].updates == 0
    walk(learner, 10)
    assert learner.members[0].updates > 0


@pytest.mark.parametrize(
    "changes",
    [
        {"option_batch": 1},
        {"warm_up": 1, "n_step": 10, "update_interval": 1, "experience": "own", "mask_reached": False},
    ],
)
def test_odd_settings_of_options_learn_too(changes: dict[str, Any]) -> None:
    """Spec D8: a batch of positives only keeps one transition that priorities draw; an empty replay waits."""
    learner = learner_of(LightLearner, **changes)
    learner.positives[0] = learner.option_steps[0] = 1  # one is known
    walk(learner, 30)
    assert learner.networks.updates > 0


@pytest.mark.usefixtures("small_gru")
def test_replays_keep_any_action() -> None:
    """Spec D2, B6: an own domain may have more than 128 of them."""
    learner = learner_of(LightLearner)
    own = learner_of(PaperLearner, experience="own", mask_reached=False)
    for data in (learner.replay.data, own.members[0].replay.data):
        data.action[0] = 300
        assert data.action[0] == 300


@pytest.mark.parametrize("shape", [(84, 84, 4), (45, 45, 3), (60, 60, 3)])
def test_the_light_meta_policy_sees_the_whole_picture(shape: tuple[int, ...]) -> None:
    """Spec E2: rows and columns that no whole cells fill count too."""
    torch.manual_seed(0)
    image = torch.zeros(3, *shape, dtype=torch.uint8)
    image[1, -3:], image[2, :, -3:] = 255, 255
    dark, below, right = LightMetaNetwork(shape, 6, None, "light")(image)
    assert not torch.equal(dark, below) and not torch.equal(dark, right)


def test_ppo_needs_a_step_of_each_environment_between_updates() -> None:
    """Spec E7, G2: one line instead of what the library raises."""
    env = EngineEnv(DoorKeyEngine(100, 4, max_steps=50))
    chosen = PPOSettings(rollout=3)
    with pytest.raises(UserError, match="fewer than there are environments: environments=4"):
        make_agent(env, chosen, 0)


def test_an_engine_remembers_what_the_meta_policy_looks_back_at() -> None:
    """Spec E2: states where all decisions of an update began, each of which may have taken an option's whole time."""
    config = TrainMetaConfig.of(chooser="ppo", replay=100, environments=4, decisions=64, option_timeout=200)
    assert frames_kept(config, GOALS) >= 64 * 200
    config = TrainMetaConfig.of(chooser="ppo", replay=100_000, environments=4, decisions=64)
    assert frames_kept(config, GOALS) == LightLearner.reach(config, GOALS)


def test_options_go_on_ending_where_they_ended(tmp_path: Path) -> None:
    """Spec D1, E1: with weights also the thresholds of an artefact, whatever those of its ensemble are."""
    trained, loop = loop_of("light, shared, ppo"), loop_of("light, shared, ppo")
    thresholds = torch.tensor([1.5, -2.0])
    save_tensors(tmp_path / "options.safetensors", {**trained.learner.state(), "thresholds": thresholds})
    assert loop.terminations.rule.thresholds.tolist() != thresholds.tolist()
    artefact: Any = SimpleNamespace(path=tmp_path)
    continue_with(loop, artefact)
    assert loop.terminations.rule.thresholds.tolist() == thresholds.tolist()
