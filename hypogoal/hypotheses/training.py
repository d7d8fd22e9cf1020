"""Training an ensemble: agree on labelled states, disagree on unlabelled ones (Eq. (1), Spec C2-C4)."""

from __future__ import annotations

from collections.abc import Callable, Container, Iterator, Mapping, Sequence
from functools import partial
from itertools import islice
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from hypogoal.core.checkpoints import Checkpoints, Resumable, State
from hypogoal.core.errors import NumericalError, UserError
from hypogoal.core.seeding import global_state, restore_global, rng_for, seed_for, torch_generator
from hypogoal.diversity import Context, load_objective
from hypogoal.hypotheses.batches import TrainingStates
from hypogoal.hypotheses.config import EnsembleConfig
from hypogoal.hypotheses.ensemble import Ensemble
from hypogoal.hypotheses.teacher import taught_by
from hypogoal.hypotheses.thresholds import PAPER, SPLIT, thresholds
from hypogoal.hypotheses.views import StateOrigins, view_of
from hypogoal.observations import Observations

OnStep = Callable[[int, dict[str, float]], None]
Look = Callable[[int, Ensemble], None]
REPORT_EVERY = 10  # steps between reports and between checks for NaN: each makes a GPU wait


class Watcher(Resumable):
    """Follows a training; a subclass with ``CHANGING`` is saved in the training's checkpoints.

    Args:
        on_step: called every ``REPORT_EVERY`` steps and at the last one (of each member, where sequential) with the
            number of steps done and with that step's ``loss``, ``labelled`` (mean over the members in training) and
            ``diversity`` (the inner sums of Eq. (1), before their weight).
        look, look_at: after these steps of the members' training, ``look`` gets their number and the ensemble, to
            predict with; the training goes on as if it had not.
    """

    def __init__(self, on_step: OnStep | None = None, look: Look | None = None, look_at: Container[int] = ()):
        self._on_step, self._look, self._look_at = on_step, look, look_at

    def report(self, step: int, losses: dict[str, float]) -> None:
        """Take in a step's losses."""
        if self._on_step:
            self._on_step(step, losses)

    def look(self, step: int, ensemble: Ensemble) -> None:
        """Look at the ensemble after a step, if it is one to look at."""
        if self._look and step in self._look_at:
            self._look(step, ensemble)


def fit(
    observations: Observations,
    labels: NDArray[np.bool_],
    unlabelled: Observations,
    config: EnsembleConfig,
    seed: int,
    watcher: Watcher | None = None,
    *,
    origins: StateOrigins | None = None,
    device: torch.device | str = "cpu",
    checkpoints: Checkpoints | None = None,
) -> Ensemble:
    """Eq. (1): the trained members of one sub-goal. On one CPU in one thread the same arguments give the same bytes.

    Args:
        observations, labels: the labelled states (N, *obs), and whether the sub-goal holds (N,).
        unlabelled: (M, *obs); may be empty if nothing makes members differ.
        watcher: gets the losses and the ensemble during training.
        origins: the states' origins, for a view that needs them.
        device: where to train; the ensemble stays there, in evaluation mode.
        checkpoints: spec G1.

    Raises:
        UserError: labels of one class only, or no unlabelled states although members or thresholds need them.
        NumericalError: Spec G3, a loss or weight is NaN or Inf; the message names the member and the step.
    """
    if len(unlabelled) == 0 and (_diverse(config) or config.teacher):
        do = "Give some, or set diversity=none and no teacher."
        raise UserError("unlabelled states are needed to make members differ", None, do)
    if len(unlabelled) == 0 and config.threshold == SPLIT:
        do = "Give some, or set threshold=0.5."
        raise UserError("unlabelled states are needed to set thresholds on", None, do)
    checkpoints = checkpoints or Checkpoints(None)
    saved, watcher = checkpoints.load(), watcher or Watcher()
    origins = origins or StateOrigins()
    view = view_of(observations, unlabelled, config, origins, seed, fitted=saved is None)
    generator = torch_generator(seed, "weights")
    ensemble = Ensemble(config.network, observations.shape[1:], config.members, generator, view).to(device)
    rounds = [[m] for m in range(config.members)] if config.schedule == "sequential" else [[*range(config.members)]]

    def state(number: int, part: Round | None) -> State:
        return {
            "taught": taught,
            "round": number,
            "part": part.snapshot() if part else {},
            "ensemble": ensemble.state_dict(),
            "watcher": watcher.snapshot(),
        }

    taught: Tensor | None = None
    if saved is not None:
        ensemble.load_state_dict(saved["ensemble"])
        watcher.restore(saved["watcher"])
        taught = saved["taught"]
    elif config.teacher:
        drawn = seed_for(seed, "proposals")
        taught = taught_by(config.teacher, observations, labels, unlabelled, config.members, drawn)
    networks = ensemble.networks
    mixed = bool(view.dtype.names)  # standardised in each batch: a view of all states would copy their pictures
    states = TrainingStates(
        observations if mixed else view.to_change(observations),
        labels,
        unlabelled if mixed else view.to_change(unlabelled),
        networks[0],
        torch.device(device),
        view=view,
        origins=origins.labelled,
    )
    first = saved["round"] if saved else 0
    forked = [states.device] if states.device.type == "cuda" else []
    with checkpoints, torch.random.fork_rng(devices=forked):  # Dropout and similar layers draw there
        for number, members in enumerate(rounds[first:], start=first):
            before = number * config.steps
            part = Round(networks, members, states, config, seed_for(seed, "batches", number), before, taught)
            if saved and number == first:
                part.restore(saved["part"])
            for step in part.steps(watcher.report):
                watcher.look(step, ensemble)
                checkpoints.offer(partial(state, number, part))
    ensemble.eval()
    if config.threshold != PAPER:
        on_labelled, on_unlabelled = ensemble.predict(observations), ensemble.predict(unlabelled)
        ensemble.set_thresholds(thresholds(config.threshold, on_labelled, labels, on_unlabelled))
    checkpoints.save(state(len(rounds), None))
    return ensemble


def _diverse(config: EnsembleConfig) -> bool:
    """Whether the diversity loss has an effect."""
    return config.diversity_weight > 0 and load_objective(config.diversity).acts(config.members)


class Round(Resumable):
    """The training of ``members`` against each other and against the frozen members before them.

    ``taught``, if any, are a teacher's scores (K, M) of the unlabelled states, one row for each network: positive
    predictions above 0, which weigh as much as a label from 1 on, in proportion below.
    Checks every ``REPORT_EVERY`` steps for a loss, and at the end for a weight, that is NaN or Inf.
    """

    CHANGING = ("optimiser", "changes", "done", "losses")

    def __init__(
        self,
        networks: Sequence[nn.Sequential],
        members: Sequence[int],
        states: TrainingStates,
        config: EnsembleConfig,
        seed: int,
        steps_before: int,
        taught: Tensor | None = None,
    ):
        self.members, self.states, self.config, self.seed, self.before = members, states, config, seed, steps_before
        self.networks = [networks[member].train() for member in members]
        self.objective = load_objective(config.diversity) if _diverse(config) else None
        self.frozen = states.unlabelled_logits(networks[: members[0]] if self.objective else [])
        self.taught = None if taught is None else taught[list(members)].to(states.device)
        weights = [config.class_weight_negative, config.class_weight_positive]
        self.class_weights = torch.tensor(weights, dtype=torch.float32, device=states.device)
        self.optimiser = torch.optim.Adam(
            [weight for network in self.networks for weight in network.parameters()],
            lr=config.learning_rate,
            weight_decay=config.l2_weight,
            fused=True,
        )
        # Two generators, since methods differ in their use of the second.
        self.changes = [rng_for(seed, "changes", group) for group in ("labelled", "unlabelled")]
        torch.manual_seed(seed_for(seed, "layers"))
        self.done = 0
        self.losses: list[Tensor] = []  # of the steps since the last check: each member's, then those of diversity

    def snapshot(self) -> State:
        """All that the next steps depend on."""
        return {**super().snapshot(), "layers": global_state(self.states.device)}

    def restore(self, snapshot: Mapping[str, Any]) -> None:
        """Continue from a ``snapshot`` of the same training."""
        super().restore(snapshot)
        restore_global(snapshot["layers"], self.states.device)

    def steps(self, report: OnStep | None = None) -> Iterator[int]:
        """Take the steps that are left; yields their numbers."""
        config = self.config
        for labelled, unlabelled in islice(self.states.batches(config, self.seed), self.done, None):
            member_losses, diversity_losses = self._losses(labelled, unlabelled)
            loss = member_losses.sum() + config.diversity_weight * diversity_losses.sum()
            self.optimiser.zero_grad()
            loss.backward()
            self.optimiser.step()
            self.losses.append(torch.cat([member_losses, diversity_losses]).detach())
            self.done += 1
            if self.done % REPORT_EVERY == 0 or self.done == config.steps:
                self._require_finite_losses()
                if report is not None:
                    parts = {"labelled": member_losses.mean().item(), "diversity": diversity_losses.sum().item()}
                    report(self.before + self.done, {"loss": loss.item(), **parts})
            yield self.before + self.done
        for member, network in zip(self.members, self.networks, strict=True):
            if not all(bool(value.isfinite().all()) for value in network.state_dict().values()):
                raise NumericalError(f"a weight of member {member} is NaN or Inf after step {self.before + self.done}")

    def _losses(self, labelled: NDArray[np.int64], unlabelled: NDArray[np.int64]) -> tuple[Tensor, Tensor]:
        """Each member's loss on labelled states and on what it is taught (K,), those of diversity (P,)."""
        states, config = self.states, self.config
        targets = states.targets(labelled)
        diversity_losses = torch.zeros(0, device=states.device)
        if self.objective is not None or self.taught is not None:
            counted = (True, config.unlabelled_bn)
            logits = states.forward(self.networks, labelled, unlabelled, counted=counted, changes=self.changes)
        else:
            logits = states.forward(self.networks, labelled, changes=self.changes[:1])
            if config.unlabelled_bn and len(unlabelled):
                states.count_in(self.networks, unlabelled, self.changes[1])
        losses = torch.stack([functional.cross_entropy(each, targets, self.class_weights) for each in logits[0]])
        numbers = torch.from_numpy(unlabelled - states.n_labelled).to(states.device)
        if self.objective is not None:
            context = Context(
                labels=targets,
                labelled=logits[0],
                unlabelled=logits[1],
                frozen=self.frozen[:, numbers],
                positives=float(states.labels.mean()),
            )
            diversity_losses = self.objective.losses(context)
        if self.taught is not None:
            scores = self.taught[:, numbers]  # (K, N)
            errors = functional.cross_entropy(logits[1].mT, (scores > 0).long(), reduction="none")
            losses = losses + (errors * scores.abs().clamp(max=1.0)).mean(1)
        return losses, diversity_losses

    def _require_finite_losses(self) -> None:
        device = self.losses[-1].device  # losses from a checkpoint are on the CPU
        losses = torch.stack([row.to(device) for row in self.losses]).cpu()
        self.losses.clear()
        for row, column in (~losses.isfinite()).nonzero().tolist():
            step = self.before + self.done - len(losses) + row + 1
            names = [f"the labelled loss of member {member}" for member in self.members]
            names += self.objective.terms(self.members, self.members[0]) if self.objective else []
            raise NumericalError(f"{names[column]} is {losses[row, column].item()} at step {step}")
