"""The training of one sub-goal's ensemble: from states to trained members with thresholds, resumable.

:mod:`hypogoal.hypotheses.fit` has the loop and its words.
"""

from collections.abc import Iterator
from itertools import islice
from typing import Any

import numpy as np
import torch
from torch import nn

from hypogoal.core import seeding
from hypogoal.core.adam import Adam
from hypogoal.core.arrays import Bools, Floats
from hypogoal.core.checkpoints import Resumable, State
from hypogoal.core.errors import NumericalError, UserError
from hypogoal.core.tensors import stored
from hypogoal.hypotheses import thresholds, views
from hypogoal.hypotheses.batches import TrainingStates
from hypogoal.hypotheses.config import EnsembleConfig
from hypogoal.hypotheses.ensemble import Ensemble
from hypogoal.hypotheses.fit import Losses, fit, objective_of
from hypogoal.hypotheses.teacher import taught_by
from hypogoal.observations import Observations

CHECKED_EVERY = 10  # steps between checks for NaN, and between lines of a log


def require_unlabelled(unlabelled: Observations) -> None:
    """Refuse (``UserError``) to make members differ where there are no unlabelled states."""
    if not len(unlabelled):
        do = "Give some, or set diversity=none, threshold=0.5 and no teacher."
        raise UserError("unlabelled states are needed to make members differ", None, do)


class EnsembleTraining(Resumable):
    """One sub-goal's members in training: all at once, or one after the other (``schedule=sequential``).

    On one CPU in one thread the same arguments give the same bytes. Where a network of the user's own draws from
    PyTorch's global generator, so does :meth:`steps`, which gives it back as it was.

    Args:
        observations: the labelled states (N, *obs).
        labels: whether the sub-goal holds there (N,).
        unlabelled: (M, *obs); may be empty if nothing makes members differ.
        config: the settings.
        seed: of weights, batches, and whatever else is random.
        origins: the states' origins, for a view that needs them.
        device: where to train; the ensemble stays there.
        first: the weights of the first member of a sequential ensemble, which is trained already.
        saved: a ``snapshot`` of the same training, to go on from.

    Attributes:
        ensemble: the members, at any time to predict with; once all steps are done, in evaluation mode.

    Raises:
        UserError: labels of one class only, or no unlabelled states although members or thresholds need them.
    """

    CHANGING = ("number", "done", "ensemble", "optimiser", "states", "taught")

    def __init__(
        self,
        observations: Observations,
        labels: Bools,
        unlabelled: Observations,
        config: EnsembleConfig,
        seed: int,
        *,
        origins: views.StateOrigins | None = None,
        device: torch.device | str = "cpu",
        first: State | None = None,
        saved: State | None = None,
    ):
        if objective_of(config) or config.teacher or config.threshold == thresholds.SPLIT:
            require_unlabelled(unlabelled)
        origins = origins or views.StateOrigins()
        self.config, self.seed = config, seed
        self.observations, self.labels, self.unlabelled = observations, labels, unlabelled
        shape = observations.shape[1:]
        view = views.view_of(config.view, config.view_settings, shape, observations.dtype)
        if saved is None:
            views.learn_from(view, observations, unlabelled, origins, seed)
        weights = seeding.torch_generator(seed, "weights")
        self.ensemble = Ensemble(config.network, shape, config.members, weights, view).to(device)
        stored(self.ensemble.state_dict(), "the network")  # what cannot be is not worth training
        if first:
            self.ensemble.networks[0].load_state_dict(first)
        self.taught = None
        if saved:
            self.ensemble.load_state_dict(saved["ensemble"])  # with what the view has learned
        elif config.teacher:
            drawn = seeding.seed_for(seed, "proposals")
            self.taught = taught_by(config.teacher, observations, labels, unlabelled, config.members, drawn)
        self.states = TrainingStates(observations, labels, unlabelled, self.ensemble, origins.labelled)
        members = list(range(config.members))
        self.rounds = [[member] for member in members] if config.schedule == "sequential" else [members]
        self._begin(saved["number"] if saved else int(bool(first)))
        self._layers = None
        if saved:
            super().restore(saved)
            self._layers = saved["layers"]

    def snapshot(self) -> State:
        """All that the next steps depend on."""
        return super().snapshot() | {"layers": torch.get_rng_state()}

    def steps(self) -> Iterator[tuple[int, Losses]]:
        """Take the steps that are left, then set thresholds; yields each step's number and losses.

        ``NumericalError``: a loss is NaN or Inf; the message names the member and the step.
        """
        device = self.states.device
        devices = [device] if device.type == "cuda" else []
        with torch.random.fork_rng(devices=devices):  # Dropout and similar layers draw there
            yield from self._round()
            while self.number + 1 < len(self.rounds):
                self._begin(self.number + 1)
                yield from self._round()
        self.ensemble.eval()
        if self.config.threshold != thresholds.PAPER:
            on_labelled = self.ensemble.predict(self.observations)
            on_unlabelled = self.ensemble.predict(self.unlabelled)
            chosen = thresholds.thresholds(self.config.threshold, on_labelled, self.labels, on_unlabelled)
            self.ensemble.thresholds.copy_(torch.from_numpy(chosen))

    def predict(self, observations: Observations) -> Floats:
        """The probabilities (N, k) of the k members that are trained, or being trained, see :class:`Ensemble`."""
        *_, last = self.rounds[self.number]
        return self.ensemble.predict(observations)[:, : last + 1]

    def _begin(self, number: int) -> None:
        """Begin to train the members of one round."""
        self.number, self.done = number, 0
        self.networks = [self.ensemble.networks[member].train() for member in self.rounds[number]]
        self._round_seed = seeding.seed_for(self.seed, "batches", number)
        self.states.begin(self._round_seed)
        weights = nn.ModuleList(self.networks).parameters()
        self.optimiser = Adam(weights, self.config.learning_rate, weight_decay=self.config.l2_weight)

    def _round(self) -> Iterator[tuple[int, Losses]]:
        """Train the members of the round that has begun."""
        config, members, device = self.config, self.rounds[self.number], self.states.device
        torch.manual_seed(seeding.seed_for(self._round_seed, "layers"))
        if self._layers is not None:
            torch.set_rng_state(self._layers)
            self._layers = None
        earlier = self.ensemble.networks[: members[0]]
        taught = None if self.taught is None else self.taught[members].to(device)
        batches = islice(self.states.batches(config, self._round_seed), self.done, None)
        unchecked = []
        for losses in fit(self.networks, earlier, self.states, batches, self.optimiser, config, taught):
            self.done += 1
            unchecked.append(losses)
            if self.due:
                self._require_finite(unchecked)
                unchecked.clear()
            yield self.step, losses

    @property
    def due(self) -> bool:
        """Whether losses are due to be checked and logged: every some steps, since each makes a GPU wait."""
        return self.done % CHECKED_EVERY == 0 or self.done == self.config.steps

    @property
    def step(self) -> int:
        """How many steps are done, of all rounds."""
        return self.number * self.config.steps + self.done

    def _require_finite(self, last: list[Losses]) -> None:
        for step, losses in enumerate(last, start=self.step - len(last) + 1):
            for member, value in zip(self.rounds[self.number], losses.labelled.cpu().tolist(), strict=True):
                if not np.isfinite(value):
                    raise NumericalError(f"the labelled loss of member {member} is {value} at step {step}")
            if not losses.loss.isfinite():
                raise NumericalError(f"the diversity loss is {losses.disagreement.item()} at step {step}")


def train(*arguments: Any, **more: Any) -> Ensemble:
    """The ensemble of a :class:`EnsembleTraining` with these arguments."""
    training = EnsembleTraining(*arguments, **more)
    for _ in training.steps():
        pass
    return training.ensemble
