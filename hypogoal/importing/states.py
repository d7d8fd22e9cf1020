"""From episodes to their frames, whatever they were read from: chosen, labelled and taken."""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from hypogoal.core.config import near
from hypogoal.core.errors import UserError
from hypogoal.data import Integers
from hypogoal.importing.episodes import UNLABELLED, Array, Episode
from hypogoal.importing.files import reading
from hypogoal.importing.labels import Rule, is_marked
from hypogoal.importing.taken import take
from hypogoal.observations import PICTURE

NO_RULE = "Give --label NAME=COLUMN, NAME=last:N, NAME=TABLE.csv or NAME=module:function."


class Frame(NamedTuple):
    """A state, and what is known of it.

    Attributes:
        name: what messages call it.
        episode: of which it is, by name.
        group: see :class:`Episode`.
        labels: whether each sub-goal holds; False where it is unlabelled.
        seen: a picture or numbers by key.
        channels: frames and colours by key, see :class:`hypogoal.data.Collected`.
    """

    name: str
    episode: str
    group: str
    role: str
    labels: list[bool]
    seen: dict[str, Array]
    channels: dict[str, tuple[int, int] | None]


def frames_of(
    source: Path,
    episodes: Iterable[Episode],
    rules: Mapping[str, Rule],
    left: Counter[str],
    *,
    keys: Sequence[str] = (),
    every: int = 1,
    sides: Mapping[str, int] | None = None,
    stack: bool = False,
) -> Iterator[Frame]:
    """The frames of episodes, labelled by a rule for each sub-goal; ``left`` counts what is not read.

    An episode that some rule does not list is unlabelled.

    Args:
        keys: of observations; none: all.
        every: each n-th frame, and the last.
        sides: most pixels on the longer side of pictures, by key; "" is of all that have none of their own.
        stack: axes of frames and colours become channels.
    """
    if not rules:
        raise UserError("nothing says where the sub-goal holds", source, NO_RULE)
    sides = sides or {}
    met: list[str] = []
    taken: dict[str, Array] = {}
    for episode in episodes:
        if not episode.length:
            left["episodes without frames"] += 1
            continue
        met.append(episode.name)
        chosen = _chosen(episode, keys, source, left)
        marks = [rule.marks(episode) for rule in rules.values()]
        role = UNLABELLED if any(mark is None for mark in marks) else episode.role
        rows = kept(episode.length, every)
        for row, seen in zip(rows.tolist(), _seen(episode, chosen, rows, source), strict=True):
            name = f"{episode.name}, frame {row}" if episode.length > 1 else episode.name
            view = seen if len(chosen) > 1 else seen[chosen[0]]
            labels = [role != UNLABELLED and is_marked(mark, row, view) for mark in marks]
            taken, channels = {}, {}
            for key, state in seen.items():
                side = sides.get(key, sides.get("", 0))
                taken[key], channels[key] = take(state, f"{name}: {key or 'observations'}", side, stack)
            yield Frame(name, episode.name, episode.group, role, labels, taken, channels)
    for rule in rules.values():
        for name in rule.listed.keys() - met:
            examples = f"There are {', '.join(met[:3])} ..."
            fault = f"a label is of an unknown episode, {name!r}"
            raise UserError(fault, rule.listed[name], examples)
    pictures = [key for key, state in taken.items() if state.ndim == 3 and state.dtype == PICTURE]
    for key in sides:
        if not pictures or key not in ("", *pictures):
            raise UserError("only pictures can be resized", key or source, "Leave out --resize.")


def kept(length: int, every: int) -> Integers:
    """Every n-th frame of an episode, and always its last."""
    return np.arange((length - 1) % every, length, every)


def _chosen(
    episode: Episode,
    keys: Sequence[str],
    source: Path,
    left: Counter[str],
) -> list[str]:
    """The keys to read, all of pictures and numbers if none are given; an unknown one is a ``UserError``."""
    present = []
    for key, values in sorted(episode.observations.items()):
        dtype = getattr(values, "dtype", np.dtype(object))
        if callable(values) or dtype.kind in "iufb":
            present.append(key)
        elif not keys:
            left[f"times {key!r}, neither pictures nor numbers"] += 1
    chosen = sorted(set(keys)) or present
    for key in chosen or [""]:
        if key not in present:
            names = ", ".join(present) or "none"
            do = near(key, present) or f"There are {names}."
            where = f"{source}, {episode.name}"
            raise UserError(f"no pictures or numbers {key!r}", where, do)
    return chosen


def _seen(
    episode: Episode,
    keys: Sequence[str],
    rows: Integers,
    source: Path,
) -> Iterator[dict[str, Array]]:
    """What is seen in some frames, by key, as read."""
    with reading(source):
        parts: list[Iterable[Any]] = []
        for key in keys:
            values = episode.observations[key]
            parts.append(values(rows) if callable(values) else np.asarray(values)[rows])
        for states in zip(*parts, strict=True):
            yield dict(zip(keys, map(np.asarray, states), strict=True))
