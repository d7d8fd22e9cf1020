"""Options distilled from plans: they learn the best actions, and are played without an engine (Spec H6)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from corridor import Corridor

import hypogoal
from hypogoal.cli import main
from hypogoal.core.artefacts import open_artefact
from hypogoal.core.errors import UserError
from hypogoal.core.seeding import rng_for
from hypogoal.core.tensors import load_tensors
from hypogoal.domains.base import Layouts
from hypogoal.domains.doorkey_engine import DoorKeyEngine
from hypogoal.meta.episodes import agent_of
from hypogoal.options.choosers import RandomChooser
from hypogoal.options.config import OptionConfig
from hypogoal.options.distilled import FINAL, PLANNED, VISITED, DistilledLearner
from hypogoal.options.loop import OptionLoop
from hypogoal.options.planned import FAR, PlannedLearner
from hypogoal.options.recording import Recorder
from hypogoal.options.termination import oracle_terminations

GOALS = 5
QUICK: dict[str, Any] = {
    "network": "distilled", "embedding": "grid", "environments": 8, "option_batch": 64, "update_interval": 8,
    "option_learning_rate": 2e-3, "rate_steps": 3200,
}  # fmt: skip


def loop_of(engine: Any, **changes: Any) -> OptionLoop:
    ends, config = oracle_terminations(engine, range(GOALS)), OptionConfig(**{**QUICK, **changes})
    learner, recorder = DistilledLearner(engine, ends, config, seed=0), Recorder(GOALS, engine)
    return OptionLoop(engine, ends, learner, RandomChooser(rng_for(0, "c")), recorder, config, gamma=1.0)


def layouts(*seeds: int) -> Layouts:
    return Layouts(seeds, rng_for(0, "layouts"))


def test_what_it_learns_are_the_plans_best_actions() -> None:
    """In every state of every layout played, all actions that a planned option may begin a shortest way with."""
    loop = loop_of(DoorKeyEngine(layouts(3, 5), 8))
    learner = loop.learner
    assert isinstance(learner, DistilledLearner)
    for _ in range(30):
        loop.step()
    for seed in (3, 5):
        engine = DoorKeyEngine(seed)
        planned = PlannedLearner(engine, oracle_terminations(engine, range(GOALS)), OptionConfig(network="planned"), 0)
        theirs = engine.plan()
        ours = learner.engine.plan(np.array([loop.engine._start(seed)]))
        assert len(ours.ids) == len(theirs.ids)
        place = {row.tobytes(): number for number, row in enumerate(engine.codes(theirs.ids))}
        same = np.array([place[row.tobytes()] for row in learner.engine.codes(ours.ids)])
        ahead = planned.steps[planned._after[same]]  # (n, A, O)
        nearest = ahead.min(1)
        wanted = (ahead == nearest[:, None]) & (nearest < FAR)[:, None]
        bits = learner.best[ours.ids].astype(np.int64)[:, None] >> learner.actions[:, None] & 1
        assert np.array_equal(bits.astype(bool), wanted)
        assert np.array_equal(learner.kind[ours.ids] == FINAL, ours.final)
        assert (learner.kind[ours.ids[~ours.final]] >= PLANNED).all()
    assert 0 < (learner.kind == VISITED).sum() < (learner.kind >= PLANNED).sum() / 4


def test_while_it_learns_its_plan_plays_and_afterwards_its_network() -> None:
    """Three tenths of the actions are random, which may be best by luck; then play needs no plan at all."""
    loop = loop_of(DoorKeyEngine(layouts(3, 5, 7), 8))
    learner, best = loop.learner, []
    for _ in range(200):
        loop._choose()
        ids, options = loop.engine.ids.copy(), loop.option.copy()
        moved = loop.advance()
        chosen = learner.best[ids, options] >> moved.actions & 1
        best += chosen[learner.best[ids, options] > 0].tolist()
    assert 0.7 < np.mean(best) < 0.85
    fresh = loop_of(DoorKeyEngine(layouts(11), 8))
    fresh.learner.load(learner.state())
    for _ in range(30):
        assert fresh.step() == {}
    assert len(fresh.learner.kind) == 0


@pytest.mark.parametrize("embedding", ["grid", "deep"])
def test_it_learns_to_follow_its_plans(embedding: str) -> None:
    """One layout, learned by heart: nearly all of its greedy actions are best ones, and were not before."""
    loop = loop_of(DoorKeyEngine(4, 8), embedding=embedding)
    learner = loop.learner

    def right() -> float:
        states = np.flatnonzero(learner.kind >= PLANNED)
        shares = []
        for option in range(GOALS):
            going = states[learner.best[states, option] > 0]
            greedy = learner.greedy(going, np.full(len(going), option), np.zeros(len(going), np.int64))
            shares.append((learner.best[going, option] >> greedy & 1).mean())
        return float(np.mean(shares))

    loop.step()
    before = right()
    for _ in range(399):
        loop.step()
    assert before < 0.8 and right() > 0.95


def test_it_needs_a_model_and_single_positive_predictions() -> None:
    """One line of what, where and what to do."""
    engine = Corridor(2)
    with pytest.raises(UserError, match="does not know what each action leads to") as caught:
        DistilledLearner(engine, oracle_terminations(engine, (0,)), OptionConfig(network="distilled"), seed=0)
    assert "network=distilled" in str(caught.value)


@pytest.fixture(scope="module")
def ensemble(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small real one."""
    folder = tmp_path_factory.mktemp("distilled")
    few = ["--set", "heldout_layouts=1", "--set", "unlabelled_seeds=1", "-q"]
    assert main(["collect", "doorkey", "--out", str(folder / "data.h5"), *few]) == 0
    few = ["--set", "steps=2", "--set", "members=2", "--set", "workers=1", "-q"]
    assert main(["train-ensemble", str(folder / "data.h5"), "--out", str(folder / "ensemble"), *few]) == 0
    return folder / "ensemble"


def test_from_training_to_play_without_an_engine(
    ensemble: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """They learn in train-options alone, an agent learns over them in another layout, and OptionEnv plays them."""
    options, out = str(tmp_path / "options"), str(tmp_path / "meta")
    named = ["--set", "network=distilled", "--set", "embedding=deep"]
    few = [*named, "--set", "random_episodes=2", "--set", "steps=256", "-q"]
    assert main(["train-meta", str(ensemble), "--out", out, *few]) == 2
    assert "learn in train-options alone" in capsys.readouterr().err
    train = ["train-options", str(ensemble), *few, "--set", "layouts=1000-1002"]
    assert main([*train, "--out", options]) == 0
    assert main([*train, "--out", str(tmp_path / "more"), "--options", options]) == 2
    assert "learn once and for all" in capsys.readouterr().err
    assert main(["train-meta", str(ensemble), "--options", options, "--out", out, *few, "--layout-seed", "300"]) == 0
    learned, played = (load_tensors(Path(folder) / "options.safetensors") for folder in (options, out))
    assert all(torch.equal(value, played[name]) for name, value in learned.items() if name.startswith("online."))
    loaded, loop = hypogoal.load_options(Path(out)), agent_of(open_artefact(Path(out), "meta"), 0, 1)
    ids = loop.engine.plan().ids[::97]
    for option in range(loaded.count):
        inside = loop.learner.act(ids, np.full(len(ids), option), np.zeros(len(ids), np.int64), explore=False)
        outside = [loaded.policies(option)(image) for image in loop.engine.images(ids)]
        assert inside.tolist() == outside
    env = hypogoal.OptionEnv(loaded.make_env(layout_seed=300), loaded)
    env.reset(seed=0)
    assert env.step(int(env.action_masks().nonzero()[0][0]))[4]["duration"] >= 1
