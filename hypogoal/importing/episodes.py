"""What every reader yields, whatever it reads."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, TypeAlias

from numpy.typing import NDArray

Array: TypeAlias = NDArray[Any]
ROLES = LABELLED, UNLABELLED, HELDOUT = "labelled", "unlabelled", "heldout"


@dataclass(frozen=True)
class Episode:
    """Frames in order: a recorded episode, one picture, or a set of arrays.

    Attributes:
        name: what messages and tables of labels call it.
        length: T, how many frames it has.
        observations: by key, an array (T, ...), or a function from rising numbers of frames to what is seen in these,
            one after another. The key is "" if there are none.
        columns: (T,) by name, which may label frames.
        role: one of ``ROLES``; empty if it may become any, as a whole.
        group: with which others frames are held out, if at all: one name, or (T,) names; empty if they stand alone.
    """

    name: str
    length: int
    observations: Mapping[str, Any]
    columns: Mapping[str, Array]
    role: str = ""
    group: str | Array = ""
