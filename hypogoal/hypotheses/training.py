"""The training of one sub-goal's ensemble: from states to trained members with thresholds. It can be resumed.

:mod:`hypogoal.hypotheses.fit` has the loop over batches, and defines its words.
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

CHECKED_EVERY = 10  # the number of steps between checks for NaN, and between lines of a log


def require_unlabelled(unlabelled: Observations) -> None:
    """Raise ``UserError`` if there are no unlabelled states, without which members cannot be made to differ."""
    if not len(unlabelled):
        do = "Give some, or set diversity=none, threshold=0.5 and no teacher."
        raise UserError("unlabelled states are needed to make members differ", None, do)


class EnsembleTraining(Resumable):
    """The training of one sub-goal's members: all at once, or one after the other (``schedule=sequential``).

    On one CPU in one thread, equal arguments give equal bytes. If a user's network draws from PyTorch's global
    generator, :meth:`steps` draws from it, too, and then restores the generator's state.

    Args:
        observations: the labelled states (N, *obs).
        labels: whether the sub-goal holds in the labelled states, bool (N,).
        unlabelled: the unlabelled states (M, *obs). M may be 0 if nothing makes members differ.
        config: the settings.
        seed: the seed of weights, of batches, and of whatever else is random.
        origins: the states' origins, for a view that needs them.
        device: the device on which the ensemble is trained, and stays.
        first: the weights of the first member of a sequential ensemble, if that member is trained already.
        saved: a ``snapshot`` of the same training, from which to go on.

    Attributes:
        ensemble: the members, which can predict at any time. Once all steps are done, they are in evaluation mode.

    Raises:
        UserError: if all labels are of one class, or if there are no unlabelled states although members or thresholds
            need them.
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
        stored(self.ensemble.state_dict(), "the network")  # a network that cannot be stored is not worth training
        if first:
            self.ensemble.networks[0].load_state_dict(first)
        self.taught = None
        if saved:
            self.ensemble.load_state_dict(saved["ensemble"])  # includes what the view has learned
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
        """Return all that the next steps depend on."""
        return super().snapshot() | {"layers": torch.get_rng_state()}

    def steps(self) -> Iterator[tuple[int, Losses]]:
        """Take the steps that are left, then set thresholds. Yield the number and the losses of each step.

        Raises ``NumericalError`` if a loss is NaN or Inf. The message names the member and the step.
        """
        device = self.states.device
        devices = [device] if device.type == "cuda" else []
        with torch.random.fork_rng(devices=devices):  # Dropout and similar layers draw from the global generator
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
        """Return the probabilities (N, k) of the k members that are trained or in training, see :class:`Ensemble`."""
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
        """Train the members of the round that has begun, and yield the number and the losses of each step."""
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
        """Whether losses are due to be checked and logged: only every few steps, since each check makes a GPU wait."""
        return self.done % CHECKED_EVERY == 0 or self.done == self.config.steps

    @property
    def step(self) -> int:
        """The number of steps done, over all rounds."""
        return self.number * self.config.steps + self.done

    def _require_finite(self, last: list[Losses]) -> None:
        for step, losses in enumerate(last, start=self.step - len(last) + 1):
            for member, value in zip(self.rounds[self.number], losses.labelled.cpu().tolist(), strict=True):
                if not np.isfinite(value):
                    raise NumericalError(f"the labelled loss of member {member} is {value} at step {step}")
            if not losses.loss.isfinite():
                raise NumericalError(f"the diversity loss is {losses.disagreement.item()} at step {step}")


def train(*arguments: Any, **more: Any) -> Ensemble:
    """Train an ensemble to the end, and return it. The arguments are those of :class:`EnsembleTraining`."""
    training = EnsembleTraining(*arguments, **more)
    for _ in training.steps():
        pass
    return training.ensemble
