"""Greedy policies of the options in an artefact, which need no engine."""

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

FILE = "options.safetensors"  # the file with the options' weights in an artefact
# A function that starts an execution of an option and returns a function from an observation (*obs) to an action.
Policies = Callable[[int], Callable[[Observations], int]]


@dataclass(frozen=True)
class SavedOptions:
    """The options of an artefact, for observations of shape ``shape``."""

    config: Mapping[str, Any]
    weights: Mapping[str, Tensor]
    shape: Shape

    @property
    def count(self) -> int:
        """The number of options."""
        return len(self.config["sub_goals"]) * self.config["members"]


class LightPolicies:
    """The greedy policies of options that share a light network."""

    def __init__(self, options: SavedOptions):
        weights = below("online.", options.weights)
        embedding = options.config["embedding"]
        actions = len(weights.get("heads.weight", ())) // options.count or 1  # 1 if weights are missing, refused below
        standard = standard_of(options.shape) if "cells.mean" in weights else None  # replaced by that of the weights
        make = partial(LightQNetwork, options.shape, options.count, actions, standard, embedding)
        self.network = load_fitting(make, weights, FILE)

    def __call__(self, option: int) -> Callable[[Observations], int]:
        """Start an execution of ``option``, and return the function from an observation to an action."""
        return partial(self._act, option)

    @torch.no_grad()
    def _act(self, option: int, observation: Observations) -> int:
        values = self.network(torch.from_numpy(np.ascontiguousarray(observation[None])))
        return int(values[0, option].argmax())
