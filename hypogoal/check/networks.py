"""The contract of a member network (Spec C5; see ``hypogoal.hypotheses.networks``)."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from hypogoal.check.verdict import Verdict, promise, verdicts
from hypogoal.core.seeding import rng_for, torch_generator
from hypogoal.hypotheses.deep_lift import method_of
from hypogoal.hypotheses.ensemble import Ensemble
from hypogoal.hypotheses.networks import as_input, as_tensor
from hypogoal.hypotheses.views import full_view
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
        view = full_view(self.states, self.states)
        return Ensemble(self.name, view.shape, 2, torch_generator(0, "check"), view)

    def inputs(self, ensemble: Ensemble) -> Tensor:
        return as_input(as_tensor(ensemble.see(self.states)), self.states.dtype)

    def logits(self) -> str:
        """Members get the same tensor, one after the other."""
        ensemble = self.ensemble()
        member = ensemble.members[0]
        inputs, same = self.inputs(ensemble), self.inputs(ensemble)
        shape = tuple(member(inputs).shape)
        promise(
            shape == (COUNT, 2),
            f"logits are {shape}",
            "Leave the last layer to hypogoal.",
        )
        promise(
            torch.equal(inputs, same),
            "the network changes its input",
            "Have it change a copy.",
        )
        return f"{shape}, explained by {method_of(member)}"

    def members(self) -> None:
        """They share nothing, and their weights come from the seed."""
        ensemble, again = self.ensemble(), self.ensemble()
        shared = set.intersection(*map(_parts, ensemble.members))
        promise(
            not shared,
            "two members share modules or weights",
            ANEW,
        )
        for weights, others in zip(ensemble.parameters(), again.parameters(), strict=True):
            promise(
                torch.equal(weights, others),
                "two ensembles of one seed differ",
                ANEW,
            )

    def gradients(self) -> None:
        """Every weight that is not frozen learns."""
        ensemble = self.ensemble()
        member = ensemble.members[0]
        member(self.inputs(ensemble)).square().sum().backward()
        for name, weight in member.named_parameters():
            learns = weight.grad is not None and weight.grad.any()
            promise(
                learns or not weight.requires_grad,
                f"weight {name} gets no gradient",
                "Is it used, not detached?",
            )

    def answers(self) -> None:
        """The same for a state alone and among others, which is different code, and after safetensors."""
        ensemble = self.ensemble()
        many = ensemble.predict(np.concatenate([self.states] * 40))[:1]
        alone = ensemble.predict(self.states[:1])
        worst = np.abs(many - alone).max()
        fault = f"probabilities alone and among others differ by {worst:.2g}"
        promise(
            worst < CLOSE,
            fault,
            "Use layers that act on each state alone.",
        )
        view = ensemble.view
        again = Ensemble.from_state(self.name, view.shape, 2, ensemble.state(), view)
        same = np.array_equal(alone, again.predict(self.states[:1]))
        promise(
            same,
            "a stored network gives other answers",
            "Keep all state in parameters and buffers.",
        )


def _parts(network: nn.Module) -> set[int]:
    """The modules, weights and buffers of a network, by identity."""
    return {id(part) for part in (*network.modules(), *network.parameters(), *network.buffers())}
