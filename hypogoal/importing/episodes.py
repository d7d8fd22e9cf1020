"""Recorded episodes of any format: which frames are positive, and which whole episodes are held out.

A reader is a generator of :class:`Recording`; choosing keys and frames, labelling, splitting and resizing are written
once, here.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from hypogoal.core.config import near
from hypogoal.core.errors import UserError
from hypogoal.core.seeding import rng_for
from hypogoal.data import Integers
from hypogoal.importing.files import reading
from hypogoal.importing.parts import Array, Given, Parts
from hypogoal.importing.taken import Taking, channels_of, stacked

SPLIT = np.array([0.4, 0.4, 0.2])  # shares of episodes that are labelled, unlabelled and held out
AGAIN = "Record or download it again."
NO_RULE = "Give --label NAME=COLUMN, NAME=last:N, NAME=TABLE.csv or NAME=module:function."

Mark: TypeAlias = Callable[[int, Any], bool]  # of a frame, from its number and what is seen: does the sub-goal hold?


@dataclass(frozen=True)
class Recording:
    """An episode of T frames.

    Attributes:
        observations: by key, a function from rising numbers of frames to what is seen in these, one after another.
        columns: (T,) by name, which may label frames.
        texts: keys of observations that are neither pictures nor numbers.
        held_out: whether the recording says that it is for evaluation.
    """

    name: str
    length: int
    observations: Mapping[str, Callable[[Integers], Iterable[Any]]]
    columns: Mapping[str, Array]
    texts: Sequence[str] = ()
    held_out: bool = False


class Rule(NamedTuple):
    """What labels a sub-goal: from an episode to its marks (None: it has no labels); and the episodes of a table."""

    marks: Callable[[Recording], Mark | None]
    listed: Mapping[str, str] = {}  # where the table names each


def recording_of(name: str, observations: Any, columns: Mapping[str, Any], *, held_out: bool = False) -> Recording:
    """An episode whose observations are arrays (T, ...) in nested dictionaries, HDF5 groups or tuples."""
    leaves = _leaves(observations, "")
    arrays = {key: part for key, part in leaves.items() if getattr(part, "dtype", np.dtype(object)).kind in "iufb"}
    lengths = {len(values) for values in arrays.values()}
    if len(lengths) > 1:
        raise ValueError(f"the observations of {name} have different lengths, {sorted(lengths)}")
    rows = {key: partial(_rows, values) for key, values in arrays.items()}
    return Recording(name, max(lengths, default=0), rows, columns, sorted(leaves.keys() - arrays.keys()), held_out)


def _leaves(values: Any, place: str) -> dict[str, Any]:
    """The arrays by key: ``robot/position``; of an observation that is not nested by ""."""
    parts = dict(enumerate(values)) if isinstance(values, tuple) else values
    if not hasattr(parts, "items"):
        return {place: values}
    leaves = {}
    for key, part in parts.items():
        leaves.update(_leaves(part, f"{place}/{key}" if place else str(key)))
    return leaves


def _rows(values: Any, rows: Integers) -> Iterable[Any]:
    return np.asarray(values)[rows]


def kept(length: int, every: int) -> Integers:
    """Every n-th frame of an episode, and always its last."""
    return np.arange((length - 1) % every, length, every)


def recorded_parts(
    source: Path,
    recordings: Iterable[Recording],
    rules: Mapping[str, Rule],
    taking: Taking,
    *,
    keys: Sequence[str] = (),
    every: int = 1,
    seed: int = 0,
) -> tuple[Parts, list[str]]:
    """The frames of a recording, whole episodes labelled, unlabelled or held out; and lines on what is not read.

    ``rules`` say for each sub-goal which frames are positive; an episode that some rule does not list is unlabelled.
    Held out are the episodes of which the recording says so, else some drawn by ``seed``.
    """
    if not rules:
        raise UserError("nothing says where the sub-goal holds", source, NO_RULE)
    taken = _Taken(taking)
    texts: set[str] = set()
    empty = 0
    for recording in recordings:
        if not recording.length:
            empty += 1
            continue
        where = f"{source}, {recording.name}"
        chosen = _chosen(recording, keys, where)
        if taken.frames and chosen != [*taken.frames]:
            raise UserError("episodes have different observations", where, "Choose some by --key.")
        texts.update(() if keys else recording.texts)
        frames = _frames(recording, chosen, kept(recording.length, every), source)
        taken.add(recording, frames, [rule.marks(recording) for rule in rules.values()])
    for rule in rules.values():
        for name in rule.listed.keys() - taken.episodes.keys():
            examples = f"There are {', '.join([*taken.episodes][:3])} ..."
            raise UserError(f"a label is of an unknown episode, {name!r}", rule.listed[name], examples)
    remarks = [f"not read: {', '.join(sorted(texts))}, neither pictures nor numbers"] if texts else []
    if empty:
        remarks.append(f"not read: {empty} of {empty + len(taken.episodes)} episodes, without frames")
    parts = split_episodes(taken.listed, taken.held_out, seed, source)
    labelled, unlabelled, heldout = [taken.given(part) for part in parts]
    channels = taken.channels
    if len(taken.frames) == 1:  # its key is left out
        channels = dict(zip([""], channels.values(), strict=False))
    return Parts(labelled, unlabelled, heldout, tuple(rules), channels=channels), remarks


def _chosen(recording: Recording, keys: Sequence[str], where: str) -> list[str]:
    """The keys to read, all if none are given; an unknown one is a ``UserError``."""
    present = sorted(recording.observations)
    for key in keys:
        if key not in present:
            raise UserError(f"no observation {key!r}", where, near(key, present) or f"It has {', '.join(present)}.")
    if not present:
        raise UserError("it has no observations", where, "Give a recording with some.")
    return sorted(set(keys)) or present


def _frames(recording: Recording, keys: Sequence[str], rows: Integers, source: Path) -> Iterator[tuple[int, Any]]:
    """The numbers of frames, and what is seen in each, by key, as read."""
    with reading(source, AGAIN):
        values = [recording.observations[key](rows) for key in keys]
        for row, *seen in zip(rows.tolist(), *values, strict=True):
            yield row, dict(zip(keys, seen, strict=True))


class _Taken:
    """The frames of all episodes, one after another.

    Attributes:
        episodes: where the frames of each begin and end.
        frames: by key, as pictures or numbers.
    """

    def __init__(self, taking: Taking):
        self.taking = taking
        self.episodes: dict[str, Integers] = {}
        self.listed: list[bool] = []
        self.held_out: list[bool] = []
        self.names: list[str] = []
        self.labels: list[list[bool]] = []
        self.frames: dict[str, list[Array]] = {}
        self.channels: dict[str, tuple[int, int]] = {}

    def add(self, recording: Recording, frames: Iterable[tuple[int, Any]], marks: Sequence[Mark | None]) -> None:
        """Label an episode's frames as they are read, then make them pictures or numbers."""
        if recording.name in self.episodes:
            raise UserError("two episodes have one name", recording.name, "Rename one.")
        first = len(self.names)
        listed = None not in marks
        for row, frame in frames:
            name = f"{recording.name}, frame {row}"
            seen = frame if len(frame) > 1 else next(iter(frame.values()))
            self.names.append(name)
            self.labels.append([bool(listed and mark and mark(row, seen)) for mark in marks])
            for key, value in frame.items():
                self.channels.update(channels_of(value, key))
                self.frames.setdefault(key, []).append(self.taking.one(value, key, f"{name}: {key or 'it'}"))
        self.episodes[recording.name] = np.arange(first, len(self.names))
        self.listed.append(listed)
        self.held_out.append(recording.held_out)

    def given(self, episodes: Integers) -> Given:
        """The frames of some episodes."""
        spans = [*self.episodes.values()]
        rows = np.concatenate([spans[episode] for episode in episodes])
        names = [self.names[row] for row in rows]
        states = {}
        for key, frames in self.frames.items():
            states[key if len(self.frames) > 1 else ""] = stacked([frames[row] for row in rows], names)
        return Given(states, names, np.array(self.labels)[rows])


def split_episodes(
    listed: Sequence[bool], held_out: Sequence[bool], seed: int, where: object
) -> tuple[Integers, Integers, Integers]:
    """The episodes that are labelled, unlabelled and held out: ``SPLIT`` of those ``listed``, the others unlabelled.

    Those that the recording holds out are, and no others then.
    """
    is_listed, fixed = np.array(listed, np.bool_), np.array(held_out, np.bool_)
    others, fixed_rows, free = (np.flatnonzero(some) for some in (~is_listed, is_listed & fixed, is_listed & ~fixed))
    order = free[rng_for(seed, "minari").permutation(len(free))]
    wanted = np.array([1, not len(others), not len(fixed_rows)])
    if len(order) < wanted.sum():
        roles = [role for role, want in zip(("labelled", "unlabelled", "held out"), wanted, strict=True) if want]
        fault = f"{len(order)} episodes cannot be {', '.join(roles)}"
        raise UserError(fault, where, f"Give at least {wanted.sum()}, with labels.")
    shares = np.cumsum(SPLIT * wanted)
    ends = np.round(shares[:2] / shares[2] * len(order)).astype(int)
    ends = np.clip(ends, wanted.cumsum()[:2], len(order) - wanted[::-1].cumsum()[1::-1])
    labelled, unlabelled, heldout = np.split(order, ends)
    return labelled, np.concatenate([unlabelled, others]), np.concatenate([heldout, fixed_rows])
