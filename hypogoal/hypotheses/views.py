"""What members see of an observation: all of it, or what a view of the user's own shows (beyond the paper)."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from math import prod
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from hypogoal.core.arrays import Bools, Ints
from hypogoal.core.config import Config, assigned, resolve
from hypogoal.core.errors import UserError
from hypogoal.core.own_code import load_class
from hypogoal.hypotheses.config import FULL as FULL
from hypogoal.observations import (
    NUMBERS,
    PICTURE,
    DType,
    Observations,
    Shape,
    Standard,
    fields_of,
    numbers_of,
    standard_of,
    standardised,
)

ENTRY_POINTS = "hypogoal.views"  # the entry point group by which other packages add views
Origins = Mapping[str, Ints]


@dataclass(frozen=True)
class StateOrigins:
    """Where training states come from, as far as that is known: int64 (N,) by the origin's name."""

    labelled: Origins = field(default_factory=dict)
    unlabelled: Origins = field(default_factory=dict)


class View(nn.Module):
    """What members see of observations: by default all of them.

    ``view=module:Class`` names a subclass of the user's own. Its ``__init__`` gets the observations' shape and a
    ``Settings``. Parameters and buffers are saved and loaded with the ensemble, so ``__init__`` must make them in their
    final shapes.

    Attributes:
        Settings: a ``Config`` of :func:`hypogoal.core.config.setting` fields, which ``--set view.KEY=VALUE`` changes.
        changes: whether the view changes batches at random.
        dtype: the type of observations, and of what members see.
        shape: the shape of what members see of one observation.
    """

    Settings: type[Config] = Config
    changes = False
    dtype: DType = PICTURE
    shape: Shape

    @property
    def standard(self) -> Standard | None:
        """The mean and deviation by which numbers are standardised, or None if they are not."""
        return None

    def fit(self, labelled: Any, unlabelled: Any, origins: StateOrigins, seed: int) -> None:
        """Learn from the training states, labelled (N, ...) and unlabelled (M, ...). By default nothing is learned."""

    def see(self, observations: Any) -> Any:
        """Return what members see, (N, *shape), of observations (N, ...)."""
        return observations

    def to_change(self, observations: Any) -> Any:
        """Return what training keeps of observations for :meth:`change`. By default this is what members see."""
        return self.see(observations)

    def change(self, batch: Any, rng: np.random.Generator | None) -> Any:
        """Return what members see of a batch that :meth:`to_change` gave.

        The batch is changed at random, or left as it is if ``rng`` is None. Pictures (B, *shape) are uint8, or float32
        in 0..1.
        """
        return batch

    def pools(self, labels: Bools, origins: Origins) -> tuple[list[Ints], float]:
        """Return the pools from which positives are drawn, and the share of positives in a labelled batch.

        A pool has the indices of positive labelled states, int64 (n,). Positives are drawn from the pools in turn. By
        default there is one pool with all positives and their share is half, so that the class weights apply (DEV-13).
        """
        return [np.flatnonzero(labels)], 0.5


class FullView(View):
    """The view that shows all of an observation: pictures as they are, as in the paper, and numbers standardised.

    ``standard`` (*shape) is the mean and deviation of numbers, if they are known already. For mixed observations, they
    are the mean and deviation of all numbers together, (D,).
    """

    mean: Tensor
    deviation: Tensor

    def __init__(self, observation_shape: Shape, dtype: DType = PICTURE, standard: Standard | None = None):
        super().__init__()
        self.shape, self.dtype = observation_shape, dtype
        fields = fields_of(observation_shape, dtype).values()
        counts = [prod(shape) for kind, shape in fields if kind == NUMBERS]
        self.numbers = (sum(counts),) if dtype.names else observation_shape
        self.standardises = bool(counts)
        if self.standardises:
            mean, deviation = standard or standard_of(self.numbers)
            self.register_buffer("mean", torch.from_numpy(mean.copy()))
            self.register_buffer("deviation", torch.from_numpy(deviation.copy()))

    @property
    def standard(self) -> Standard | None:
        """The mean and deviation (*shape) of numbers, or None for pictures."""
        if not self.standardises:
            return None
        return self.mean.cpu().numpy(), self.deviation.cpu().numpy()

    def fit(self, labelled: Observations, unlabelled: Observations, origins: StateOrigins, seed: int) -> None:
        """Learn the mean and deviation of numbers."""
        if not self.standardises:
            return
        rows = [numbers_of(states).reshape(-1, *self.numbers) for states in (labelled, unlabelled)]
        mean, deviation = standard_of(self.numbers, *rows)
        self.mean.copy_(torch.from_numpy(mean))
        self.deviation.copy_(torch.from_numpy(deviation))

    def see(self, observations: Observations) -> Observations:
        """Return the observations (N, *shape), with numbers standardised."""
        if self.standard is None:
            return observations
        if not self.dtype.names:
            return standardised(observations, *self.standard)
        seen = observations.copy()
        numbers = standardised(numbers_of(observations), *self.standard)
        place = 0
        for key, (dtype, shape) in fields_of((), self.dtype).items():
            if dtype == NUMBERS:
                of_key = numbers[:, place : place + prod(shape)]
                seen[key] = of_key.reshape(-1, *shape)
                place += prod(shape)
        return seen


def load_view(name: str) -> type[View]:
    """Return the view class ``module:Class``.

    Raises ``UserError`` if there is no such class, or if the user did not allow the code.
    """
    return load_class(name, "view", View, {}, ENTRY_POINTS)


def view_of(name: str, settings: Sequence[str], observation_shape: Shape, dtype: DType) -> View:
    """Return the view named ``full`` or ``module:Class``, before it has learned.

    ``settings`` of the user's own view are texts ``KEY=VALUE``. The view is made for observations of the given shape
    and type. Raises ``UserError`` if there is no such view or setting, if the view is of another type of observations,
    or if the user did not allow the code.
    """
    if name == FULL:
        return FullView(observation_shape, dtype)
    kind = load_view(name)
    chosen = resolve(kind.Settings, assigned(settings), stage=name)
    view = kind(observation_shape, chosen)
    if view.dtype != dtype:
        raise UserError(f"the view is of {view.dtype}, these observations are {dtype}", name)
    return view


def learn_from(view: View, labelled: Any, unlabelled: Any, origins: StateOrigins, seed: int) -> None:
    """Call :meth:`View.fit`, then check what the view shows.

    Raises ``UserError`` if the view shows another shape or type than it declares, or if it changes its input.
    """
    view.fit(labelled, unlabelled, origins, seed)
    name = type(view).__name__
    two = labelled[:2].copy()
    seen = np.asarray(view.see(two))
    wanted = (len(two), *view.shape)
    if seen.dtype != view.dtype or seen.shape != wanted:
        raise UserError(
            f"the view shows {seen.dtype} {seen.shape} of {len(two)} states", name, f"Show {view.dtype} {wanted}."
        )
    if two.tobytes() != labelled[:2].tobytes():
        raise UserError("the view changes the observations", name, "Have it change a copy.")


def changed_by(view: View, batch: Any, rng: np.random.Generator | None) -> Any:
    """Call :meth:`View.change` and check the result.

    Raises ``UserError`` if the result is anything but (B, *shape) of the view's type, or pictures in 0..1.
    """
    changed = np.asarray(view.change(batch, rng))
    wanted = (len(batch), *view.shape)
    most = np.inf if changed.dtype == view.dtype else 1
    if changed.shape != wanted or changed.dtype not in (view.dtype, NUMBERS) or changed.max() > most:
        shown = f"{changed.dtype} {changed.shape}, at most {changed.max()}"
        raise UserError(
            f"the view changes a batch to {shown}",
            type(view).__name__,
            f"Give {view.dtype} {wanted}, or float32 in 0..1.",
        )
    return changed


def pools_of(view: View, labels: Bools, origins: Origins) -> tuple[list[Ints], float]:
    """Call :meth:`View.pools` and check the result.

    Raises ``UserError`` if a pool is empty or has others than positives, or if the share is not between 0 and 1.
    """
    pools, share = view.pools(labels, origins)
    numbers = np.zeros(0)
    if pools and all(map(len, pools)):
        numbers = np.concatenate(pools)
    are_positives = np.isin(numbers, np.flatnonzero(labels)).all()
    if numbers.dtype.kind not in "iu" or not are_positives or not 0 < share < 1:
        raise UserError(
            f"the view gave {len(pools)} pools and the share {share}",
            type(view).__name__,
            "Give lists of numbers of positives, none empty, and their share of a batch, between 0 and 1.",
        )
    return pools, share
