"""The contracts of views and teachers: what members see, and what they are told of unlabelled states."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch

from hypogoal.check.domains import SEEDED, collected
from hypogoal.check.verdict import Verdict, promise, verdicts
from hypogoal.data import Collected
from hypogoal.domains.base import Domain, load_domain
from hypogoal.hypotheses.config import EnsembleConfig
from hypogoal.hypotheses.ensemble import Ensemble
from hypogoal.hypotheses.training import train
from hypogoal.hypotheses.views import StateOrigins, changed_by, view_of

FEW = 8  # states
SMALL: dict[str, Any] = {"members": 2, "steps": 2, "batch_size": 16, "network": "mlp"}


def check_view(name: str, domain: Domain | None = None, config: Any = None, seed: int = 0) -> Iterator[Verdict]:
    """Whether a view, by its ``module:Class``, can be learned, used and stored on states of a domain, or of rooms.

    They are collected with ``config``, an instance of the domain's ``config_class`` (None: the defaults).
    """
    view = _Trained("view", name, domain or load_domain("rooms"), config, seed)
    laws = [_Trained.trains, _Trained.shows, _Trained.is_kept]
    return verdicts(laws, view)


def check_teacher(name: str, domain: Domain | None = None, config: Any = None, seed: int = 0) -> Iterator[Verdict]:
    """Whether a teacher, by its ``module:function``, gives scores that members can learn; as :func:`check_view`."""
    teacher = _Trained("teacher", name, domain or load_domain("rooms"), config, seed)
    return verdicts([_Trained.trains], teacher)


@dataclass
class _Trained:
    """A view or a teacher by its setting and name, and where states are collected, whose first sub-goal counts."""

    setting: str
    name: str
    domain: Domain
    config: Any
    seed: int

    @cached_property
    def states(self) -> Collected:
        """Some, with labels and without."""
        return collected(self.domain, self.config, self.seed)

    def trains(self) -> str:
        """Members can be trained, the same from the same seed."""
        ensemble = self.ensemble()
        again = self.ensemble().state_dict()
        for name, values in ensemble.state_dict().items():
            is_same = torch.equal(values, again[name])
            promise(is_same, f"{name} differs when trained again", SEEDED)
        return f"members see {ensemble.view.dtype} {ensemble.view.shape}"

    def shows(self) -> None:
        """Of a state alone the same as of it among others, and as of a batch that is not changed."""
        view = self.ensemble().view
        few = self.states.labelled.observations[:FEW]
        seen = view.see(few)
        alone = [view.see(few[number : number + 1]) for number in range(FEW)]
        is_same = np.array_equal(seen, np.concatenate(alone))
        promise(is_same, "a state alone and among others differ", "Look at each state alone.")
        batch = view.to_change(few)
        plain = changed_by(view, batch, None)
        is_plain = np.array_equal(seen, plain)
        promise(is_plain, "without a generator a batch is not what members see", "Change nothing without one.")

    def is_kept(self) -> None:
        """What it learned is in its parameters and buffers."""
        view = self.ensemble().view
        observations = self.states.labelled.observations
        fresh = view_of(self.name, (), observations.shape[1:], observations.dtype)
        fresh.load_state_dict(view.state_dict())
        seen = view.see(observations)
        is_same = np.array_equal(fresh.see(observations), seen)
        promise(is_same, "what it learned is not loaded", "Keep it in parameters or buffers.")

    def ensemble(self) -> Ensemble:
        """A fresh one, trained."""
        labelled, unlabelled = self.states.labelled, self.states.unlabelled
        settings: dict[str, Any] = {**SMALL, self.setting: self.name}
        return train(
            labelled.observations,
            labelled.labels[:, 0],
            unlabelled.observations,
            EnsembleConfig(**settings),
            self.seed,
            origins=StateOrigins(labelled.origins, unlabelled.origins),
        )
