"""Episodes from any source, and how their frames are chosen and taken for pictures or numbers, key by key.

The table in docs/own-domain.md says what is taken for a picture and what for numbers.
"""

import os
from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from pandas import DataFrame

from hypogoal.core.arrays import Array, Floats
from hypogoal.core.errors import UserError
from hypogoal.core.files import reading
from hypogoal.domains.observations import CLEARLY, reading_of, shrunk_picture
from hypogoal.observations import NUMBERS, PICTURE, spread_rows

ROLES = LABELLED, UNLABELLED, HELDOUT = "labelled", "unlabelled", "heldout"
UNJUDGED = "unjudged"  # of a frame that is held out, of which nobody says whether the sub-goal holds
STACKED = "Give pictures as uint8 (H, W, C); 'import --stack' puts stacked frames among the channels."
MOST_COMPARED = 2_000  # the most rows of numbers that are compared before and after the cast to float32
LEFT = 0.9  # the share of a column's distinct values that float32 must keep
# Folders that a system keeps for itself. Folders that begin with @ are left aside, too.
ASIDE = {"__macosx", "thumbnails", "thumbs", "#recycle", "#snapshot", "$recycle.bin"}
HERE = "Here are {}: pictures belong as PNG or JPEG into positive/, negative/ and unlabelled/, numbers into arrays."
RENAME = "Rename one or take it out; films of one name may differ in their suffix."
NAMED = 4  # the most columns that a message names
IN_FLOAT32 = "have values that float32 makes infinite, 0 or equal, or that are not finite"


@dataclass(frozen=True)
class Episode:
    """Frames in order, which are a recorded episode, one picture, or a set of arrays.

    Attributes:
        name: the episode's name in messages and in tables of labels.
        length: T, the number of frames.
        observations: by key, an array (T, ...), or a function that takes rising numbers of frames and returns these
            frames' observations one after another. Without keys, the only key is "".
        columns: by name, values (T,) that may label frames.
        role: one of ``ROLES``, or empty if the whole episode may get any role.
        group: the name of the group with which frames are held out, or names (T,). Empty: the frames have no group.
    """

    name: str
    length: int
    observations: Mapping[str, Any]
    columns: Mapping[str, Array]
    role: str = ""
    group: str | Array = ""


def files_of(folder: Path, suffixes: Collection[str], left: Counter[str]) -> list[Path]:
    """Return the visible files with one of ``suffixes`` in a folder and in the folders below it, sorted.

    Links are followed, but each folder is visited once. Other files are counted in ``left``, by suffix, and so are
    folders that a system keeps for itself, or to which a link leads back.
    """
    taken = []
    passed = {*folder.resolve().parents}
    for place, folders, names in os.walk(folder, followlinks=True):
        inside, real = Path(place), Path(place).resolve()
        inner = inside.relative_to(folder).name
        if inner.startswith("@") or inner.lower() in ASIDE or real in passed:
            left[f"folders {inner!r}"] += 1
            folders.clear()
            continue
        passed.add(real)
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        for name in names:
            file = inside / name
            suffix = file.suffix.lower()
            if name.startswith("."):
                continue
            if suffix in suffixes:
                taken.append(file)
            else:
                left[suffix or name] += 1
    return sorted(taken)


class Frames(NamedTuple):
    """Frames of all episodes in order, and what is known of them.

    Attributes:
        table: a row for each frame, kept or not, with its ``name`` in messages, its ``episode``, ``group`` and
            ``role`` or ``UNJUDGED``, and whether the frame is ``kept``.
        columns: the episodes' columns, a row for each frame.
        seen: by key, a picture or numbers for each frame that is kept. If there is one key, it is "".
        channels: frames and colours of stacked pictures by key, see :class:`hypogoal.data.Collected`.
    """

    table: DataFrame
    columns: DataFrame
    seen: dict[str, list[Array]]
    channels: dict[str, tuple[int, int]]


def frames_of(
    source: Path,
    episodes: Iterable[Episode],
    left: Counter[str],
    *,
    keys: Sequence[str] = (),
    every: int = 1,
    resize: int = 0,
    stack: bool = False,
) -> Frames:
    """Read the frames of episodes. What is not read is counted in ``left``.

    Args:
        keys: the keys of observations to read. Empty: all keys.
        every: n, if each n-th frame is kept, counted back from an episode's last frame.
        resize: the most pixels on the longer side of a picture. 0: pictures keep their size.
        stack: whether axes of frames and colours become channels.
    """
    tables, columns = [], []
    episode_names = set()
    seen: dict[str, list[Array]] = {}
    channels = {}
    with reading(source):
        for episode in episodes:
            length = episode.length
            if not length:
                left["episodes without frames"] += 1
                continue
            frames = range(length)
            if episode.name in episode_names:
                raise UserError("two episodes have one name", episode.name, RENAME)
            episode_names.add(episode.name)
            names = [f"{episode.name}[{frame}]" for frame in frames]
            kept = slice((length - 1) % every, length, every)
            table = DataFrame({"name": names, "episode": episode.name, "group": episode.group, "role": episode.role})
            table["kept"] = np.isin(frames, frames[kept])
            tables.append(table)
            columns.append(DataFrame(episode.columns, index=table.index))
            parts = _parts(episode, keys, kept, left)
            if seen and seen.keys() != parts.keys():
                raise UserError("episodes have different observations", episode.name, "Choose some by --key.")
            for key, states in parts.items():
                so_far = seen.setdefault(key, [])
                for name, state in zip(names[kept], states, strict=True):
                    taken, stacked = take(state, f"{name} {key}", resize, stack)
                    so_far.append(taken)
                    if stacked:
                        channels[key] = stacked
    if not seen:
        raise UserError("there are no pictures or numbers", source, HERE.format(", ".join(left) or "no files"))
    table = pd.concat(tables, ignore_index=True)
    return Frames(table, pd.concat(columns, ignore_index=True), seen, channels)


def _parts(
    episode: Episode,
    keys: Sequence[str],
    kept: slice,
    left: Counter[str],
) -> dict[str, Iterable[Any]]:
    """Return the observations in the frames that are kept, by key. Without ``keys``, all pictures and numbers are read.

    If there are several keys, a / in a key becomes a dot, because keys become names of fields. Raises ``UserError`` if
    a key is unknown, if its observations have another length, or if nothing can be read.
    """
    parts = {}
    for key in sorted({*keys} or episode.observations):
        values: Any = episode.observations.get(key)
        dtype = getattr(values, "dtype", np.dtype(object))
        name = key.replace("/", ".")
        if name in parts:
            raise UserError("two keys have one name, since / becomes a dot", key, "Rename one of them.")
        if callable(values):
            parts[name] = values(np.arange(episode.length)[kept])
        elif dtype.kind in "iufb":
            if len(values) != episode.length:
                fault = f"{len(values)} states of {key!r}, {episode.length} of others"
                raise UserError(fault, episode.name, "Give as many of each.")
            parts[name] = values[kept]
        elif keys:
            names = ", ".join(episode.observations)
            raise UserError(f"no pictures or numbers {key!r}", episode.name, f"Its keys are {names}.")
        else:
            left[f"times {key!r}, neither pictures nor numbers"] += 1
    if not parts:
        raise UserError("these are neither pictures nor numbers", episode.name, CLEARLY)
    if len(parts) > 1:
        return parts
    return dict(zip([""], parts.values(), strict=False))


def take(
    state: Array,
    where: str,
    side: int = 0,
    stack: bool = False,
) -> tuple[Array, tuple[int, int] | None]:
    """Return a state, as a picture, uint8 (H, W, C), or as numbers, and how its channels are stacked.

    The second value is how many frames of how many colours a picture's channels are, or None if nothing was stacked.
    Raises ``UserError`` if the state cannot be read, or can be read in two ways.

    Args:
        side: the most pixels on a picture's longer side. 0: the picture keeps its size.
        stack: whether axes of frames and colours become channels.
    """
    kind = reading_of(state.shape, state.dtype)
    fault = kind.fault
    is_stack = bool(fault) and len(kind.axes) > 2
    are_numbers = state.dtype.kind in "iufb"
    if not are_numbers or not state.size:
        fault = "are neither pictures nor numbers"
    if fault and not (is_stack and stack):
        do = STACKED if is_stack else CLEARLY
        raise UserError(f"{where} {fault}", f"{state.dtype} {state.shape}", do)
    if kind.dtype != PICTURE:
        return state.reshape(kind.shape), None
    picture = kind.arranged(state)
    small = shrunk_picture(picture, side)
    if not is_stack:
        return small, None
    last = state.shape[kind.axes[-1]]
    colours = last if last in (1, 3) else 1
    return small, (small.shape[2] // colours, colours)


def together(states: Sequence[Array], names: Sequence[str], subject: str) -> Array:
    """Return states of one size as one array (N, ...), of pictures or of numbers, float32.

    If some pictures are coloured, grey pictures become coloured. Raises ``UserError`` if states differ in size or type.
    """
    if {state.shape[2:] for state in states} == {(1,), (3,)}:
        states = [state.repeat(3 // state.shape[2], axis=2) for state in states]
    first = states[0]
    for state, name in zip(states, names, strict=True):
        are_alike = (state.dtype == PICTURE) == (first.dtype == PICTURE)
        if state.shape != first.shape or not are_alike:
            do = "Make them all pictures, or numbers, of one size; --resize makes large pictures smaller."
            sizes = f"{name} is {state.shape}, {names[0]} is {first.shape}"
            raise UserError("states differ in size or type", sizes, do)
    values = np.stack(states)
    if values.ndim == 4 and values.dtype == PICTURE:
        return values
    return as_numbers(values, subject)


def as_numbers(values: Array, subject: str) -> Floats:
    """Return numbers (N, ...) as float32.

    Raises ``UserError`` if a column has values that are not finite, or that float32 cannot hold or tell apart.
    """
    with np.errstate(over="ignore", under="ignore"):
        cast = values.astype(NUMBERS)
    count = len(values)
    before, after = values.reshape(count, -1), cast.reshape(count, -1)
    lost = ~np.isfinite(after) | ((after == 0) != (before == 0))
    rows = spread_rows(count, MOST_COMPARED)
    distinct = DataFrame(before[rows]).nunique()
    merged = DataFrame(after[rows]).nunique() < LEFT * distinct
    columns = np.flatnonzero(lost.any(axis=0) | merged)
    if len(columns):
        named = ", ".join(map(str, columns[:NAMED]))
        where = f"{len(columns)} columns, such as {named}"
        do = "Give finite ones; subtract an offset, change the unit, or leave these columns out."
        raise UserError(f"{subject} {IN_FLOAT32}", where, do)
    return cast
