"""Training an ensemble: agree on labelled states, disagree on unlabelled ones (Eq. (1), Spec C2-C4)."""

from __future__ import annotations

from collections.abc import Callable, Container, Iterator, Mapping, Sequence
from functools import partial
from itertools import islice
from typing import Any, cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from hypogoal.core.checkpoints import Checkpoints, Resumable, State, Unknown, Unlike, require_alike
from hypogoal.core.errors import NumericalError, UserError
from hypogoal.core.seeding import global_state, restore_global, rng_for, seed_for, torch_generator
from hypogoal.dataset import Observations
from hypogoal.diversity import Context, load_objective
from hypogoal.hypotheses.batches import TrainingStates
from hypogoal.hypotheses.config import EnsembleConfig
from hypogoal.hypotheses.ensemble import Ensemble
from hypogoal.hypotheses.localisers import Pixels
from hypogoal.hypotheses.thresholds import NEED_UNLABELLED, PAPER, thresholds
from hypogoal.hypotheses.views import Origins, needed, positions_of, view_of

OnStep = Callable[[int, dict[str, float]], None]
Look = Callable[[int, Ensemble], None]
REPORT_EVERY = 10  # steps between reports, and between looks for NaN: a look makes a GPU wait


def fit(
    observations: Observations,
    labels: NDArray[np.bool_],
    unlabelled: Observations,
    config: EnsembleConfig,
    seed: int,
    on_step: OnStep | None = None,
    *,
    look: Look | None = None,
    look_at: Container[int] = (),
    origins: Origins | None = None,
    unlabelled_origins: Origins | None = None,
    agent_pixels: Pixels | None = None,
    device: torch.device | str = "cpu",
    checkpoints: Checkpoints | None = None,
) -> Ensemble:
    """Eq. (1): the trained members of one sub-goal. On one CPU in one thread the same arguments give the same bytes.

    Args:
        observations, labels: the labelled states (N, *obs), and whether the sub-goal is reached (N,).
        unlabelled: (M, *obs); may be empty where nothing makes members differ.
        on_step: called every ``REPORT_EVERY`` steps and at the last one (of each member, where sequential) with the
            number of steps done and with that step's ``loss``, ``labelled`` (mean over the members in training) and
            ``diversity`` (the inner sums of Eq. (1), before their weight).
        look, look_at: after so many steps ``look`` gets their number, and the ensemble as it is then to predict with;
            training goes on as if it had not.
        origins: int64 (N,) by name, where each labelled state comes from: ``ladder`` for batch_kind=per-ladder;
            ``room``, ``x``, ``y`` (and ``dying``) for view=agent-crop.
        unlabelled_origins: int64 (M,), the same of the unlabelled states: ``room``, ``x``, ``y`` for localiser=ram,
            ``action``, ``previous_action`` for localiser=learned.
        agent_pixels: the domain's, for view=agent-crop; None where it does not know.
        device: where to train; the ensemble stays there, in evaluation mode.
        checkpoints: spec G1; an ``on_step`` that is ``Resumable`` goes on with the training that it is told of.

    Raises:
        UserError: labels of one class only, no unlabelled states though members are to differ or thresholds to be set
            on them, or data that do not say what the settings need to know of them.
        NumericalError: Spec G3, a loss or weight is NaN or Inf; the message names the member and the step.
    """
    if len(unlabelled) == 0:
        if _diverse(config):
            raise UserError(
                "unlabelled states are needed to make members differ", None, "Give some, or set diversity=none."
            )
        if config.threshold in NEED_UNLABELLED:
            raise UserError(
                "unlabelled states are needed to set thresholds on", None, "Give some, or set threshold=0.5."
            )
    if config.schedule == "sequential" and config.encoder == "shared":
        what = "members one after the other cannot share an encoder that learns"
        raise UserError(what, "encoder=shared, schedule=sequential", "Set encoder=frozen or schedule=simultaneous.")
    checkpoints = checkpoints or Checkpoints(None)
    saved, report = checkpoints.load(), cast(object, on_step)
    view = view_of(
        observations,
        unlabelled,
        config,
        seed_for(seed, "localiser"),
        origins,
        unlabelled_origins,
        agent_pixels,
        fitted=saved is None,
    )
    generator = torch_generator(seed, "weights")
    ensemble = Ensemble(
        config.network, observations.shape[1:], config.members, generator, view, config.encoder, config.hidden_width
    ).to(device)
    rounds = [[m] for m in range(config.members)] if config.schedule == "sequential" else [[*range(config.members)]]

    def state(number: int, part: Round | None) -> State:
        told = {"told": report.snapshot()} if isinstance(report, Resumable) else {}
        return {"round": number, "part": part.snapshot() if part else {}, "ensemble": ensemble.state_dict(), **told}

    if saved is not None:
        with checkpoints.restoring():
            require_alike(saved, {**state(0, None), "part": Unknown()})
            if not 0 <= saved["round"] <= len(rounds) or (saved["round"] == len(rounds) and saved["part"]):
                raise Unlike("at /round")
            ensemble.load_state_dict(saved["ensemble"])
            if isinstance(report, Resumable):
                report.restore(saved["told"])
    trunk, networks = ensemble.parts
    by_ladder = config.batch_kind == "per-ladder"
    ladders = needed(origins, ("ladder",), "batch_kind=per-ladder")["ladder"] if by_ladder else None
    states = TrainingStates(
        view.see(observations, positions_of(origins), margin=config.jitter),
        labels,
        view.see(unlabelled, positions_of(unlabelled_origins), margin=config.jitter),
        networks[0],
        torch.device(device),
        ladders=ladders,
        grey=config.augment != "none",
        context=config.augment == "grey-context",
        jitter=config.jitter,
        trunk=trunk,
        frozen=ensemble.frozen,
    )
    first = saved["round"] if saved else 0
    drawing = [states.device] if states.device.type == "cuda" else []
    with checkpoints, torch.random.fork_rng(devices=drawing):  # Dropout and the like draw there
        for number, members in enumerate(rounds[first:], start=first):
            part = Round(networks, members, states, config, seed_for(seed, "batches", number), number * config.steps)
            if saved and number == first:
                with checkpoints.restoring():
                    require_alike(saved["part"], part.snapshot(), "/part")
                    part.restore(saved["part"])
            for step in part.steps(on_step):
                if look is not None and step in look_at:
                    look(step, ensemble)
                checkpoints.offer(partial(state, number, part))
    ensemble.eval()
    if config.threshold != PAPER:
        own = ensemble.predict(observations, positions_of(origins))
        elsewhere = ensemble.predict(unlabelled, positions_of(unlabelled_origins))
        ensemble.set_thresholds(thresholds(config.threshold, own, labels, elsewhere))
    checkpoints.save(state(len(rounds), None))
    return ensemble


def _diverse(config: EnsembleConfig) -> bool:
    """Whether the diversity loss moves anything."""
    return config.diversity_weight > 0 and load_objective(config.diversity).acts(config.members)


class Round(Resumable):
    """The training of ``members`` against each other and against those before them, which are frozen.

    It stops at the first loss or weight that is NaN or Inf, looking every ``REPORT_EVERY`` steps.
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
    ):
        self.members, self.states, self.config, self.seed, self.before = members, states, config, seed, steps_before
        self.networks = [networks[member].train() for member in members]
        self.objective = load_objective(config.diversity) if _diverse(config) else None
        self.frozen = states.unlabelled_logits(networks[: members[0]] if self.objective else [])
        weights = [config.class_weight_negative, config.class_weight_positive]
        self.class_weights = torch.tensor(weights, dtype=torch.float32, device=states.device)
        self.optimiser = torch.optim.Adam(
            [*states.shared, *(weight for network in self.networks for weight in network.parameters())],
            lr=config.learning_rate,
            weight_decay=config.l2_weight,
            fused=True,
        )
        # Methods differ in the second's use.
        self.changes = [rng_for(seed, "changes", group) for group in ("labelled", "unlabelled")]
        torch.manual_seed(seed_for(seed, "layers"))
        self.done = 0
        self.losses: list[Tensor] = []  # of the steps since the last look: each member's, and those of diversity

    def items(self) -> dict[str, Any]:
        terms = self.objective.terms(self.members, self.members[0]) if self.objective else []
        return {"losses": torch.zeros(len(self.members) + len(terms))}

    def snapshot(self) -> State:
        """All that the next steps depend on."""
        return {**super().snapshot(), "layers": global_state(self.states.device)}

    def restore(self, snapshot: Mapping[str, Any]) -> None:
        """Continue from a ``snapshot`` of the same training."""
        super().restore(snapshot)
        restore_global(snapshot["layers"], self.states.device)

    def steps(self, on_step: OnStep | None) -> Iterator[int]:
        """Step after step, to the last; their numbers."""
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
                if on_step is not None:
                    parts = {"labelled": member_losses.mean().item(), "diversity": diversity_losses.sum().item()}
                    on_step(self.before + self.done, {"loss": loss.item(), **parts})
            yield self.before + self.done
        for member, network in zip(self.members, self.networks, strict=True):
            if not all(bool(value.isfinite().all()) for value in network.state_dict().values()):
                raise NumericalError(f"a weight of member {member} is NaN or Inf after step {self.before + self.done}")

    def _losses(self, labelled: NDArray[np.int64], unlabelled: NDArray[np.int64]) -> tuple[Tensor, Tensor]:
        """Each member's loss on labelled states (K,), and those of the diversity objective (P,)."""
        states, config = self.states, self.config
        targets = states.targets(labelled)
        if self.objective is not None:
            counted = (True, config.unlabelled_bn)
            seen = states.forward(self.networks, labelled, unlabelled, counted=counted, changes=self.changes)
            logits, features = ([torch.stack(group) for group in zip(*each, strict=True)] for each in seen)
            context = Context(
                labels=targets,
                labelled=logits[0],
                unlabelled=logits[1],
                labelled_features=features[0],
                unlabelled_features=features[1],
                frozen=self.frozen[:, torch.from_numpy(unlabelled - states.n_labelled).to(states.device)],
                positives=float(states.labels.mean()),
                input_gradients=partial(states.input_gradients, self.networks, labelled),
            )
            diversity_losses = self.objective.losses(context)
        else:
            seen = states.forward(self.networks, labelled, changes=self.changes[:1])
            diversity_losses = torch.zeros(0, device=states.device)
            if config.unlabelled_bn and len(unlabelled):
                states.count_in(self.networks, unlabelled, self.changes[1])
        own = [functional.cross_entropy(groups[0], targets, self.class_weights) for groups in seen.logits]
        return torch.stack(own), diversity_losses

    def _require_finite_losses(self) -> None:
        device = self.losses[-1].device  # those of a checkpoint are on the CPU
        losses = torch.stack([row.to(device) for row in self.losses]).cpu()
        self.losses.clear()
        for row, column in (~losses.isfinite()).nonzero().tolist():
            step = self.before + self.done - len(losses) + row + 1
            names = [f"the labelled loss of member {member}" for member in self.members]
            names += self.objective.terms(self.members, self.members[0]) if self.objective else []
            raise NumericalError(f"{names[column]} is {losses[row, column].item()} at step {step}")
