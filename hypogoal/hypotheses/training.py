"""Training an ensemble: agree on labelled states, disagree on unlabelled ones (Eq. (1), Spec C2-C4)."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from itertools import combinations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from hypogoal.core.errors import NumericalError, UserError
from hypogoal.core.seeding import seed_for, torch_generator
from hypogoal.diversity import load_objective
from hypogoal.hypotheses.batches import TrainingStates
from hypogoal.hypotheses.config import EnsembleConfig
from hypogoal.hypotheses.ensemble import Ensemble

__all__ = ["EnsembleConfig", "fit", "total_steps"]

OnStep = Callable[[int, dict[str, float]], None]
REPORT_EVERY = 10  # steps between reports, and between looks for NaN: a look makes a GPU wait


def total_steps(config: EnsembleConfig) -> int:
    """The number of steps that ``fit`` counts to."""
    return config.steps * (config.members if config.schedule == "sequential" else 1)


def fit(
    observations: NDArray[np.uint8],
    labels: NDArray[np.bool_],
    unlabelled: NDArray[np.uint8],
    config: EnsembleConfig,
    seed: int,
    on_step: OnStep | None = None,
    *,
    device: torch.device | str = "cpu",
) -> Ensemble:
    """Eq. (1): the trained members of one sub-goal. On one CPU the same arguments give the same bytes.

    Args:
        observations: uint8 (N, H, W, C), the labelled states.
        labels: bool (N,), whether the sub-goal is reached.
        unlabelled: uint8 (M, H, W, C); may be empty where nothing makes members differ.
        config: the settings.
        seed: of the initial weights and the batches.
        on_step: called every ``REPORT_EVERY`` steps and at the last one with the number of steps done, of
            ``total_steps(config)``, and with that step's ``loss``, ``labelled`` (mean over the members in
            training) and ``diversity`` (the inner sums of Eq. (1), before their weight).
        device: where to train; the ensemble stays there.

    Returns:
        The ensemble, in evaluation mode.

    Raises:
        UserError: labels of one class only, or no unlabelled states though members are to differ.
        NumericalError: Spec G3, a loss or weight is NaN or Inf; the message names the member and the step.
    """
    ensemble = Ensemble(config.network, observations.shape[1:], config.members, torch_generator(seed, "weights"))
    ensemble.to(device)
    networks = ensemble.networks()
    states = TrainingStates(observations, labels, unlabelled, networks[0], torch.device(device))
    if _diverse(config) and len(unlabelled) == 0:
        raise UserError("unlabelled states are needed to make members differ", None, "Or set diversity=none.")
    rounds = [[m] for m in range(config.members)] if config.schedule == "sequential" else [[*range(config.members)]]
    for done, members in enumerate(rounds):
        _fit_members(networks, members, states, config, seed_for(seed, "batches", done), done * config.steps, on_step)
    return ensemble.eval()


def _diverse(config: EnsembleConfig) -> bool:
    """Whether the diversity loss moves anything."""
    return config.members > 1 and config.diversity != "none" and config.diversity_weight > 0


def _fit_members(
    networks: Sequence[nn.Sequential],
    members: Sequence[int],
    states: TrainingStates,
    config: EnsembleConfig,
    seed: int,
    steps_before: int,
    on_step: OnStep | None,
) -> None:
    """Train ``members`` against each other and against those before them, which are frozen."""
    trained = [networks[member].train() for member in members]
    diverse = _diverse(config)
    frozen = states.unlabelled_logits(networks[: members[0]]) if diverse else []
    objective = load_objective(config.diversity)
    class_weights = torch.tensor(
        [config.class_weight_negative, config.class_weight_positive],
        dtype=torch.float32,
        device=states.device,
    )
    optimiser = torch.optim.Adam(
        [weight for network in trained for weight in network.parameters()],
        lr=config.learning_rate,
        weight_decay=config.l2_weight,
        fused=True,
    )
    watch = _Watch(members, len(frozen) if diverse else 0, config, steps_before, on_step)
    for labelled, unlabelled in states.batches(config, seed):
        targets = states.targets(labelled)
        label_losses = torch.stack(
            [
                nn.functional.cross_entropy(logits, targets, class_weights)
                for logits in states.forward(trained, labelled)
            ]
        )
        pair_losses = label_losses.new_zeros(0)
        if diverse or (config.unlabelled_bn and len(unlabelled)):
            with torch.set_grad_enabled(diverse), _running_statistics(trained, config.unlabelled_bn):
                logits = states.forward(trained, unlabelled)
            if diverse:
                rows = torch.from_numpy(unlabelled - states.n_labelled).to(states.device)
                pair_losses = _pair_losses(objective, logits, [other[rows] for other in frozen])
        loss = label_losses.sum() + config.diversity_weight * pair_losses.sum()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        watch.step(loss.detach(), label_losses.detach(), pair_losses.detach())
    watch.weights(trained)


def _pair_losses(
    objective: Callable[[Tensor, Tensor], Tensor], logits: Sequence[Tensor], frozen: Sequence[Tensor]
) -> Tensor:
    """Eq. (1), the inner sums: a loss (P,) for each pair, first of those in training, then with the frozen.

    The double sum meets each pair in training in both orders: a factor of 2. Its i = m is left out:
    disagreement with itself would push every member to p = 1/2.
    """
    losses = [2.0 * objective(one, other) for one, other in combinations(logits, 2)]
    losses += [objective(old, one) for one in logits for old in frozen]
    return torch.stack(losses) if losses else torch.zeros(0, device=logits[0].device)


@contextmanager
def _running_statistics(networks: Sequence[nn.Sequential], update: bool) -> Iterator[None]:
    """Inside, BatchNorm still normalises by the batch, but its running statistics move only if ``update``."""
    norms = [layer for network in networks for layer in network if isinstance(layer, nn.BatchNorm2d)]
    momenta = [norm.momentum for norm in norms]
    try:
        if not update:
            for norm in norms:
                norm.momentum = 0.0
        yield
    finally:
        for norm, momentum in zip(norms, momenta, strict=True):
            norm.momentum = momentum


class _Watch:
    """Reports the losses and stops at the first that is NaN or Inf, looking every ``REPORT_EVERY`` steps."""

    def __init__(
        self,
        members: Sequence[int],
        frozen: int,
        config: EnsembleConfig,
        steps_before: int,
        on_step: OnStep | None,
    ):
        self._names = [f"the labelled loss of member {member}" for member in members]
        if _diverse(config):
            pairs = [
                *combinations(members, 2),
                *((old, member) for member in members for old in range(frozen)),
            ]
            self._names += [f"the diversity loss of members {one} and {other}" for one, other in pairs]
        self._members, self._config = members, config
        self._before, self._on_step = steps_before, on_step
        self._rows: list[Tensor] = []
        self._done = 0

    def step(self, loss: Tensor, label_losses: Tensor, pair_losses: Tensor) -> None:
        """One more step is done, with these losses."""
        self._rows.append(torch.cat([label_losses, pair_losses]))
        self._done += 1
        if self._done % REPORT_EVERY and self._done != self._config.steps:
            return
        losses = torch.stack(self._rows).cpu()
        self._rows.clear()
        faults = (~losses.isfinite()).nonzero().tolist()
        if faults:
            row, column = faults[0]
            step = self._before + self._done - len(losses) + row + 1
            raise NumericalError(f"{self._names[column]} is {losses[row, column].item()} at step {step}")
        if self._on_step is not None:
            numbers = {
                "loss": float(loss),
                "labelled": float(label_losses.mean()),
                "diversity": float(pair_losses.sum()),
            }
            self._on_step(self._before + self._done, numbers)

    def weights(self, networks: Sequence[nn.Sequential]) -> None:
        """Check that the last step left finite weights."""
        for member, network in zip(self._members, networks, strict=True):
            if not all(bool(value.isfinite().all()) for value in network.state_dict().values()):
                raise NumericalError(
                    f"a weight of member {member} is NaN or Inf after step {self._before + self._done}"
                )
