"""The contract of a member network (Spec C5; see ``hypogoal.hypotheses.networks``)."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from hypogoal.check.verdict import Verdict, promise, verdicts
from hypogoal.core.seeding import rng_for, torch_generator
from hypogoal.hypotheses.deep_lift import method_of
from hypogoal.hypotheses.ensemble import Ensemble
from hypogoal.hypotheses.networks import inputs_of
from hypogoal.hypotheses.views import FullView, StateOrigins
from hypogoal.observations import PICTURE, Observations

COUNT = 8  # states
CLOSE = 1e-4  # between probabilities that are the same up to rounding
ANEW = "Make new layers at every call, with weights from PyTorch's generator."


def check_network(
    name: str, observation_shape: tuple[int, ...] = (64, 64, 3), observation_dtype: np.dtype[Any] = PICTURE
) -> Iterator[Verdict]:
    """Whether a member network, by its ``--set network`` name, can be trained, stored, used and explained."""
    values = rng_for(0, "check").integers(256, size=(COUNT, *observation_shape))
    laws = [_Network.logits, _Network.members, _Network.gradients, _Network.answers]
    return verdicts(laws, _Network(name, values.astype(observation_dtype)))


@dataclass
class _Network:
    name: str
    states: Observations

    def ensemble(self) -> Ensemble:
        view = FullView(self.states.shape[1:], self.states.dtype)
        view.fit(self.states, self.states, StateOrigins(), 0)
        return Ensemble(self.name, view.shape, 2, torch_generator(0, "check"), view)

    def inputs(self, ensemble: Ensemble) -> Tensor:
        return inputs_of(ensemble.see(self.states))

    def logits(self) -> str:
        """Rows in are rows out, of two logits."""
        ensemble = self.ensemble()
        member, _ = ensemble.members
        shape = tuple(member(self.inputs(ensemble)).shape)
        promise(
            shape == (COUNT, 2),
            f"logits are {shape}",
            "Leave the last layer to hypogoal.",
        )
        return f"{shape}, explained by {method_of(member)}"

    def members(self) -> None:
        """Their weights come from the seed."""
        for weights, others in zip(self.ensemble().parameters(), self.ensemble().parameters(), strict=True):
            promise(torch.equal(weights, others), "two ensembles of one seed differ", ANEW)

    def gradients(self) -> None:
        """Every weight that is not frozen learns."""
        ensemble = self.ensemble()
        member, _ = ensemble.members
        member(self.inputs(ensemble)).square().sum().backward()
        for name, weight in member.named_parameters():
            learns = weight.grad is not None and weight.grad.any()
            fault = f"weight {name} gets no gradient"
            promise(learns or not weight.requires_grad, fault, "Is it used, not detached?")

    def answers(self) -> None:
        """The same for a state alone and among others, which is different code."""
        ensemble = self.ensemble()
        many = ensemble.predict(np.concatenate([self.states] * 40))
        alone = ensemble.predict(self.states[:1])
        worst = np.abs(many[:1] - alone).max()
        promise(np.isfinite(worst), "probabilities are not finite", "Look for NaN or Inf among its features.")
        fault = f"probabilities alone and among others differ by {worst:.2g}"
        promise(worst < CLOSE, fault, "Use layers that act on each state alone, and neither count nor draw.")
