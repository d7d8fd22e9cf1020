"""The states that an ensemble is trained on: how batches are drawn and passed through the members."""

from collections.abc import Iterator, Sequence
from itertools import chain, cycle, islice, repeat

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.modules.batchnorm import _BatchNorm

from hypogoal.core.arrays import Bools, Ints, tensor
from hypogoal.core.checkpoints import Resumable
from hypogoal.core.seeding import rng_for
from hypogoal.hypotheses import patches
from hypogoal.hypotheses.config import EnsembleConfig
from hypogoal.hypotheses.ensemble import Ensemble
from hypogoal.hypotheses.networks import at_once, inputs_of
from hypogoal.hypotheses.views import Origins, changed_by, pools_of
from hypogoal.label_checks import require_classes
from hypogoal.observations import Observations, values_in

Numbers = Ints  # (B,), the indices of states
EVALUATED_AT_ONCE = 256  # states in one pass that keeps no gradients
NONE = np.zeros(0, int)


class TrainingStates(Resumable):
    """The training states: labelled states (N, *obs) with labels (N,), and unlabelled states (M, *obs).

    States of both kinds are numbered from 0. Pictures are kept without a copy. If many patches of the pictures are
    equal, the pictures are kept as tables, see :mod:`hypogoal.hypotheses.patches`.

    Args:
        ensemble: the ensemble whose members will see the states. Its device and its view are used.
        origins: the origins of the labelled states, (N,) by name, for a view that draws by origin.

    Attributes:
        changes: the random generators of a view's changes, one for labelled and one for unlabelled states. There are
            two because methods differ in how often they change unlabelled states.

    Raises:
        UserError: if all labels are of one class.
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
        """Begin the random changes of one training. Call this before any :meth:`logits`."""
        self.changes = [rng_for(seed, "changes", group) for group in ("labelled", "unlabelled")]

    def targets(self, labelled: Numbers) -> Tensor:
        """Return the classes, int64 (B,), of the labelled states with indices ``labelled`` (B,)."""
        return self._targets[tensor(labelled, self.device)]

    def logits(
        self,
        networks: Sequence[nn.Sequential],
        labelled: Numbers = NONE,
        unlabelled: Numbers = NONE,
        *,
        counted: bool = True,
    ) -> tuple[Tensor, Tensor]:
        """Return the logits of all K networks for labelled states, (K, B, 2), and for unlabelled states, (K, N, 2).

        In training mode the view changes the states at random. ``counted`` says whether BatchNorm's running statistics
        include the unlabelled states, see :func:`plain_forward`.
        """
        groups = (labelled, unlabelled)
        inputs = self._inputs(groups, changing=networks[0].training)
        sizes = [len(group) for group in groups]
        logits = []
        for network in networks:  # both kinds of inputs give equal logits up to rounding (a test asserts it)
            if isinstance(inputs, patches.PatchBatch):
                logits.append(patches.forward(network, inputs, counted))
            else:
                logits.append(plain_forward(network, inputs, sizes, counted))
        on_labelled, on_unlabelled = torch.stack(logits).split(sizes, dim=1)
        return on_labelled, on_unlabelled

    def frozen_logits(self, networks: Sequence[nn.Sequential]) -> Tensor:
        """Return the logits of F trained networks, float (F, M, 2), for all unlabelled states, in evaluation mode."""
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
        """Yield ``config.steps`` batches: the indices of labelled states (B,) and of unlabelled states (B,).

        Half of the labelled states are positive, unless the view has other pools (:meth:`View.pools`). Every state of a
        pool is drawn once before any state is drawn again. The indices of unlabelled states are empty if there are no
        unlabelled states.
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
        """Return the networks' inputs for labelled and unlabelled states: pictures, or the patches of pictures."""
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
    """Yield ``count`` items at a time, without end, taken from the pools in turn.

    A pool is shuffled again once all its items were drawn.
    """
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
    """Return a network's outputs for labelled inputs followed by unlabelled inputs.

    ``sizes`` are the number of labelled inputs and the number of unlabelled inputs. In training, BatchNorm standardises
    each of the two groups by the mean and variance of that group alone. The running mean and variance, by which a
    trained network predicts, follow both groups, the labelled group first. If the unlabelled group is not ``counted``,
    the running mean and variance follow the labelled group alone. All other layers take both groups at once.
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
