"""States as users bring them, unchecked."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

from numpy.typing import NDArray

# Pictures (N, H, W, C) or (N, H, W), or numbers (N, *shape); such arrays by key; or mixed observations (N,).
Source: TypeAlias = NDArray[Any] | Mapping[str, NDArray[Any]]


@dataclass(frozen=True)
class Given:
    """Some states.

    Attributes:
        observations: N of them.
        names: what messages call each, (N,).
        labels: 0 or 1, (N,) or (N, G); None of unlabelled states.
        groups: which belong together, (N,): a group is held out whole or not at all. None: no groups.
    """

    observations: Source
    names: Sequence[str]
    labels: NDArray[Any] | None = None
    groups: NDArray[Any] | None = None


@dataclass(frozen=True)
class Parts:
    """The states of a source. Without held-out ones, a share of the labelled ones will be held out."""

    labelled: Given
    unlabelled: Given
    heldout: Given | None = None
    sub_goals: tuple[str, ...] = ()  # their names, if the source has them
    features: tuple[str, ...] = ()  # names of the numbers
