"""What ``train-meta`` goes on with: options where they fit, counts of symbols in another layout (Spec A4, A8)."""

import shutil
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import torch
from command_line import refuses, run, settings
from toy_data import reseal

import hypogoal
from hypogoal.core.artefacts import open_artefact
from hypogoal.core.tensors import load_tensors
from hypogoal.domains import episodes
from hypogoal.evaluation.curves import budget_of
from hypogoal.evaluation.frozen import play
from hypogoal.meta.episodes import agent_of
from hypogoal.meta.symbols import SymbolsChooser
from hypogoal.options.choosers import FILE, Outcome
from hypogoal.options.tables import Episodes

FEW = [*settings("environments=4", "warm_up=50", "steps=200", "max_episode_steps=30"), "-q"]


@pytest.mark.parametrize(
    ("ensemble", "pairs", "words"),
    [
        ("other-ensemble", [], "another ensemble"),
        ("ensemble", ["layout_seed=3"], "layout_seed=100, not 3"),
        ("ensemble", ["termination=oracle"], "termination=learned, not oracle"),
        ("ensemble", ["network=paper", "experience=own"], "network=light, not paper"),
    ],
)
def test_options_that_do_not_fit_are_refused(
    corridor_copy: Path, tmp_path: Path, ensemble: str, pairs: list[str], words: str
) -> None:
    """Spec A8, G2: one line that says what differs."""
    reseal(shutil.copytree(corridor_copy / "ensemble", corridor_copy / "other-ensemble"), seed=1)
    command = ["train-meta", corridor_copy / ensemble, "--options", corridor_copy / "options", *FEW, *settings(*pairs)]
    refuses(words, *command, "--out", tmp_path / "meta")


def test_options_that_fit_are_continued(corridor_run: Path, tmp_path: Path) -> None:
    """Spec A4: environment steps spent before count in the episodes' steps."""
    command = ["train-meta", corridor_run / "ensemble", "--options", corridor_run / "options", *FEW]
    run(*command, "--out", tmp_path / "meta")
    before = (corridor_run / "options/episodes.csv").read_text()
    after = (tmp_path / "meta" / "episodes.csv").read_text()
    assert after.startswith(before) and int(after.splitlines()[-1].split(",")[0]) > 400
    run(*command, "--out", tmp_path / "shorter", "--set", "max_episode_steps=7")
    steps = [int(row.split(",")[0]) for row in (tmp_path / "shorter/episodes.csv").read_text().splitlines()[1:]]
    assert min(steps) > 400, "episodes of practice in a world of longer episodes are none of the agent's"


def test_options_go_on_as_they_were_learned(corridor_run: Path, tmp_path: Path) -> None:
    """Spec D1, D8, H6: their time and what they see by are taken over; others are refused."""
    options, meta = tmp_path / "options", tmp_path / "meta"
    own = settings("option_timeout=40", "embedding=tiles")
    run("train-options", corridor_run / "ensemble", "--out", options, *FEW, *own)
    command = ["train-meta", corridor_run / "ensemble", "--options", options, "--out", meta, *FEW]
    refuses("trained with option_timeout=40, not 10", *command, "--set", "option_timeout=10")
    refuses("trained with embedding=tiles, not auto", *command, "--set", "embedding=auto")
    run(*command)
    config = open_artefact(meta).config
    assert (config["option_timeout"], config["embedding"]) == (40, "tiles")


def test_practice_that_succeeds_ends_and_the_meta_policy_counts_its_steps(
    corridor_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What ended it stands on the command's last line and in the manifest; its limit is none of what was spent."""
    monkeypatch.setattr(episodes, "LAST", 3)
    lines = {}
    for name, steps in (("early", "4000"), ("late", "40")):
        words = ["train-options", corridor_run / "ensemble", "--out", tmp_path / name, *FEW[:-1]]
        words += settings("until=0.3", f"steps={steps}")
        lines[name] = run(*words).out.splitlines()[-3]
        run(*words, "--resume")  # it is complete
    assert lines["early"].endswith("until=0.3 reached") and lines["late"].endswith("until=0.3 not reached")
    early, late = (open_artefact(tmp_path / name).config for name in lines)
    assert 40 < early["ended_at"] < early["steps"] == 4000 and early["until_reached"] is True
    assert (late["ended_at"], late["steps"], late["until_reached"]) == (40, 40, False)

    out = tmp_path / "meta"
    run("train-meta", corridor_run / "ensemble", "--options", tmp_path / "early", "--out", out, *FEW)
    agent = open_artefact(out)
    budget = budget_of(agent.config)
    assert agent.config["options_ended_at"] == early["ended_at"] and budget == early["ended_at"] + 200
    assert early["ended_at"] < Episodes.read(out / "episodes.csv").step[-1] <= budget


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
