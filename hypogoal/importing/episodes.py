"""What every reader yields, whatever it reads."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, TypeAlias

from numpy.typing import NDArray

Array: TypeAlias = NDArray[Any]
ROLES = LABELLED, UNLABELLED, HELDOUT = "labelled", "unlabelled", "heldout"


@dataclass(frozen=True)
class Episode:
    """Frames that are labelled, unlabelled or held out together: a recorded episode, one picture, one row of arrays.

    Attributes:
        name: what messages and tables of labels call it.
        length: T, how many frames it has.
        observations: by key, an array (T, ...), or a function from rising numbers of frames to what is seen in these,
            one after another. The key is "" if there are none.
        columns: (T,) by name, which may label frames.
        role: one of ``ROLES``; empty if it may become any.
        group: with which others it is held out, if at all; empty if it stands alone.
    """

    name: str
    length: int
    observations: Mapping[str, Any]
    columns: Mapping[str, Array]
    role: str = ""
    group: str = ""
