"""What every reader yields, whatever it reads, and the files that there are to read."""

from collections import Counter
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from glob import iglob
from pathlib import Path
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


def files_of(folder: Path, suffixes: Collection[str], left: Counter[str]) -> list[Path]:
    """The visible files with these suffixes in a folder and those below it, sorted, links followed.

    ``left`` counts the others by suffix.
    """
    taken = []
    for name in iglob("**/*", root_dir=folder, recursive=True):
        file = folder / name
        suffix = file.suffix.lower()
        if file.is_dir():
            continue
        if suffix in suffixes:
            taken.append(file)
        else:
            left[suffix or file.name] += 1
    return sorted(taken)
