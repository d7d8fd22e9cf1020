"""Options that are trained further elsewhere (beyond the paper)."""

from pathlib import Path

import numpy as np
import pytest
import torch
from toy_data import untrained

import hypogoal
from hypogoal.core.artefacts import open_artefact
from hypogoal.core.errors import UserError
from hypogoal.core.tensors import load_tensors
from hypogoal.domains.montezuma.domain import DOMAIN
from hypogoal.domains.montezuma.engine import MontezumaEngine
from hypogoal.stages.train_options import train_options

QUICK = {"environments": 3, "warm_up": 60, "update_interval": 20, "option_batch": 16, "option_timeout": 20}


def train(ensemble: Path, out: Path, options: Path | None = None, **changes: object) -> dict[str, object]:
    settings = DOMAIN.defaults["train-options"] | QUICK | {"steps": 120, "replay": 500, "start": "1L"} | changes
    return train_options(ensemble, out, options=options, quiet=True, **settings).metrics


@pytest.mark.atari
def test_options_go_on_elsewhere(tmp_path: Path) -> None:
    """Policies trained at one ladder, then at another; what is loaded plays as they do."""
    ensemble = untrained(tmp_path / "ensemble", DOMAIN)
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
        train(untrained(tmp_path / "another", DOMAIN, seed=1), tmp_path / "other", tmp_path / "near", **as_they_are)
