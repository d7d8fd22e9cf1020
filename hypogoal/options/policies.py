"""What options do, out of an artefact's weights: greedy policies that start anew with each execution."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hypogoal.core.errors import UserError
from hypogoal.core.tensors import below, load_fitting
from hypogoal.dataset import Observations
from hypogoal.hypotheses.ensemble import Ensemble
from hypogoal.hypotheses.networks import AUTO, NETWORKS
from hypogoal.options.exploration import actions_of
from hypogoal.options.learner import Policies, load_learner
from hypogoal.options.networks import GRID, LightQNetwork, PaperQNetwork, standard_in
from hypogoal.options.policy_views import PolicyView
from hypogoal.options.termination import ORACLE


def make_policies(
    config: Mapping[str, Any],
    weights: Mapping[str, Tensor],
    ensemble_config: Mapping[str, Any],
    ensemble: Ensemble | None = None,
) -> Policies:
    """Greedy policies from an options artefact's weights and configuration and its ensembles' configuration.

    Policies that see the window around the agent also need the first ensemble.
    """
    if config["termination"] == ORACLE:
        raise UserError(
            "these options end at the true sub-goals, which only the domain's engine can see",
            "termination=oracle",
            "Load options that were trained with learned members.",
        )

    def first_ensemble() -> Ensemble:
        assert ensemble is not None
        return ensemble

    learner = load_learner(config["network"])
    return learner.policies(config, weights, tuple(ensemble_config.get("observation_shape", ())), first_ensemble)


def saved_actions(weights: Mapping[str, Tensor], layer: str, heads: int, options: int) -> NDArray[np.int64]:
    """The actions, int64 (A,), that saved policies choose among, whose last ``layer`` has so many heads of A outputs.

    A ``UserError`` where the weights are not those of so many options.
    """
    outputs = len(weights[layer]) // heads if layer in weights else 0
    actions = actions_of(weights, outputs)
    if not outputs or actions.shape != (outputs,):
        raise UserError("the weights do not fit the manifest", f"{options} options", "Make the artefact again.")
    return actions


class LightPolicies:
    """Policies of options that share one network (Spec D8), which chooses among the primitive ``actions``."""

    def __init__(
        self,
        weights: Mapping[str, Tensor],
        shape: tuple[int, ...],
        options: int,
        actions: NDArray[np.int64],
        views: Sequence[PolicyView] = (),
        embedding: str = AUTO,
    ):
        self.views = views
        shape = views[-1].shape if views else shape
        weights = below("online.", weights)
        make = partial(LightQNetwork, shape, options, len(actions), standard_in(weights, shape), embedding)
        custom = embedding not in (AUTO, GRID, *NETWORKS)
        self.network = load_fitting(make, weights, "options.safetensors", custom=custom)
        self.actions = actions

    def __call__(self, option: int) -> Callable[[Observations], int]:
        """Start an execution."""
        return partial(self._act, option)

    @torch.no_grad()
    def _act(self, option: int, observation: Any) -> int:
        for view in self.views:
            observation = view.see(observation[None])[0]
        values = self.network(_as_batch(observation))[0, option]
        return int(self.actions[int(values.argmax())])


class PaperPolicies:
    """Policies of options that have a network each (Spec D2, D8), which is made when it is first played."""

    def __init__(self, weights: Mapping[str, Tensor], shape: tuple[int, ...], options: int, actions: NDArray[np.int64]):
        self.weights, self.shape, self.actions = dict(weights), shape, actions
        self._networks: dict[int, PaperQNetwork] = {}

    def network(self, option: int) -> PaperQNetwork:
        """An option's network."""
        if option not in self._networks:
            make, weights = partial(PaperQNetwork, self.shape, len(self.actions)), below(f"{option}.", self.weights)
            self._networks[option] = load_fitting(make, weights, "options.safetensors").eval()
        return self._networks[option]

    def __call__(self, option: int) -> Callable[[Observations], int]:
        """Start an execution."""
        return _Execution(self.network(option), self.actions)

    def __getstate__(self) -> dict[str, Any]:
        """Without the networks, which are the weights again."""
        return {**self.__dict__, "_networks": {}}


class _Execution:
    """One execution of an option whose network remembers it from its first step on."""

    def __init__(self, network: PaperQNetwork, actions: NDArray[np.int64]):
        self.network, self.actions = network, actions
        self.hidden: Tensor | None = None

    @torch.no_grad()
    def __call__(self, observation: Observations) -> int:
        """The action in an observation."""
        values, self.hidden = self.network(self.network.embed(_as_batch(observation))[:, None], self.hidden)
        return int(self.actions[int(values[0, 0].argmax())])


def _as_batch(observation: Observations) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(observation[None]))
