"""Ensembles as files: one safetensors file per sub-goal in an ensemble artefact's folder."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from hypogoal.core.errors import UserError
from hypogoal.core.tensors import load_tensors, save_tensors
from hypogoal.hypotheses.ensemble import Ensemble
from hypogoal.hypotheses.localisers import LOCALISERS
from hypogoal.hypotheses.views import AgentView, FullView


def write_ensemble(folder: Path, sub_goal: str, ensemble: Ensemble) -> None:
    """``<sub-goal>.safetensors`` into ``folder``."""
    save_tensors(folder / f"{sub_goal}.safetensors", ensemble.state())


def read_ensemble(folder: Path, config: dict[str, Any], sub_goal: str) -> Ensemble:
    """The ensemble of one sub-goal.

    Args:
        folder: an ensemble artefact's folder.
        config: its manifest's configuration.
        sub_goal: one of ``config["sub_goals"]``.

    Raises:
        UserError: the artefact has no such sub-goal, or its weights are missing or damaged.
    """
    if sub_goal not in config["sub_goals"]:
        raise UserError("unknown sub-goal", sub_goal, f"{folder} has {', '.join(config['sub_goals'])}.")
    path = folder / f"{sub_goal}.safetensors"
    state = load_tensors(path)
    try:
        shape = tuple(config["observation_shape"])
        return Ensemble.from_state(config["network"], shape, config["members"], state, _view(shape, config))
    except (RuntimeError, KeyError):
        raise UserError("the weights do not fit the manifest", path, "Train the ensemble again.") from None


def _view(observation_shape: tuple[int, ...], config: dict[str, Any]) -> FullView | AgentView:
    """The view that the settings say, its weights not yet loaded; ensembles from before there were any see all."""
    if config.get("view", "full") == "full":
        return FullView(observation_shape)
    localiser = LOCALISERS[config["localiser"]](observation_shape)
    return AgentView(observation_shape, config["crop_height"], config["crop_width"], localiser)
