"""States as users bring them, unchecked."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeAlias

from numpy.typing import NDArray

Array: TypeAlias = NDArray[Any]


@dataclass(frozen=True)
class Given:
    """Some states.

    Attributes:
        observations: (N, ...) by key; by "" if there are no keys.
        names: what messages call each, (N,).
        labels: 0 or 1, (N,) or (N, G); None of unlabelled states.
        groups: which belong together, (N,): a group is held out whole or not at all. None: no groups.
    """

    observations: Mapping[str, Array]
    names: Sequence[str]
    labels: Array | None = None
    groups: Array | None = None


@dataclass(frozen=True)
class Parts:
    """The states of a source. Without held-out ones, a share of the labelled ones will be held out."""

    labelled: Given
    unlabelled: Given
    heldout: Given | None = None
    sub_goals: Sequence[str] = ()  # their names, if the source has them
    features: Sequence[str] = ()  # names of the numbers
    channels: Mapping[str, tuple[int, int]] = field(
        default_factory=dict
    )  # by key: frames and colours of each, if stacked
