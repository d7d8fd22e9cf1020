"""Policies of windows, several starts, and options that are trained further (beyond the paper)."""

from pathlib import Path

import numpy as np
import pytest
import torch
from toy_data import fill

import hypogoal
from hypogoal.core.artefacts import create_artefact, open_artefact
from hypogoal.core.errors import UserError
from hypogoal.core.tensors import load_tensors
from hypogoal.domains.montezuma import DOMAIN
from hypogoal.domains.montezuma_engine import MontezumaEngine
from hypogoal.hypotheses.ensemble import Ensemble, write_ensemble
from hypogoal.hypotheses.localisers import LearnedLocaliser
from hypogoal.hypotheses.views import AgentView, cut_windows
from hypogoal.meta.config import TrainOptionsConfig
from hypogoal.options.policy_views import SIDE, AgentCrop, Viewed
from hypogoal.stages.train_options import train_options

SHAPE = DOMAIN.observation_shape
CROP = {"network": "montezuma-crop", "view": "agent-crop", "localiser": "learned", "crop_height": 24, "crop_width": 32}
QUICK = {
    "environments": 3,
    "warm_up": 60,
    "update_interval": 20,
    "option_batch": 16,
    "option_timeout": 20,
    "replay": 500,
}


def ensemble_in(folder: Path, seed: int = 0, **changes: object) -> Path:
    """An ensemble artefact with random weights, of two members that look at a window."""
    config = {"domain": "montezuma", "domain_config": {}, "sub_goals": list(DOMAIN.usual_sub_goals), "members": 2,
              "observation_shape": list(SHAPE), **CROP, **changes}  # fmt: skip
    with torch.random.fork_rng():
        torch.manual_seed(0)
        view = AgentView(SHAPE, 24, 32, LearnedLocaliser(SHAPE)) if config["view"] == "agent-crop" else None
    with create_artefact(folder, kind="ensemble", config=config, seed=seed, inputs=[]) as place:
        ensemble = Ensemble(str(config["network"]), SHAPE, 2, torch.Generator().manual_seed(1), view)
        write_ensemble(place, DOMAIN.sub_goals[0], ensemble)
        fill(place, "ensemble", config)
    return folder


def train(ensemble: Path, out: Path, options: Path | None = None, **changes: object) -> dict[str, object]:
    settings = DOMAIN.defaults["train-options"] | QUICK | {"steps": 200, "start": "1L"} | changes
    return train_options(ensemble, TrainOptionsConfig(**settings), out, options=options, quiet=True)


@pytest.mark.atari
def test_the_agent_is_looked_for_once_in_each_state() -> None:
    """Windows are those that the localiser's places give; what it said of a state stands, for what resumes, too."""
    engine = MontezumaEngine("1L", 2)
    rng = np.random.default_rng(0)
    for _ in range(8):
        engine.step(rng.integers(engine.n_actions, size=2))
    ids = rng.integers(engine.n_states, size=30)
    localiser = LearnedLocaliser(SHAPE)
    seen = Viewed(engine, [AgentCrop(SHAPE, localiser)])
    expected = cut_windows(engine.images(ids), localiser.locate(engine.images(ids)), SIDE, SIDE)
    np.testing.assert_array_equal(seen.images(ids), expected)
    again = Viewed(engine, [AgentCrop(SHAPE, LearnedLocaliser(SHAPE))])
    out = np.zeros((30, *seen.observation_shape), np.uint8)
    again.restore(seen.snapshot())
    again.views[0].localiser.locate = None  # type: ignore[attr-defined]
    np.testing.assert_array_equal(again.images(ids, out), expected)
    np.testing.assert_array_equal(out, expected)


@pytest.mark.atari
def test_options_of_several_starts_go_on_elsewhere(tmp_path: Path) -> None:
    """Policies of windows, trained at two ladders in turn, then at a third; what is loaded plays as they do."""
    ensemble = ensemble_in(tmp_path / "ensemble")
    train(ensemble, tmp_path / "near", start="1L,1M", policy_view="agent-crop")
    weights = load_tensors(tmp_path / "near" / "options.safetensors")
    # So long a warm-up that nothing is learned: the options as they are.
    as_they_are = {"policy_view": "agent-crop", "start": "3-9", "warm_up": 10**6}
    train(ensemble, tmp_path / "far", tmp_path / "near", **as_they_are)
    far = load_tensors(tmp_path / "far" / "options.safetensors")
    assert all(torch.equal(value, far[name]) for name, value in weights.items() if name.startswith("online."))
    assert (far["option_steps"] > weights["option_steps"]).all()
    assert open_artefact(tmp_path / "far").config["start"] == "3-9"
    options = hypogoal.load_options(tmp_path / "far")
    picture = MontezumaEngine("3-9", 1).images(np.array([0]))[0]
    assert 0 <= options.policies(1)(picture) < 18
    with pytest.raises(UserError, match="trained with policy_view=agent-crop, not full"):
        train(ensemble, tmp_path / "other", tmp_path / "near")
    with pytest.raises(UserError, match="trained with another ensemble"):
        train(ensemble_in(tmp_path / "another", seed=1), tmp_path / "other", tmp_path / "near", **as_they_are)


@pytest.mark.atari
def test_several_starts_are_drawn_alike() -> None:
    """Each ladder has as many start states."""
    engine = MontezumaEngine("1L,3-9", 4, start_states=6)
    assert engine.positions(np.arange(12))[:, 0].tolist() == [1] * 6 + [3] * 6
    begun = np.concatenate([engine.reset() for _ in range(25)])
    assert 30 < (begun < 6).sum() < 70


@pytest.mark.atari
def test_windows_need_someone_who_finds_the_agent(tmp_path: Path) -> None:
    """Spec G2: one line."""
    whole = ensemble_in(tmp_path / "whole", view="full", network="montezuma")
    for ensemble, changes, line in (
        (whole, {}, "the agent's place in an observation is not known"),
        (ensemble_in(tmp_path / "crop"), {"network": "paper", "n_step": 1}, "network=paper needs policy_view=full"),
    ):
        with pytest.raises(UserError, match=line):
            train(ensemble, tmp_path / "out", policy_view="agent-crop", **changes)
    assert not (tmp_path / "out").exists()
