"""What members see of an observation: all of it, or what a view of one's own shows (beyond the paper)."""

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

ENTRY_POINTS = "hypogoal.views"  # with which other packages add views
Origins = Mapping[str, Ints]


@dataclass(frozen=True)
class StateOrigins:
    """Where training states come from, as far as it is known: int64 (N,) by name."""

    labelled: Origins = field(default_factory=dict)
    unlabelled: Origins = field(default_factory=dict)


class View(nn.Module):
    """What members see of observations: all of them; ``view=module:Class`` names a subclass of one's own.

    ``__init__`` gets the observations' shape and a ``Settings``. Parameters and buffers are saved and loaded with the
    ensemble, so it makes them in their final shapes.

    Attributes:
        Settings: a ``Config`` of :func:`hypogoal.core.config.setting` fields, which ``--set view.KEY=VALUE`` changes.
        changes: whether batches are changed at random.
        dtype: of observations, and of what members see.
        shape: of what members see of one.
    """

    Settings: type[Config] = Config
    changes = False
    dtype: DType = PICTURE
    shape: Shape

    @property
    def standard(self) -> Standard | None:
        """Mean and deviation of numbers, where they are standardised."""
        return None

    def fit(self, labelled: Any, unlabelled: Any, origins: StateOrigins, seed: int) -> None:
        """Learn from the training states (N, ...) and (M, ...); by default nothing."""

    def see(self, observations: Any) -> Any:
        """What members see, (N, *shape), of observations (N, ...)."""
        return observations

    def to_change(self, observations: Any) -> Any:
        """What training keeps of observations for :meth:`change`; by default what members see."""
        return self.see(observations)

    def change(self, batch: Any, rng: np.random.Generator | None) -> Any:
        """What members see of a batch of :meth:`to_change`: changed at random, or without ``rng`` as it is.

        Pictures (B, *shape) are uint8, or float32 in 0..1.
        """
        return batch

    def pools(self, labels: Bools, origins: Origins) -> tuple[list[Ints], float]:
        """The positives in pools that take turns, by number, and their share of labelled batches.

        By default all in one, and half, so that the class weights apply (DEV-13).
        """
        return [np.flatnonzero(labels)], 0.5


class FullView(View):
    """All of an observation: a picture as it is, the paper's view; numbers standardised by what it learned of them.

    ``standard`` (*shape) is what it has learned already. Of a mixed observation it is that of all its numbers, (D,).
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
        """Mean and deviation (*shape) of numbers; None for pictures."""
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
        """The observations (N, *shape)."""
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
    """The view ``module:Class``; no such one, and code that the user did not allow, are a ``UserError``."""
    return load_class(name, "view", View, {}, ENTRY_POINTS)


def view_of(name: str, settings: Sequence[str], observation_shape: Shape, dtype: DType) -> View:
    """The view ``full``, or ``module:Class`` with its settings, ``KEY=VALUE``, of such observations; it learns later.

    No such view or setting, and code that the user did not allow, are a ``UserError``.
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
    """:meth:`View.fit`; a view that then shows other than it says, or changes what it gets, is a ``UserError``."""
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
    """:meth:`View.change`; anything but (B, *shape) of the view's type, or pictures in 0..1, is a ``UserError``."""
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
    """:meth:`View.pools`; pools that are empty or not of positives, or another share, are a ``UserError``."""
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
