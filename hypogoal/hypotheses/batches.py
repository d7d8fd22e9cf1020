"""The states that an ensemble is trained on: drawn in batches and passed through the members."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import chain, repeat

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn.modules.batchnorm import _BatchNorm

from hypogoal.core.errors import UserError
from hypogoal.core.seeding import rng_for
from hypogoal.data import require_classes
from hypogoal.hypotheses import patches
from hypogoal.hypotheses.config import EnsembleConfig
from hypogoal.hypotheses.networks import as_input, as_tensor, at_once
from hypogoal.hypotheses.views import Origins, View
from hypogoal.observations import Observations, values_in

EVALUATED_AT_ONCE = 256  # states, when no gradient is kept
PLAIN = View()


class TrainingStates:
    """Labelled states followed by unlabelled ones, numbered in that order.

    Args:
        observations, labels: of the labelled states what :meth:`View.to_change` keeps, (N, ...), and labels (N,).
        unlabelled: the same of the unlabelled states. On a CPU these arrays are kept and not copied.
        network: any of the networks that will see them (their layers decide how images are stored).
        view: changes training batches at random, says how labelled ones are drawn, and has the standard of mixed
            observations' numbers, which are standardised in each batch.
        origins: of the labelled states, (N,) by name.

    Raises:
        UserError: shapes that do not fit, or labels of one class only.
    """

    def __init__(
        self,
        observations: Observations,
        labels: NDArray[np.bool_],
        unlabelled: Observations,
        network: nn.Sequential,
        device: torch.device,
        *,
        view: View = PLAIN,
        origins: Origins | None = None,
    ):
        if labels.shape != observations.shape[:1] or unlabelled.shape[1:] != observations.shape[1:]:
            shapes = f"observations {observations.shape}, labels {labels.shape}, unlabelled {unlabelled.shape}"
            raise UserError("the states do not fit together", shapes, "Collect them again.")
        require_classes(labels[:, None], ["the sub-goal"], None, "Collect others.")
        self.labels, self.n_labelled, self.n_unlabelled = labels, len(observations), len(unlabelled)
        self.device, self._view, self._origins = device, view, origins or {}
        self._dtype, self._shape = observations.dtype, (values_in(observations.shape[1:], observations.dtype),)
        self._standard = [torch.from_numpy(values).to(device) for values in view.standard or ()]
        images = [np.require(some, requirements=["C", "W"]) for some in (observations, unlabelled)]
        tables = device.type == "cpu" and not view.changes  # changed images have changed patches
        self._tables = patches.make_tables(images, network) if tables else None
        self._images = [as_tensor(some).to(device) for some in images] if self._tables is None else []
        self._targets = torch.from_numpy(labels.astype(np.int64)).to(device)

    def forward(
        self,
        networks: Sequence[nn.Sequential],
        *groups: NDArray[np.int64],
        counted: Sequence[bool] = (),
        changes: Sequence[np.random.Generator] = (),
    ) -> list[Tensor]:
        """All K networks' logits, float (K, B, 2), of each group of states (B,).

        BatchNorm sees each group on its own; all other layers take them together, which reads the weights once. In
        training mode, BatchNorm's running statistics include the ``counted`` groups, all if that is empty. With
        ``changes``, a generator per group, the view changes states at random; a group's draws do not depend on the
        others.
        """
        sizes, inputs = [len(group) for group in groups], self._inputs(groups, changes)
        logits = torch.stack([_forward(network, inputs, sizes, counted) for network in networks])
        return list(logits.split(sizes, dim=1))

    def _inputs(
        self, groups: Sequence[NDArray[np.int64]], changes: Sequence[np.random.Generator]
    ) -> Tensor | patches.Batch:
        """The networks' inputs for groups of states: images, or their patches."""
        if self._tables is not None:
            return patches.take(self._tables, *groups)
        if changes and self._view.changes:
            return torch.cat([self._images_of(*group) for group in zip(groups, changes, strict=True)])
        return self._images_of(np.concatenate(groups), None)

    def count_in(
        self, networks: Sequence[nn.Sequential], states: NDArray[np.int64], changes: np.random.Generator
    ) -> None:
        """Update BatchNorm's running statistics, of networks in training mode, with states (B,), and nothing else."""
        first = [_up_to_last_norm(network) for network in networks]
        if not any(len(network) for network in first):
            return
        with torch.no_grad():
            inputs = self._inputs([states], [changes])
            for network in first:
                _forward(network, inputs, [len(states)])

    def _images_of(self, states: NDArray[np.int64], changes: np.random.Generator | None) -> Tensor:
        numbers, (labelled, unlabelled) = torch.from_numpy(states).to(self.device), self._images
        images, first = labelled.new_empty(len(states), *labelled.shape[1:]), numbers < self.n_labelled
        images[first] = labelled[numbers[first]]
        images[~first] = unlabelled[numbers[~first] - self.n_labelled]
        if self._view.changes:
            seen = self._view.change(images.cpu().numpy(), changes)
            images = torch.from_numpy(np.ascontiguousarray(seen)).to(self.device)
        return as_input(images, self._dtype, self._standard)

    def targets(self, states: NDArray[np.int64]) -> Tensor:
        """Classes int64 (B,) of labelled states (B,)."""
        return self._targets[torch.from_numpy(states).to(self.device)]

    def unlabelled_logits(self, networks: Sequence[nn.Sequential]) -> Tensor:
        """Each trained network's logits, float (F, M, 2), of all unlabelled states, in evaluation mode."""
        if not networks:
            return torch.zeros(0, self.n_unlabelled, 2, device=self.device)
        states = np.arange(self.n_labelled, self.n_labelled + self.n_unlabelled)
        for network in networks:
            network.eval()
        with torch.no_grad():
            size = at_once(EVALUATED_AT_ONCE, self._shape)
            chunks = [self.forward(networks, states[at : at + size])[0] for at in range(0, len(states), size)]
        return torch.cat(chunks, dim=1)

    def batches(self, config: EnsembleConfig, seed: int) -> Iterator[tuple[NDArray[np.int64], NDArray[np.int64]]]:
        """``config.steps`` batches of labelled (B,) and unlabelled states (B,), see :meth:`View.pools`.

        Every state of a pool is drawn once before any is drawn again. Unlabelled batches are empty if there are no
        such states.
        """
        draws = [_draw(pools, count, seed, name) for pools, count, name in self._pools(config)]
        for _ in range(config.steps):
            *labelled, unlabelled = (next(draw) for draw in draws)
            yield np.concatenate(labelled), unlabelled

    def _pools(self, config: EnsembleConfig) -> list[tuple[list[NDArray[np.int64]], int, str]]:
        """The parts of a batch, the unlabelled last: pools of states that take turns, a count, and a name."""
        positives, share = self._view.pools(self.labels, self._origins)
        negatives = np.flatnonzero(~self.labels)
        count = min(max(1, int(share * config.batch_size)), config.batch_size - 1)
        unlabelled = np.arange(self.n_labelled, self.n_labelled + self.n_unlabelled)
        return [
            (positives, count, "positives"),
            ([negatives], config.batch_size - count, "negatives"),
            ([unlabelled], config.batch_size if len(unlabelled) else 0, "unlabelled"),
        ]


def _draw(pools: list[NDArray[np.int64]], count: int, seed: int, name: str) -> Iterator[NDArray[np.int64]]:
    """Endlessly, ``count`` items of the pools in turn; a pool is shuffled again once all its items were drawn."""
    rngs = [rng_for(seed, name, *([number] if len(pools) > 1 else [])) for number in range(len(pools))]
    streams = [chain.from_iterable(map(rng.permutation, repeat(pool))) for rng, pool in zip(rngs, pools, strict=True)]
    turn = 0
    while True:
        drawn = np.array([next(streams[(turn + item) % len(streams)]) for item in range(count)], dtype=np.int64)
        turn = (turn + count) % len(streams)
        yield drawn


def _forward(
    network: nn.Sequential, values: Tensor | patches.Batch, sizes: Sequence[int], counted: Sequence[bool] = ()
) -> Tensor:
    """A network's outputs for consecutive groups of inputs; BatchNorm sees each group on its own."""
    if isinstance(values, patches.Batch):
        return patches.forward(network, values, counted)
    for layer in network:
        if norms := _norms(layer):
            groups = zip(values.split(list(sizes)), counted or [True] * len(sizes), strict=True)
            normed = [layer(group) if counts else _uncounted(layer, norms, group) for group, counts in groups]
        values = torch.cat(normed) if norms else layer(values)
    return values


def _norms(layer: nn.Module) -> list[_BatchNorm]:
    """The BatchNorms of a layer, itself included, that are in training mode."""
    return [part for part in layer.modules() if isinstance(part, _BatchNorm) and part.training]


def _uncounted(layer: nn.Module, norms: Sequence[_BatchNorm], inputs: Tensor) -> Tensor:
    """A layer's outputs by the inputs' own statistics, without updating the running ones."""
    tracked = [norm.track_running_stats for norm in norms]
    for norm in norms:
        norm.track_running_stats = False
    outputs: Tensor = layer(inputs)
    for norm, tracks in zip(norms, tracked, strict=True):
        norm.track_running_stats = tracks
    return outputs


def _up_to_last_norm(network: nn.Sequential) -> nn.Sequential:
    """The layers that BatchNorm's running statistics depend on."""
    last = max((index for index, layer in enumerate(network) if _norms(layer)), default=-1)
    return nn.Sequential(*list(network)[: last + 1])
