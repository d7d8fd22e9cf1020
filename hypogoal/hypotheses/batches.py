"""The states that an ensemble is trained on: drawn in batches and passed through the members."""

from collections.abc import Iterator, Sequence
from itertools import chain, cycle, islice, repeat

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.modules.batchnorm import _BatchNorm

from hypogoal.core.arrays import Bools, Ints, tensor
from hypogoal.core.checkpoints import Resumable
from hypogoal.core.seeding import rng_for
from hypogoal.data import require_classes
from hypogoal.hypotheses import patches
from hypogoal.hypotheses.config import EnsembleConfig
from hypogoal.hypotheses.ensemble import Ensemble
from hypogoal.hypotheses.networks import at_once, inputs_of
from hypogoal.hypotheses.views import Origins, changed_by, pools_of
from hypogoal.observations import Observations, values_in

Numbers = Ints  # of states, (B,)
EVALUATED_AT_ONCE = 256  # states, when no gradient is kept
NONE = np.zeros(0, int)


class TrainingStates(Resumable):
    """Labelled states (N, *obs) with labels (N,), and unlabelled ones (M, *obs), each numbered from 0.

    Pictures are kept and not copied. Those of which many patches are equal are kept as tables, see
    :mod:`hypogoal.hypotheses.patches`.

    Args:
        ensemble: whose members will see the states, on its device and by its view.
        origins: of the labelled states, (N,) by name, for a view that draws by them.

    Attributes:
        changes: generators of a view's random changes of labelled and of unlabelled states. There are two since methods
            differ in their use of the second.

    Raises:
        UserError: labels of one class only.
    """

    CHANGING = ("changes",)

    def __init__(
        self,
        observations: Observations,
        labels: Bools,
        unlabelled: Observations,
        ensemble: Ensemble,
        origins: Origins,
    ):
        require_classes(labels[:, None], ["the sub-goal"], None, "Collect others.")
        self.labels, self.n_unlabelled = labels, len(unlabelled)
        self.view, self.device = ensemble.view, ensemble.thresholds.device
        self._origins = origins
        self._targets = tensor(labels.astype(int), self.device)
        kept = self.view.to_change(observations), self.view.to_change(unlabelled)
        self._tables = None
        if self.device.type == "cpu" and not self.view.changes:  # changed pictures have changed patches
            self._tables = patches.make_tables(ensemble.networks[0], *kept)
        self._states = kept if self._tables is None else ()
        size = values_in(observations.shape[1:], observations.dtype)
        self._at_once = at_once(EVALUATED_AT_ONCE, (size,))

    def begin(self, seed: int) -> None:
        """Begin the random changes of one training; before any :meth:`logits`."""
        self.changes = [rng_for(seed, "changes", group) for group in ("labelled", "unlabelled")]

    def targets(self, labelled: Numbers) -> Tensor:
        """Classes int64 (B,) of labelled states (B,)."""
        return self._targets[tensor(labelled, self.device)]

    def logits(
        self,
        networks: Sequence[nn.Sequential],
        labelled: Numbers = NONE,
        unlabelled: Numbers = NONE,
        *,
        counted: bool = True,
    ) -> tuple[Tensor, Tensor]:
        """All K networks' logits of labelled (K, B, 2) and of unlabelled states (K, N, 2).

        In training mode the view changes the states at random, and ``counted`` says whether BatchNorm's running
        statistics include the unlabelled ones, see :func:`plain_forward`.
        """
        groups = (labelled, unlabelled)
        inputs = self._inputs(groups, changing=networks[0].training)
        sizes = [len(group) for group in groups]
        logits = []
        for network in networks:  # up to rounding the same for either kind of inputs (a test asserts it)
            if isinstance(inputs, patches.PatchBatch):
                logits.append(patches.forward(network, inputs, counted))
            else:
                logits.append(plain_forward(network, inputs, sizes, counted))
        on_labelled, on_unlabelled = torch.stack(logits).split(sizes, dim=1)
        return on_labelled, on_unlabelled

    def frozen_logits(self, networks: Sequence[nn.Sequential]) -> Tensor:
        """F trained networks' logits, float (F, M, 2), of all unlabelled states, in evaluation mode."""
        if not networks:
            return torch.zeros(0, self.n_unlabelled, 2, device=self.device)
        for network in networks:
            network.eval()
        chunks = []
        with torch.no_grad():
            for some in torch.arange(self.n_unlabelled).split(self._at_once):
                _, logits = self.logits(networks, unlabelled=some.numpy())
                chunks.append(logits)
        return torch.cat(chunks, dim=1)

    def batches(
        self,
        config: EnsembleConfig,
        seed: int,
    ) -> Iterator[tuple[Numbers, Numbers]]:
        """``config.steps`` batches: numbers of labelled (B,) and of unlabelled states (B,).

        Half of the labelled ones are positive, unless the view has other pools (:meth:`View.pools`). Every state of a
        pool is drawn once before any is drawn again. Unlabelled batches are empty if there are no such states.
        """
        pools, share = pools_of(self.view, self.labels, self._origins)
        positives = min(max(1, int(share * config.batch_size)), config.batch_size - 1)
        negatives = np.flatnonzero(~self.labels)
        others = config.batch_size if self.n_unlabelled else 0
        drawn_positives = _draws(pools, positives, seed, "positives")
        drawn_negatives = _draws(
            [negatives],
            config.batch_size - positives,
            seed,
            "negatives",
        )
        drawn_unlabelled = _draws(
            [np.arange(self.n_unlabelled)],
            others,
            seed,
            "unlabelled",
        )
        for _ in range(config.steps):
            labelled = np.concatenate([next(drawn_positives), next(drawn_negatives)])
            yield labelled, next(drawn_unlabelled)

    def _inputs(
        self,
        groups: tuple[Numbers, Numbers],
        changing: bool,
    ) -> Tensor | patches.PatchBatch:
        """The networks' inputs for labelled and unlabelled states: pictures, or their patches."""
        if self._tables is not None:
            labelled, unlabelled = groups
            tabled = (labelled, unlabelled + len(self.labels))
            return patches.take(self._tables, *filter(len, tabled))
        rows = []
        for states, numbers, rng in zip(self._states, groups, self.changes, strict=True):
            if not len(numbers):
                continue
            seen = states[numbers]
            if self.view.changes:
                seen = changed_by(self.view, seen, rng if changing else None)
            rows.append(seen)
        return inputs_of(np.concatenate(rows), self.device)


def _draws(
    pools: Sequence[Numbers],
    count: int,
    seed: int,
    name: str,
) -> Iterator[Numbers]:
    """Endlessly, ``count`` items of the pools in turn; a pool is shuffled again once all its items were drawn."""
    streams = []
    for number, pool in enumerate(pools):
        names = [name, number] if len(pools) > 1 else [name]
        rng = rng_for(seed, *names)
        streams.append(chain.from_iterable(map(rng.permutation, repeat(pool))))
    items = map(next, cycle(streams))
    while True:
        yield np.fromiter(islice(items, count), int, count)


def plain_forward(
    network: nn.Sequential,
    inputs: Tensor,
    sizes: Sequence[int],
    counted: bool,
) -> Tensor:
    """A network's outputs for so many labelled inputs and, behind them, so many unlabelled ones.

    In training, BatchNorm standardises each of the two groups by the group's own mean and variance, as if the other
    were not there. The running mean and variance, by which a trained network predicts, follow both groups, first the
    labelled one; where the unlabelled one is not ``counted``, they follow the labelled one alone. All other layers take
    both groups at once.
    """
    values = inputs
    for layer in network:
        norms = [part for part in layer.modules() if isinstance(part, _BatchNorm) and part.training]
        if not norms:
            values = layer(values)
            continue
        normed = []
        for number, group in enumerate(values.split(list(sizes))):
            if not len(group):
                continue
            still = [norm for norm in norms if norm.track_running_stats and number == 1 and not counted]
            for norm in still:
                norm.track_running_stats = False
            normed.append(layer(group))
            for norm in still:
                norm.track_running_stats = True
        values = torch.cat(normed)
    return values
