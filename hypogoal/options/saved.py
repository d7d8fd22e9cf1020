"""Greedy policies of options in an artefact, without an engine."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from hypogoal.core.tensors import below, load_fitting
from hypogoal.observations import Observations, Shape, standard_of
from hypogoal.options.networks import LightQNetwork

FILE = "options.safetensors"  # of an artefact
# Starts an execution of an option: gives a function from an observation (*obs) to the action.
Policies = Callable[[int], Callable[[Observations], int]]


@dataclass(frozen=True)
class SavedOptions:
    """An artefact's options, on observations of this ``shape``."""

    config: Mapping[str, Any]
    weights: Mapping[str, Tensor]
    shape: Shape

    @property
    def count(self) -> int:
        """How many options there are."""
        return len(self.config["sub_goals"]) * self.config["members"]


class LightPolicies:
    """Those of options that share a light network."""

    def __init__(self, options: SavedOptions):
        weights = below("online.", options.weights)
        embedding = options.config["embedding"]
        actions = len(weights.get("heads.weight", ())) // options.count or 1  # any, where weights are missing
        standard = standard_of(options.shape) if "cells.mean" in weights else None  # the weights' own replaces it
        make = partial(LightQNetwork, options.shape, options.count, actions, standard, embedding)
        self.network = load_fitting(make, weights, FILE)

    def __call__(self, option: int) -> Callable[[Observations], int]:
        """Start an execution."""
        return partial(self._act, option)

    @torch.no_grad()
    def _act(self, option: int, observation: Observations) -> int:
        values = self.network(torch.from_numpy(np.ascontiguousarray(observation[None])))
        return int(values[0, option].argmax())
