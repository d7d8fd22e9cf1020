"""The contracts of member networks, views (what members see) and teachers (what members are told)."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch
from safetensors.torch import load
from torch import Tensor

from hypogoal.check.domains import SEEDED, collected
from hypogoal.check.verdict import Verdict, promise, verdicts
from hypogoal.core.config import Config
from hypogoal.core.seeding import rng_for, torch_generator
from hypogoal.core.tensors import stored
from hypogoal.data import Collected
from hypogoal.domains.base import Domain
from hypogoal.domains.find import load_domain
from hypogoal.hypotheses import views
from hypogoal.hypotheses.config import EnsembleConfig
from hypogoal.hypotheses.deep_lift import method_of
from hypogoal.hypotheses.ensemble import Ensemble
from hypogoal.hypotheses.networks import inputs_of
from hypogoal.hypotheses.training import train
from hypogoal.observations import PICTURE

FEW = 8  # states of a batch
SMALL: dict[str, Any] = {"members": 2, "steps": 2, "batch_size": 16, "network": "mlp"}
CLOSE = 1e-4  # probabilities this close are equal up to rounding
ANEW = "Make new layers at every call, with weights from PyTorch's generator."


def check_view(
    name: str, domain: Domain | None = None, config: Config | None = None, seed: int = 0
) -> Iterator[Verdict]:
    """Check whether a view, by its ``module:Class``, can be learned, used and stored.

    The states are those of ``domain``, by default of rooms. They are collected with ``config``, an instance of the
    domain's ``config_class`` (None: the defaults).
    """
    view = _Trained("view", name, domain or load_domain("rooms"), config, seed)
    laws = [_Trained.trains, _Trained.shows, _Trained.is_kept]
    return verdicts(laws, view)


def check_teacher(
    name: str, domain: Domain | None = None, config: Config | None = None, seed: int = 0
) -> Iterator[Verdict]:
    """Check whether a teacher, by its ``module:function``, gives scores that members can learn.

    The states are as in :func:`check_view`.
    """
    teacher = _Trained("teacher", name, domain or load_domain("rooms"), config, seed)
    return verdicts([_Trained.trains], teacher)


@dataclass
class _Trained:
    """A view or a teacher by its setting and name, and where states are collected.

    Only the first sub-goal of the states counts.
    """

    setting: str
    name: str
    domain: Domain
    config: Config | None
    seed: int

    @cached_property
    def states(self) -> Collected:
        """States of the domain, with labels and without."""
        return collected(self.domain, self.config, self.seed)

    def trains(self) -> str:
        """Members can be trained, and are the same when trained again with the same seed."""
        ensemble = self.ensemble()
        again = self.ensemble().state_dict()
        for name, values in ensemble.state_dict().items():
            is_same = torch.equal(values, again[name])
            promise(is_same, f"{name} differs when trained again", SEEDED)
        return f"members see {ensemble.view.dtype} {ensemble.view.shape}"

    def shows(self) -> None:
        """A state alone is shown as among others, and as in a batch that is not changed."""
        view = self.ensemble().view
        few = self.states.labelled.observations[:FEW]
        seen = view.see(few)
        alone = [view.see(few[number : number + 1]) for number in range(FEW)]
        is_same = np.array_equal(seen, np.concatenate(alone))
        promise(is_same, "a state alone and among others differ", "Look at each state alone.")
        batch = view.to_change(few)
        plain = views.changed_by(view, batch, None)
        is_plain = np.array_equal(seen, plain)
        promise(is_plain, "without a generator a batch is not what members see", "Change nothing without one.")

    def is_kept(self) -> None:
        """What the view learned is in its parameters and buffers."""
        view = self.ensemble().view
        observations = self.states.labelled.observations
        fresh = views.view_of(self.name, (), observations.shape[1:], observations.dtype)
        fresh.load_state_dict(view.state_dict())
        seen = view.see(observations)
        is_same = np.array_equal(fresh.see(observations), seen)
        promise(is_same, "what it learned is not loaded", "Keep it in parameters or buffers.")

    def ensemble(self) -> Ensemble:
        """Return a newly trained ensemble."""
        labelled, unlabelled = self.states.labelled, self.states.unlabelled
        settings = SMALL | {self.setting: self.name}
        return train(
            labelled.observations,
            labelled.labels[:, 0],
            unlabelled.observations,
            EnsembleConfig(**settings),
            self.seed,
            origins=views.StateOrigins(labelled.origins, unlabelled.origins),
        )


def check_network(
    name: str, observation_shape: tuple[int, ...] = (64, 64, 3), observation_dtype: np.dtype[Any] = PICTURE
) -> Iterator[Verdict]:
    """Check whether a member network, by its ``--set network`` name, can be trained, stored, used and explained."""
    values = rng_for(0, "check").integers(256, size=(FEW, *observation_shape))
    laws = [_Network.logits, _Network.members, _Network.gradients, _Network.answers, _Network.is_kept]
    return verdicts(laws, _Network(name, values.astype(observation_dtype)))


@dataclass
class _Network:
    name: str
    states: Any  # observations (N, *obs)

    def ensemble(self, seed: int = 0) -> Ensemble:
        view = views.view_of(views.FULL, (), self.states.shape[1:], self.states.dtype)
        view.fit(self.states, self.states, views.StateOrigins(), 0)
        return Ensemble(self.name, view.shape, 2, torch_generator(seed, "check"), view)

    def inputs(self, ensemble: Ensemble) -> Tensor:
        return inputs_of(ensemble.see(self.states))

    def logits(self) -> str:
        """A member gives two logits for each state."""
        ensemble = self.ensemble()
        member, _ = ensemble.members
        shape = tuple(member(self.inputs(ensemble)).shape)
        promise(
            shape == (FEW, 2),
            f"logits are {shape}",
            "Leave the last layer to hypogoal.",
        )
        return f"{shape}, explained by {method_of(member)}"

    def members(self) -> None:
        """The members' weights come from the seed."""
        first, second = self.ensemble(), self.ensemble()
        for weights, others in zip(first.parameters(), second.parameters(), strict=True):
            is_same = torch.equal(weights, others)
            promise(is_same, "two ensembles of one seed differ", ANEW)

    def gradients(self) -> None:
        """Every weight that is not frozen gets a gradient."""
        ensemble = self.ensemble()
        member, _ = ensemble.members
        logits = member(self.inputs(ensemble))
        logits.square().sum().backward()
        for name, weight in member.named_parameters():
            learns = weight.grad is not None and weight.grad.any()
            fault = f"weight {name} gets no gradient"
            promise(learns or not weight.requires_grad, fault, "Is it used, not detached?")

    def answers(self) -> None:
        """A state alone and among others, which is different code, has the same probabilities."""
        ensemble = self.ensemble()
        many = ensemble.predict(np.concatenate([self.states] * 40))
        alone = ensemble.predict(self.states[:1])
        worst = np.abs(many[:1] - alone).max()
        promise(np.isfinite(worst), "probabilities are not finite", "Look for NaN or Inf among its features.")
        fault = f"probabilities alone and among others differ by {worst:.2g}"
        promise(worst < CLOSE, fault, "Use layers that act on each state alone, and neither count nor draw.")

    def is_kept(self) -> None:
        """Members that are stored, and loaded into fresh members, say the same."""
        ensemble, fresh = self.ensemble(), self.ensemble(seed=1)
        kept = stored(ensemble.state_dict(), self.name)
        fresh.load_state_dict(load(kept))
        is_same = np.array_equal(fresh.predict(self.states), ensemble.predict(self.states))
        promise(is_same, "loaded members say something else", "Keep all that they are in parameters or buffers.")
