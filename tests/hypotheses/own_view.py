"""A view and a rule for thresholds of one's own."""

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hypogoal.core.config import Config, setting
from hypogoal.hypotheses.views import Origins, StateOrigins, View


class Settings(Config):
    jitter: int = setting(2, "the most by which pictures are moved", unit="pixels", low=0, high=8)


class Moved(View):
    """The middle of pictures without their mean shade; in training another part of them, brighter or darker."""

    Settings = Settings
    changes = True
    shade: Tensor

    def __init__(self, observation_shape: tuple[int, ...], settings: Settings):
        super().__init__()
        self.jitter = settings.jitter
        height, width, channels = observation_shape
        self.shape = (height - 2 * self.jitter, width - 2 * self.jitter, channels)
        self.register_buffer("shade", torch.zeros((), dtype=torch.int64))

    def fit(self, labelled: Any, unlabelled: Any, origins: StateOrigins, seed: int) -> None:
        self.shade.fill_(int(labelled.mean()))

    def see(self, observations: Any) -> Any:
        return self.change(self.to_change(observations), None)

    def to_change(self, observations: Any) -> Any:
        return np.maximum(observations, self.shade.item()) - np.uint8(self.shade.item())

    def change(self, batch: Any, rng: np.random.Generator | None) -> Any:
        height, width, _ = self.shape
        if rng is None:
            return batch[:, self.jitter : self.jitter + height, self.jitter : self.jitter + width]
        corners = rng.integers(2 * self.jitter + 1, size=(len(batch), 2))
        moved = np.empty((len(batch), *self.shape), dtype=np.float32)
        for index, (row, column) in enumerate(corners):
            moved[index] = batch[index, row : row + height, column : column + width]
        return moved / 255 * rng.uniform(0.5, 1.0, size=(len(batch), 1, 1, 1)).astype(np.float32)

    def pools(self, labels: NDArray[np.bool_], origins: Origins) -> tuple[list[NDArray[np.int64]], float]:
        if "kind" not in origins:
            return super().pools(labels, origins)
        positives = np.flatnonzero(labels)
        kinds = origins["kind"][positives]
        return [positives[kinds == kind] for kind in np.unique(kinds)], 3 / 8


class Wrong(Moved):
    """It says that it shows more than it does."""

    def see(self, observations: Any) -> Any:
        return super().see(observations)[:, 1:]


class OfNumbers(View):
    """A view of numbers."""

    dtype = np.dtype(np.float32)

    def __init__(self, observation_shape: tuple[int, ...], settings: object):
        super().__init__()
        self.shape = observation_shape


def lowest(labelled: NDArray[np.float32], labels: NDArray[np.bool_], unlabelled: NDArray[np.float32]) -> Any:
    """All labelled positives but the least likely are positive."""
    return labelled[labels].min(axis=0)


def too_many(labelled: NDArray[np.float32], labels: NDArray[np.bool_], unlabelled: NDArray[np.float32]) -> Any:
    return np.zeros(7)
