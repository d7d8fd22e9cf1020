"""The contracts of views and teachers: what members see, and what they are told of unlabelled states."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch

from hypogoal.check.domains import SEEDED
from hypogoal.check.verdict import Verdict, promise, verdicts
from hypogoal.core.config import resolve
from hypogoal.core.progress import Progress
from hypogoal.data import Collected
from hypogoal.domains.base import Domain, load_domain
from hypogoal.hypotheses.config import EnsembleConfig
from hypogoal.hypotheses.ensemble import Ensemble
from hypogoal.hypotheses.training import train
from hypogoal.hypotheses.views import StateOrigins, changed_by, own_view

FEW = 8  # states
SMALL: dict[str, Any] = {"members": 2, "steps": 2, "batch_size": 16, "network": "mlp"}


def check_view(name: str, domain: Domain | None = None, config: Any = None, seed: int = 0) -> Iterator[Verdict]:
    """Whether a view, by its ``module:Class``, can be learned, used and stored on states of a domain, or of rooms.

    They are collected with ``config``, an instance of the domain's ``config_class`` (None: the defaults).
    """
    laws = [_Trained.trains, _Trained.shows, _Trained.is_kept]
    return verdicts(laws, _Trained({"view": name}, domain or load_domain("rooms"), config, seed))


def check_teacher(name: str, domain: Domain | None = None, config: Any = None, seed: int = 0) -> Iterator[Verdict]:
    """Whether a teacher, by its ``module:function``, gives scores that members can learn; as :func:`check_view`."""
    return verdicts([_Trained.trains], _Trained({"teacher": name}, domain or load_domain("rooms"), config, seed))


@dataclass
class _Trained:
    """Settings with a view or a teacher, and where states are collected, whose first sub-goal counts."""

    settings: dict[str, Any]
    domain: Domain
    config: Any
    seed: int

    @cached_property
    def states(self) -> Collected:
        """Some, with labels and without."""
        config = self.config or resolve(self.domain.config_class, stage="collect")
        return self.domain.collect(config, self.seed, Progress("check", total=1, quiet=True))

    def trains(self) -> str:
        """Members can be trained, the same from the same seed."""
        ensemble, again = self.ensemble(), self.ensemble().state_dict()
        for name, values in ensemble.state_dict().items():
            promise(torch.equal(values, again[name]), f"{name} differs when trained again", SEEDED)
        return f"members see {ensemble.view.dtype} {ensemble.view.shape}"

    def shows(self) -> None:
        """Of a state alone the same as of it among others, and as of a batch that is not changed."""
        view, few = self.ensemble().view, self.states.labelled.observations[:FEW]
        seen = view.see(few)
        alone = np.concatenate([view.see(few[number : number + 1]) for number in range(FEW)])
        promise(np.array_equal(seen, alone), "a state alone and among others differ", "Look at each state alone.")
        plain = changed_by(view, view.to_change(few), None)
        fault = "without a generator a batch is not what members see"
        promise(np.array_equal(seen, plain), fault, "Change nothing without one.")

    def is_kept(self) -> None:
        """What it learned is in its parameters and buffers."""
        view, observations = self.ensemble().view, self.states.labelled.observations
        fresh = own_view(self.settings["view"], (), observations.shape[1:])
        fresh.load_state_dict(view.state_dict())
        is_same = np.array_equal(fresh.see(observations), view.see(observations))
        promise(is_same, "what it learned is not loaded", "Keep it in parameters or buffers.")

    def ensemble(self) -> Ensemble:
        """A fresh one, trained."""
        labelled, unlabelled = self.states.labelled, self.states.unlabelled
        return train(
            labelled.observations,
            labelled.labels[:, 0],
            unlabelled.observations,
            EnsembleConfig(**SMALL, **self.settings),
            self.seed,
            origins=StateOrigins(labelled.origins, unlabelled.origins),
        )
