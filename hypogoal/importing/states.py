"""From episodes to their frames, whatever they were read from: chosen and taken."""

from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from hypogoal.core.errors import UserError
from hypogoal.core.files import AGAIN, reading
from hypogoal.importing.episodes import Array, Episode
from hypogoal.importing.taken import take


class Frames(NamedTuple):
    """States in order, and what is known of them.

    Attributes:
        table: a row for each frame, also those of which nothing is seen: ``name`` in messages, ``episode``, ``group``,
            ``role``, whether it is ``kept``.
        columns: of the episodes, a row for each frame.
        seen: by key, a picture or numbers of each frame that is kept; by "" if there is one key.
        channels: frames and colours of stacks by key, see :class:`hypogoal.data.Collected`.
    """

    table: pd.DataFrame
    columns: pd.DataFrame
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
    """The frames of episodes; ``left`` counts what is not read.

    Args:
        keys: of observations; none: all.
        every: keep each n-th frame, and the last.
        resize: most pixels on the longer side of pictures; 0: as many as they have.
        stack: axes of frames and colours become channels.
    """
    tables, columns = [], []
    seen: dict[str, list[Array]] = {}
    channels: dict[str, tuple[int, int]] = {}
    with reading(source):
        for episode in episodes:
            length = episode.length
            if not length:
                left["episodes without frames"] += 1
                continue
            frames = range(length)
            names = [f"{episode.name}[{frame}]" for frame in frames]
            kept = slice((length - 1) % every, length, every)
            table = pd.DataFrame({"name": names, "episode": episode.name, "group": episode.group, "role": episode.role})
            table["kept"] = np.isin(frames, frames[kept])
            tables.append(table)
            columns.append(pd.DataFrame(episode.columns, index=table.index))
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
        raise UserError("there are no pictures or numbers", source, AGAIN)
    table = pd.concat(tables, ignore_index=True)
    return Frames(table, pd.concat(columns, ignore_index=True), seen, channels)


def _parts(
    episode: Episode,
    keys: Sequence[str],
    kept: slice,
    left: Counter[str],
) -> dict[str, Iterable[Any]]:
    """What is seen in the frames that are kept, by key, of all pictures and numbers if no keys are given.

    An unknown key is a ``UserError``. In the names of several keys / becomes a dot, since they are names of fields.
    """
    parts: dict[str, Iterable[Any]] = {}
    for key in sorted({*keys} or episode.observations):
        values: Any = episode.observations.get(key)
        dtype = getattr(values, "dtype", np.dtype(object))
        name = key.replace("/", ".")
        if callable(values):
            parts[name] = values(np.arange(episode.length)[kept])
        elif dtype.kind in "iufb":
            parts[name] = values[kept]
        elif keys:
            names = ", ".join(episode.observations)
            raise UserError(f"no pictures or numbers {key!r}", episode.name, f"Its keys are {names}.")
        else:
            left[f"times {key!r}, neither pictures nor numbers"] += 1
    if len(parts) > 1:
        return parts
    return dict(zip([""], parts.values(), strict=False))
