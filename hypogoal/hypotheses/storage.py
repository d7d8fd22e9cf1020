"""Ensembles as files: one safetensors file per sub-goal in an ensemble artefact's folder."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from hypogoal.core.errors import UserError
from hypogoal.core.files import inside
from hypogoal.core.tensors import load_tensors, save_tensors
from hypogoal.domains.base import load_domain
from hypogoal.hypotheses.ensemble import Ensemble
from hypogoal.hypotheses.localisers import LearnedLocaliser, RamLocaliser
from hypogoal.hypotheses.views import AgentView, FullView


def write_ensemble(folder: Path, sub_goal: str, ensemble: Ensemble) -> None:
    """``<sub-goal>.safetensors`` into ``folder``."""
    save_tensors(folder / f"{sub_goal}.safetensors", ensemble.state())


def read_ensemble(folder: Path, config: Mapping[str, Any], sub_goal: str) -> Ensemble:
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
    path = inside(folder, f"{sub_goal}.safetensors")
    if path is None:
        raise UserError("the weights lie outside their artefact", folder, "Train the ensemble again.")
    state = load_tensors(path)
    try:
        shape = tuple(config["observation_shape"])
        return Ensemble.from_state(config["network"], shape, config["members"], state, _view(shape, config))
    except (RuntimeError, KeyError, IndexError, TypeError, ValueError):
        raise UserError("the weights do not fit the manifest", path, "Train the ensemble again.") from None


def _view(observation_shape: tuple[int, ...], config: Mapping[str, Any]) -> FullView | AgentView:
    """The view that the settings say, its weights not yet loaded; ensembles from before there were any see all."""
    if config.get("view", "full") == "full":
        return FullView(observation_shape)
    oracle = config["localiser"] == "ram"
    localiser = (
        RamLocaliser(load_domain(config["domain"]).agent_pixels) if oracle else LearnedLocaliser(observation_shape)
    )
    return AgentView(observation_shape, config["crop_height"], config["crop_width"], localiser)
