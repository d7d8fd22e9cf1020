"""The contract of a member network (Spec C5; see ``hypogoal.hypotheses.networks``)."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import torch
from torch import nn

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
    laws = [_Network.logits, _Network.members, _Network.gradients, _Network.answers, _Network.storage]
    return verdicts(laws, _Network(name, values.astype(observation_dtype)))


class _Network:
    def __init__(self, name: str, states: Observations):
        self.name, self.states = name, states
        self.view = full_view(states, states)
        self.inputs = as_input(as_tensor(self.view.see(states)), states.dtype)

    def ensemble(self) -> Ensemble:
        generator = torch_generator(0, "check")
        return Ensemble(self.name, self.view.shape, 2, generator, self.view)

    def logits(self) -> str:
        """Members get the same tensor, one after the other."""
        member = self.ensemble().members[0]
        inputs = self.inputs.clone()
        shape = tuple(member(inputs).shape)
        promise(shape == (COUNT, 2), f"logits are {shape}", "Leave the last layer to hypogoal.")
        unchanged = torch.equal(inputs, self.inputs)
        promise(unchanged, "the network changes its input", "Have it change a copy.")
        return f"{shape}, explained by {method_of(member)}"

    def members(self) -> str:
        """They share nothing, and their weights come from the seed."""
        ensemble, again = self.ensemble(), self.ensemble()
        first, second = ensemble.members
        shared = _parts(first) & _parts(second)
        promise(not shared, "two members share modules or weights", ANEW)
        for weights, others in zip(ensemble.parameters(), again.parameters(), strict=True):
            same = torch.equal(weights, others)
            promise(same, "two ensembles of one seed differ", ANEW)
        return "each has its own weights, which the seed draws"

    def gradients(self) -> str:
        member = self.ensemble().members[0]
        loss = member(self.inputs).square().sum()
        loss.backward()
        for name, weight in member.named_parameters():
            learns = weight.grad is not None and bool(weight.grad.any())
            kept = learns or not weight.requires_grad
            promise(kept, f"weight {name} gets no gradient", "Is it used, not detached?")
        return "every weight that is not frozen learns"

    def answers(self) -> str:
        """One state, or many: different code, the same function."""
        ensemble = self.ensemble()
        many = ensemble.predict(np.concatenate([self.states] * 40))
        for place in range(COUNT):
            alone = ensemble.predict(self.states[place : place + 1])
            worst = np.abs(many[place] - alone).max()
            text = f"probabilities alone and among others differ by {worst:.2g}"
            promise(bool(worst < CLOSE), text, "Use layers that act on each state alone.")
        return "a state's do not depend on others"

    def storage(self) -> str:
        ensemble = self.ensemble()
        again = Ensemble.from_state(self.name, self.view.shape, 2, ensemble.state(), self.view)
        before, after = ensemble.predict(self.states), again.predict(self.states)
        same = np.array_equal(before, after)
        promise(same, "a stored network gives other answers", "Keep all state in parameters and buffers.")
        return "the same answers after safetensors"


def _parts(network: nn.Module) -> set[int]:
    """The modules, weights and buffers of a network, by identity."""
    return {id(part) for part in (*network.modules(), *network.parameters(), *network.buffers())}
