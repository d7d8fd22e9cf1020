"""Spec E7, A7: the baselines are in working order and their artefacts say what happened."""

import csv
import json
import math
from typing import Any

import numpy as np
import pytest
import torch
from breaking import Breaking, Broken
from corridor import Corridor
from gymnasium import spaces

from hypogoal.baselines.agents import epsilon, train
from hypogoal.baselines.engine_env import NETWORKS, BlockConvolution, EngineEnv
from hypogoal.baselines.settings import HYPERPARAMETERS
from hypogoal.core.artefacts import open_artefact
from hypogoal.core.checkpoints import Checkpoints
from hypogoal.core.errors import UserError
from hypogoal.core.progress import MetricsLog, Progress
from hypogoal.core.tensors import load_tensors
from hypogoal.domains.doorkey.domain import DOMAIN
from hypogoal.domains.doorkey.engine import DoorKeyEngine
from hypogoal.domains.episodes import EpisodeRecorder, PlayedEpisode
from hypogoal.domains.world import WorldConfig, make_engine
from hypogoal.stages.train_baseline import train_baseline

EASY_STEPS = {("ppo", "paper"): 1_000, ("dqn", "paper"): 2_000, ("ppo", "tuned"): 3_000, ("dqn", "tuned"): 3_000}


class Low(Corridor):
    """In pictures that three convolutions take."""

    observation_shape = (32, 64, 3)


def learn(env, chosen, steps, folder, kept=None):
    """A trained agent."""
    log, progress = MetricsLog(folder / "metrics.jsonl"), Progress("", steps, quiet=True)
    return train(env, chosen, steps, 1, log, progress, kept or Checkpoints(None))


@pytest.mark.parametrize(("agent", "setting"), list(HYPERPARAMETERS))
def test_solves_an_easy_task(agent, setting, tmp_path):
    """Spec E7: every baseline, in either setting, learns a corridor that random play rarely finishes in time."""
    chosen = HYPERPARAMETERS[agent, setting]
    env = EngineEnv(Low(chosen.environments, max_steps=4))
    trained = learn(env, chosen, EASY_STEPS[agent, setting], tmp_path)
    assert np.mean([episode.terminated for episode in env.episodes.rows[:20]]) < 0.5
    trial = EngineEnv(Low(1))
    observation: Any = trial.reset()
    while not trial.episodes.rows:
        observation = trial.step(trained.predict(observation, deterministic=True)[0])[0]
    assert trial.episodes.rows == [(3, 3, 1.0, 1, 1)]  # the shortest way, by the greedy policy


def test_a_time_limit_is_not_a_terminal_state():
    """Spec E7, D2: a cut episode is told to the agent as truncated, with the state it was cut in; the goal is not."""
    corridor = Low(2, max_steps=3)
    env = EngineEnv(corridor)
    env.reset()
    for _ in range(2):
        assert not env.step(np.array([0, 1]))[2].any()
    observations, rewards, done, infos = env.step(np.array([0, 1]))  # the second is at the goal, in its last step
    assert done.tolist() == [True, True] and rewards.tolist() == [0.0, 1.0]
    assert [info["TimeLimit.truncated"] for info in infos] == [True, False]
    last, begin = (corridor.images(np.array([cell]))[0].transpose(2, 0, 1) for cell in (0, 2))
    assert np.array_equal(infos[0]["terminal_observation"], last)
    assert np.array_equal(np.asarray(observations), [begin, begin])  # the next episode's start
    assert env.episodes.rows == [(6, 3, 0.0, 0, 0), (6, 3, 1.0, 1, 1)]


@pytest.mark.parametrize("network", list(NETWORKS))
def test_tile_codes_say_what_the_image_says(network):
    """Spec E7: with a table of tiles the network gives what the same weights give for the RGB image itself."""
    engine = DoorKeyEngine(3, 4)
    ids = engine.reachable()[::37]
    images = torch.from_numpy(engine.images(ids)).permute(0, 3, 1, 2).float() / 255
    codes = torch.from_numpy(engine.codes(ids)).float()
    by_code = NETWORKS[network](spaces.Box(0, 255, (64,), np.uint8), tiles=engine.tiles, rows=8)
    by_image = NETWORKS[network](spaces.Box(0, 255, (3, 64, 64), np.uint8))
    by_image.load_state_dict(by_code.state_dict())
    assert torch.allclose(by_code(codes), by_image(images), atol=1e-5)


def test_block_convolution_is_a_convolution():
    """Spec E2, E7: the paper's convolutions, written as matrix products, are convolutions: values and gradients."""
    block, plain = BlockConvolution(3, 5, 2), torch.nn.Conv2d(3, 5, 2, stride=2)
    kernel = block.linear.weight.detach().view(5, 2, 2, 3).permute(0, 3, 1, 2)
    plain.load_state_dict({"weight": kernel, "bias": block.linear.bias.detach()})
    inputs = torch.rand(4, 3, 6, 8, generator=torch.Generator().manual_seed(0), requires_grad=True)
    expected = plain(inputs)
    found = block(inputs.permute(0, 2, 3, 1)).permute(0, 3, 1, 2)
    assert torch.allclose(found, expected, atol=1e-6)
    (wanted,) = torch.autograd.grad(expected.square().sum(), inputs, retain_graph=True)
    (had,) = torch.autograd.grad(found.square().sum(), inputs)
    assert torch.allclose(had, wanted, atol=1e-5)


def test_epsilon_waits_for_the_first_goal():
    """Spec E7, Table 4: 1 -> 0.01 over 8,000 steps from the start; the tuned one falls from its first goal on."""
    paper, tuned = HYPERPARAMETERS["dqn", "paper"], HYPERPARAMETERS["dqn", "tuned"]
    episodes = EpisodeRecorder(4)
    for steps, wanted in ((0, 1.0), (4_000, 0.505), (8_000, 0.01), (9_000, 0.01)):
        episodes.steps = steps
        assert epsilon(paper, episodes) == pytest.approx(wanted)
    episodes.steps = 200_000
    episodes.rows.append(PlayedEpisode(9_000, 50, 0.0, 0, 0))
    assert epsilon(tuned, episodes) == 1.0
    episodes.rows += [PlayedEpisode(184_000, 40, 1.0, 1, 1), PlayedEpisode(190_000, 40, 1.0, 1, 1)]
    assert epsilon(tuned, episodes) == pytest.approx(0.525)


def test_the_paper_setting_is_the_papers():
    """Spec E3, D3, E7: the numbers of Tables 4 and 5."""
    ppo, dqn = HYPERPARAMETERS["ppo", "paper"], HYPERPARAMETERS["dqn", "paper"]
    assert (ppo.rollout, ppo.entropy, ppo.gae_lambda, ppo.batch, ppo.epochs) == (100, 0.01, 0.97, 64, 10)
    assert (dqn.replay, dqn.target_interval, dqn.epsilon_steps, dqn.epsilon_final) == (100_000, 10, 8_000, 0.01)
    assert (dqn.learning_rate, dqn.batch, dqn.environments) == (2.5e-4, 32, 4)


def test_the_artefact_says_what_happened(tmp_path):
    """Spec A7, A8: episodes, layout, hyperparameters, weights without pickle."""
    train_baseline("doorkey", tmp_path / "a", agent="dqn", steps=2_560, max_episode_steps=40, seed=4, quiet=True)
    artefact = open_artefact(tmp_path / "a", "baseline")
    assert artefact.config["hyperparameters"]["epsilon_from"] == "first-goal"
    assert artefact.config["environments"] == 16
    rows = list(csv.DictReader((tmp_path / "a" / "episodes.csv").read_text().splitlines()))
    assert len(rows) == 64
    facts = json.loads((tmp_path / "a" / "layout.json").read_text())
    assert facts["shortest_path"] >= 9
    assert facts["random_episodes"] == 200
    assert load_tensors(tmp_path / "a" / "policy.safetensors")["q_net.q_net.0.weight"].shape == (7, 128)
    names = {path.name for path in artefact.path.iterdir()}
    assert names == {"manifest.json", "episodes.csv", "layout.json", "metrics.jsonl", "policy.safetensors"}


def test_global_randomness_is_given_back(tmp_path):
    """Spec E7: the library draws from global generators; ours are where they were afterwards."""
    torch.manual_seed(5)
    expected = torch.rand(1)
    torch.manual_seed(5)
    learn(EngineEnv(Low(4)), HYPERPARAMETERS["ppo", "paper"], 100, tmp_path)
    assert torch.rand(1) == expected


@pytest.mark.parametrize(("agent", "last"), [("ppo", 4), ("dqn", 100)])
def test_a_break_leaves_no_trace(agent, last, tmp_path):
    """Spec G1: broken off before its last rollout and resumed, an agent ends with the same weights and episodes."""
    chosen = HYPERPARAMETERS[agent, "tuned"]

    def trained(checkpoints):
        env = EngineEnv(DoorKeyEngine(100, chosen.environments, max_steps=40))
        found = learn(env, chosen, 2_560, tmp_path, checkpoints)
        return env.episodes.rows, found.policy.state_dict()

    episodes, unbroken = trained(Checkpoints(None))
    path = tmp_path / "checkpoint"
    with pytest.raises(Broken):
        trained(Breaking(path, last))
    resumed_episodes, resumed = trained(Checkpoints(path))
    assert resumed_episodes == episodes
    assert all(torch.equal(weight, resumed[name]) for name, weight in unbroken.items())


def test_it_plays_in_the_agents_world(tmp_path):
    """A wrong key ends the episode, and so does 1.5 times the shortest path, as for agents with options."""
    few = {"steps": 1_280, "layout_seed": 70105, "world": ("wrong_key=ends",), "cap": 1.5}
    train_baseline("doorkey", tmp_path / "a", quiet=True, **few)
    assert open_artefact(tmp_path / "a", "baseline").config["domain_config"] == {"wrong_key": "ends"}
    shortest = json.loads((tmp_path / "a" / "layout.json").read_text())["shortest_path"]
    rows = list(csv.DictReader((tmp_path / "a" / "episodes.csv").read_text().splitlines()))
    lengths = {int(row["length"]) for row in rows if row["succeeded"] == "0"}
    assert max(lengths) == math.ceil(1.5 * shortest)
    assert min(lengths) < shortest  # a wrong key
    with pytest.raises(UserError, match="no such setting"):
        train_baseline("doorkey", tmp_path / "b", world=("labelled_seed=3",), quiet=True)


def test_a_cap_that_is_a_whole_number_of_steps_is_that_many():
    """2.2 times 25 steps is 55; floating point makes it a little more, and the next whole number 56."""
    assert DoorKeyEngine(8, 1).shortest_path() == 25
    for cap, steps in ((2.2, 55), (2.21, 56), (1.0, 25)):
        assert make_engine(DOMAIN, {}, WorldConfig(layout_seed=8, cap=cap), 1).max_steps == steps
