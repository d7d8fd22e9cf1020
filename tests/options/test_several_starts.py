"""Options that are trained further elsewhere (beyond the paper)."""

from pathlib import Path

import numpy as np
import pytest
import torch
from toy_data import fill

import hypogoal
from hypogoal.core.artefacts import create, open_artefact
from hypogoal.core.errors import UserError
from hypogoal.core.tensors import load_tensors
from hypogoal.domains.montezuma.domain import DOMAIN
from hypogoal.domains.montezuma.engine import MontezumaEngine
from hypogoal.hypotheses.ensemble import Ensemble, write_ensemble
from hypogoal.stages.train_options import train_options

SHAPE = DOMAIN.observation_shape
QUICK = {
    "environments": 3,
    "warm_up": 60,
    "update_interval": 20,
    "option_batch": 16,
    "option_timeout": 20,
    "replay": 500,
}


def ensemble_in(folder: Path, seed: int = 0) -> Path:
    """An ensemble artefact of two members with random weights."""
    config = {"domain": "montezuma", "domain_config": {}, "sub_goals": list(DOMAIN.usual_sub_goals), "members": 2,
              "observation_shape": list(SHAPE), "observation_dtype": "uint8", "view": "full",
              "network": "montezuma"}  # fmt: skip
    with create(folder, kind="ensemble", config=config, seed=seed, inputs=[]) as draft:
        place = draft.files
        ensemble = Ensemble("montezuma", SHAPE, 2, torch.Generator().manual_seed(1))
        write_ensemble(place, DOMAIN.sub_goals[0], ensemble)
        fill(place, "ensemble", config)
    return folder


def train(ensemble: Path, out: Path, options: Path | None = None, **changes: object) -> dict[str, object]:
    settings = DOMAIN.defaults["train-options"] | QUICK | {"steps": 200, "start": "1L"} | changes
    return train_options(ensemble, out, options=options, quiet=True, **settings).metrics


@pytest.mark.atari
def test_options_go_on_elsewhere(tmp_path: Path) -> None:
    """Policies trained at one ladder, then at another; what is loaded plays as they do."""
    ensemble = ensemble_in(tmp_path / "ensemble")
    train(ensemble, tmp_path / "near", start="1L")
    weights = load_tensors(tmp_path / "near" / "options.safetensors")
    # So long a warm-up that nothing is learned: the options as they are.
    as_they_are = {"start": "3-9", "warm_up": 10**6}
    train(ensemble, tmp_path / "far", tmp_path / "near", **as_they_are)
    far = load_tensors(tmp_path / "far" / "options.safetensors")
    assert all(torch.equal(value, far[name]) for name, value in weights.items() if name.startswith("online."))
    assert (far["option_steps"] > weights["option_steps"]).all()
    assert open_artefact(tmp_path / "far").config["start"] == "3-9"
    options = hypogoal.load_options(tmp_path / "far")
    picture = MontezumaEngine("3-9", 1).images(np.array([0]))[0]
    assert 0 <= options.policies(1)(picture) < 18
    with pytest.raises(UserError, match="trained with embedding=auto, not montezuma"):
        train(ensemble, tmp_path / "other", tmp_path / "near", embedding="montezuma")
    with pytest.raises(UserError, match="trained with another ensemble"):
        train(ensemble_in(tmp_path / "another", seed=1), tmp_path / "other", tmp_path / "near", **as_they_are)
