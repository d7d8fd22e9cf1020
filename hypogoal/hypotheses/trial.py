"""The measured cost of a training step: the real network trains on a few of the real states, in small batches."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn
from torch.autograd.graph import saved_tensors_hooks

from hypogoal.core.seeding import torch_generator
from hypogoal.dataset import PICTURE, Observations
from hypogoal.diversity import OBJECTIVES
from hypogoal.hypotheses.batches import TrainingStates
from hypogoal.hypotheses.config import EnsembleConfig
from hypogoal.hypotheses.ensemble import Ensemble
from hypogoal.hypotheses.training import Round
from hypogoal.hypotheses.views import FullView, cut_windows, full_view

SECONDS = 0.3  # after which no larger batch is tried
LEARNING = 3  # numbers per trained weight: its gradient and two of Adam's
BACKWARD = 2.0  # memory of the backward pass, relative to what a member keeps for it
CONVOLUTIONS = 200e6  # what PyTorch's convolutions take, and freed memory between tensors; patches have neither


class StepCost(NamedTuple):
    """Bytes and seconds of a training step: a constant part, and one for each state of a batch."""

    weights: float  # bytes of all members' weights
    memory: float
    memory_each: float
    seconds: float
    seconds_each: float


def step_cost(states: Observations, config: EnsembleConfig, seconds: float = SECONDS) -> StepCost:
    """The cost of a step on a CPU with states like these (N, *shape), N > 1, and as many unlabelled ones in a batch.

    Batches grow from two states until ``seconds`` are over; the result is a line through the first and the last.
    D-BAT replaces a user's objective, which is not called. States that the network does not take are a ``UserError``.
    """
    pictures = states.dtype == PICTURE
    cut, margin = pictures and config.view == "agent-crop", config.jitter
    if cut:  # from the middle, wherever the agent is
        size = config.crop_height + 2 * margin, config.crop_width + 2 * margin
        states = cut_windows(states, np.tile(np.divide(states.shape[1:3], 2), (len(states), 1)), *size)
    shape = (config.crop_height, config.crop_width, *states.shape[3:]) if cut else states.shape[1:]
    view = FullView(shape) if pictures else full_view(states, states)
    states = view.see(states)
    objective = config.diversity if config.diversity in OBJECTIVES else "dbat"
    trained = 1 if config.schedule == "sequential" else config.members  # at once
    sizes = [2**doublings for doublings in range(1, config.batch_size.bit_length())]
    sizes += [config.batch_size] * (sizes[-1] < config.batch_size)
    config = replace(config, diversity=objective, batch_kind="plain", steps=len(sizes) + 2)
    with torch.random.fork_rng(devices=[]):
        generator = torch_generator(0, "trial")
        ensemble = Ensemble(config.network, shape, config.members, generator, view)
        networks = ensemble.networks
        batches = TrainingStates(
            states,
            np.arange(len(states)) % 2 == 0,
            states,
            networks[0],
            torch.device("cpu"),
            grey=pictures and config.augment != "none",
            jitter=margin if cut else 0,
        )
        taught = torch.zeros(config.members, len(states)) if config.proposals == "joint" else None
        training = Round(networks, range(trained), batches, config, 0, 0, taught)
        _tried(training, sizes[0], ensemble)  # the first step allocates
        end, rows = time.process_time() + seconds, []
        for size in sizes:
            rows.append((size, *_tried(training, size, ensemble)))
            if len(rows) > 1 and time.process_time() > end:
                break
    (fewer, less, sooner), (more, most, later) = rows[0], rows[-1]
    kept_each, seconds_each = (max(0.0, rise) / max(1, more - fewer) for rise in (most - less, later - sooner))
    weights = sum(weight.nbytes for weight in ensemble.parameters())
    learning = LEARNING * sum(weight.nbytes for weight in training.optimiser.param_groups[0]["params"])
    copies = 1.0 + BACKWARD / trained
    memory = weights + learning + copies * (most - more * kept_each)
    memory += CONVOLUTIONS if batches.whole and any(isinstance(layer, nn.Conv2d) for layer in ensemble.modules()) else 0
    return StepCost(weights, memory, copies * kept_each, max(0.0, later - more * seconds_each), seconds_each)


def _tried(training: Round, batch: int, ensemble: Ensemble) -> tuple[float, float]:
    """The bytes that a step with such a batch keeps for its gradients, without weights, and its seconds."""
    kept = {weight.untyped_storage().data_ptr(): 0 for weight in ensemble.parameters()}

    def keep(tensor: Tensor) -> Tensor:
        storage = tensor.untyped_storage()
        kept.setdefault(storage.data_ptr(), storage.nbytes())
        return tensor

    training.config = replace(training.config, batch_size=batch)
    start = time.process_time()
    with saved_tensors_hooks(keep, lambda tensor: tensor):
        next(training.steps())
    return float(sum(kept.values())), time.process_time() - start
