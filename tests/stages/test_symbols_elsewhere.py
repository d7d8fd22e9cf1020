"""``train-meta --set chooser=symbols``: what its artefact holds, plays frozen, and carries to another layout."""

from pathlib import Path

import gymnasium
import numpy as np
import pytest
import torch
from command_line import refuses, run, settings

import hypogoal
from hypogoal.core.artefacts import open_artefact
from hypogoal.core.tensors import load_tensors
from hypogoal.evaluation.frozen import play
from hypogoal.meta.episodes import agent_of
from hypogoal.meta.symbols import SymbolsChooser
from hypogoal.options.choosers import FILE, Outcome

PLAY = [*settings("chooser=symbols", "network=planned", "environments=2", "steps=600", "max_episode_steps=40"), "-q"]


@pytest.fixture(scope="module")
def agent(tiny_run: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An agent of layout 100."""
    folder = tmp_path_factory.mktemp("symbols") / "agent"
    run("train-meta", tiny_run / "ensemble", "--out", folder, *PLAY, *settings("layout_seed=100"))
    return folder


def test_its_artefact_plays_frozen(agent: Path) -> None:
    """Greedy: the same episodes whatever the draws' seed, and no count changes."""
    played = []
    for seed in (1, 2):
        loop = agent_of(open_artefact(agent), seed, 1)
        chooser = loop.chooser
        assert isinstance(chooser, SymbolsChooser) and chooser.frozen
        known = set(range(len(chooser.model.symbols)))
        played.append(play(loop, chooser, 2).length.tolist())
        assert known == set(range(len(chooser.model.symbols)))
        for name, values in load_tensors(agent / FILE).items():
            assert torch.equal(values, chooser.state()[name])
    assert played[0] == played[1]


def test_it_plays_options_of_an_environment(tiny_run: Path, agent: Path) -> None:
    """Loaded without an engine, it chooses actions of ``OptionEnv``; whose policies these are makes no difference."""
    options = hypogoal.load_options(tiny_run / "meta")
    env = hypogoal.OptionEnv(options.make_env(layout_seed=100), options, gamma=0.99)
    assert isinstance(env.action_space, gymnasium.spaces.Discrete)
    chooser = SymbolsChooser(1, options.count, np.random.default_rng(0))
    chooser.load(load_tensors(agent / FILE))
    env.reset(seed=0)
    for _ in range(4):
        offered = env.action_masks()[None]
        [option] = chooser.choose(np.array([0]), np.array([0]), offered).tolist()
        assert offered[0, option]
        _, reward, terminated, truncated, info = env.step(option)
        tau = info["duration"]
        ends = [terminated], [truncated]
        chooser.record(Outcome.cast([0], [option], [0], [False], [False], [reward], [tau], [0.99**tau], [0], *ends))
        if terminated or truncated:
            env.reset()


@pytest.mark.parametrize("carried", ["none", "prior", "all"])
def test_it_goes_on_in_another_layout(tiny_run: Path, agent: Path, tmp_path: Path, carried: str) -> None:
    """What is counted there comes on top of what was carried; the artefact names where that is from."""
    out, few = tmp_path / "meta", settings(f"carried={carried}", "layout_seed=101", "steps=20")
    run("train-meta", tiny_run / "ensemble", "--agent", agent, "--out", out, *PLAY, *few)
    before, after = (load_tensors(folder / FILE) for folder in (agent, out))
    known = len(before["symbols"]) if carried != "none" else 0
    assert len(after["symbols"]) >= known
    assert torch.equal(after["symbols"][:known], before["symbols"][:known])
    new = after["sums"][:, 0].sum().item()
    most = {"none": 20, "prior": 20 + len(before["sums"]), "all": 20 + before["sums"][:, 0].sum().item()}
    assert 0 < new <= most[carried]
    assert (new >= before["sums"][:, 0].sum().item()) == (carried == "all")
    assert [entry.kind for entry in open_artefact(out).manifest.inputs] == ["ensemble", "meta"]


def test_another_choosers_agent_is_refused(tiny_run: Path, tmp_path: Path) -> None:
    """The counts are of symbols, the weights of a network."""
    command = ["train-meta", tiny_run / "ensemble", "--agent", tiny_run / "meta", "--out", tmp_path / "meta", *PLAY]
    refuses("the weights do not fit symbols", *command)
    refuses("history='3'", *command, *settings("history=3"))
    refuses("has this setting only beside another choice: history", *command, *settings("chooser=ppo", "history=1"))
