"""The states that an ensemble is trained on, drawn in batches and run through the members."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from hypogoal.core.errors import UserError
from hypogoal.core.seeding import rng_for
from hypogoal.hypotheses import patches
from hypogoal.hypotheses.config import EnsembleConfig
from hypogoal.hypotheses.networks import as_input

CHUNK = 256  # states at once where no gradient is kept


class TrainingStates:
    """Labelled states followed by unlabelled ones, one numbering for both.

    Args:
        observations: uint8 (N, H, W, C), labelled.
        labels: bool (N,).
        unlabelled: uint8 (M, H, W, C).
        network: any of the networks that will see them (their layers decide how images are stored).
        device: where they are to be used.

    Raises:
        UserError: shapes that do not fit, or labels of one class only.
    """

    def __init__(
        self,
        observations: NDArray[np.uint8],
        labels: NDArray[np.bool_],
        unlabelled: NDArray[np.uint8],
        network: nn.Sequential,
        device: torch.device,
    ):
        if labels.shape != observations.shape[:1] or unlabelled.shape[1:] != observations.shape[1:]:
            shapes = f"observations {observations.shape}, labels {labels.shape}, unlabelled {unlabelled.shape}"
            raise UserError("the states do not fit together", shapes, "Collect them again.")
        if not labels.any() or labels.all():
            counts = f"{int(labels.sum())} positives of {len(labels)}"
            raise UserError("labelled states of both classes are needed", counts, "Collect others.")
        self.labels, self.n_labelled, self.n_unlabelled = labels, len(observations), len(unlabelled)
        self.device = device
        images = np.concatenate([observations, unlabelled])
        self._tables = patches.make_tables(images, patches.windows_of(network)) if device.type == "cpu" else None
        self._images = torch.from_numpy(images).to(device) if self._tables is None else None
        self._targets = torch.from_numpy(labels.astype(np.int64)).to(device)

    def forward(self, networks: Sequence[nn.Sequential], states: NDArray[np.int64]) -> list[Tensor]:
        """Each network's logits (B, 2) of states (B,)."""
        if self._tables is not None:
            batch = patches.take(self._tables, states)
            return [patches.forward(network, batch) for network in networks]
        assert self._images is not None
        inputs = as_input(self._images[torch.from_numpy(states).to(self.device)])
        return [network(inputs) for network in networks]

    def targets(self, states: NDArray[np.int64]) -> Tensor:
        """Classes int64 (B,) of labelled states (B,)."""
        return self._targets[torch.from_numpy(states).to(self.device)]

    def unlabelled_logits(self, networks: Sequence[nn.Sequential]) -> list[Tensor]:
        """Each trained network's logits (M, 2) of all unlabelled states, in evaluation mode."""
        every = np.arange(self.n_labelled, self.n_labelled + self.n_unlabelled)
        for network in networks:
            network.eval()
        with torch.no_grad():
            chunks = [self.forward(networks, every[at : at + CHUNK]) for at in range(0, len(every), CHUNK)]
        return [torch.cat(logits) for logits in zip(*chunks, strict=True)]

    def batches(self, config: EnsembleConfig, seed: int) -> Iterator[tuple[NDArray[np.int64], NDArray[np.int64]]]:
        """``config.steps`` times: labelled states (B,), half of them positive if asked, and unlabelled (B,).

        Every state of a pool is drawn once before any is drawn again. Without unlabelled states theirs are
        empty.
        """
        unlabelled = np.arange(self.n_labelled, self.n_labelled + self.n_unlabelled)
        if config.class_balance == "batch":
            positives = config.batch_size // 2
            pools = [
                (np.flatnonzero(self.labels), positives, "positives"),
                (np.flatnonzero(~self.labels), config.batch_size - positives, "negatives"),
            ]
        else:
            pools = [(np.arange(self.n_labelled), config.batch_size, "labelled")]
        pools.append((unlabelled, config.batch_size if len(unlabelled) else 0, "unlabelled"))
        draws = [_draw(pool, count, rng_for(seed, name)) for pool, count, name in pools]
        for _ in range(config.steps):
            *labelled, others = (next(draw) for draw in draws)
            yield np.concatenate(labelled), others


def _draw(pool: NDArray[np.int64], count: int, rng: np.random.Generator) -> Iterator[NDArray[np.int64]]:
    """Without end: ``count`` items of the pool, which is shuffled anew whenever it has been gone through."""
    waiting = np.empty(0, dtype=np.int64)
    while True:
        while len(waiting) < count:
            waiting = np.concatenate([waiting, rng.permutation(pool)])
        yield waiting[:count]
        waiting = waiting[count:]
