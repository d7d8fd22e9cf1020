"""Recorded episodes of any format: which frames are positive, and which whole episodes are held out.

A reader is a generator of :class:`Recording`; choosing keys and frames, labelling, splitting and resizing are written
once, here.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from hypogoal.core.config import meant
from hypogoal.core.errors import UserError
from hypogoal.core.seeding import rng_for
from hypogoal.importing.files import reading
from hypogoal.importing.parts import Given, Parts
from hypogoal.importing.taken import side_of, stacked, taken_one

SPLIT = np.array([0.4, 0.4, 0.2])  # shares of episodes that are labelled, unlabelled and held out
AGAIN = "Record or download it again."

Rows: TypeAlias = NDArray[np.int64]
Mark: TypeAlias = Callable[[int, Any], bool]  # of a frame, from its number and what is seen: does the sub-goal hold?


@dataclass(frozen=True)
class Recording:
    """T frames.

    Attributes:
        observations: by key, a function from rising numbers of frames to what is seen in these, one after another.
        columns: (T,) by name, which may label frames.
        texts: keys of observations that are neither pictures nor numbers.
        held_out: whether the recording says that it is for evaluation.
    """

    name: str
    length: int
    observations: Mapping[str, Callable[[Rows], Iterable[Any]]]
    columns: Mapping[str, NDArray[Any]]
    texts: Sequence[str] = ()
    held_out: bool = False


class Rule(NamedTuple):
    """What labels a sub-goal: from an episode to its marks (None: it has no labels); and the episodes of a table."""

    marks: Callable[[Recording], Mark | None]
    listed: Mapping[str, str] = {}  # where the table names each


def episode_of(name: str, observations: Any, columns: Mapping[str, Any], *, held_out: bool = False) -> Recording:
    """An episode whose observations are arrays (T, ...) in nested dictionaries, HDF5 groups or tuples."""
    found = _leaves(observations)
    arrays = {key: values for key, values in found.items() if _kind(values) in "iufb"}
    lengths = {len(values) for values in arrays.values()}
    if len(lengths) > 1:
        raise ValueError(f"the observations of {name} have different lengths, {sorted(lengths)}")
    rows = {key: partial(_rows, values) for key, values in arrays.items()}
    texts = sorted(found.keys() - arrays.keys())
    return Recording(name, max(lengths, default=0), rows, columns, texts, held_out)


def _leaves(values: Any, place: str = "") -> dict[str, Any]:
    """The arrays by key: ``robot/position``; of an observation that is not nested by ""."""
    if isinstance(values, tuple):
        values = dict(enumerate(values))
    if not hasattr(values, "items"):
        return {place: values}
    found = {}
    for key, part in values.items():
        found.update(_leaves(part, f"{place}/{key}" if place else str(key)))
    return found


def _kind(values: Any) -> str:
    return str(getattr(getattr(values, "dtype", None), "kind", "O"))


def _rows(values: Any, rows: Rows) -> Iterable[Any]:
    return np.asarray(values)[rows]


def kept(length: int, every: int) -> Rows:
    """Every n-th frame of an episode, and always its last."""
    return np.arange((length - 1) % every, length, every)


@dataclass
class _Taken:
    """What is taken of an episode: frames by key, their names, and labels (T, G)."""

    listed: bool
    held_out: bool
    frames: dict[str, list[NDArray[Any]]] = field(default_factory=dict)
    names: list[str] = field(default_factory=list)
    labels: list[list[bool]] = field(default_factory=list)


def recorded_parts(
    source: Path,
    episodes: Iterable[Recording],
    rules: Mapping[str, Rule],
    *,
    keys: Sequence[str] = (),
    every: int = 1,
    sides: Mapping[str, int] | None = None,
    stack: bool = False,
    seed: int = 0,
) -> tuple[Parts, list[str]]:
    """The frames of a recording, whole episodes labelled, unlabelled or held out; and lines on what is not read.

    ``rules`` say for each sub-goal which frames are positive; an episode that some rule does not list is unlabelled.
    Held out are the episodes of which the recording says so, else some drawn by ``seed``. ``sides``, ``stack``: see
    :func:`taken_one`.
    """
    if not rules:
        do = "Give --label NAME=COLUMN, NAME=last:N, NAME=TABLE.csv or NAME=module:function."
        raise UserError("nothing says where the sub-goal holds", source, do)
    taken: dict[str, _Taken] = {}
    texts: set[str] = set()
    empty: list[str] = []
    fields: list[str] = []
    for episode in episodes:
        where = f"{source}, {episode.name}"
        if episode.name in taken:
            raise UserError("two episodes have one name", where, "Rename one.")
        if not episode.length:
            empty.append(episode.name)
            continue
        chosen = _chosen(episode, keys, where)
        if chosen != (fields or chosen):
            raise UserError("episodes have different observations", where, "Choose some by --key.")
        fields = chosen
        texts.update(() if keys else episode.texts)
        frames = _frames(episode, chosen, kept(episode.length, every), source)
        marks = [rule.marks(episode) for rule in rules.values()]
        taken[episode.name] = _take(episode, frames, marks, sides or {}, stack)
    for rule in rules.values():
        _require_listed(rule, [*taken])
    all_taken = [*taken.values()]
    parts = split_episodes([one.listed for one in all_taken], [one.held_out for one in all_taken], seed, source)
    labelled, unlabelled, heldout = [_given([all_taken[at] for at in part], fields) for part in parts]
    said = [f"not read: {', '.join(sorted(texts))}, neither pictures nor numbers"] if texts else []
    said += [f"not read: {len(empty)} of {len(empty) + len(taken)} episodes, without frames"] if empty else []
    return Parts(labelled, unlabelled, heldout, tuple(rules)), said


def _chosen(episode: Recording, keys: Sequence[str], where: str) -> list[str]:
    """The keys to read, all if none are given; an unknown one is a ``UserError``."""
    known = sorted(episode.observations)
    for key in keys:
        if key not in known:
            raise UserError(f"no observation {key!r}", where, meant(key, known) or f"It has {', '.join(known)}.")
    if not known:
        raise UserError("it has no observations", where, "Give a recording with some.")
    return sorted(set(keys)) or known


def _frames(episode: Recording, keys: Sequence[str], rows: Rows, source: Path) -> Iterator[tuple[int, dict[str, Any]]]:
    """The frames of an episode with their numbers, by key, as read."""
    with reading(source, AGAIN):
        values = [episode.observations[key](rows) for key in keys]
        for row, *seen in zip(rows.tolist(), *values, strict=True):
            yield row, dict(zip(keys, seen, strict=True))


def _take(
    episode: Recording,
    frames: Iterable[tuple[int, dict[str, Any]]],
    marks: Sequence[Mark | None],
    sides: Mapping[str, int],
    stack: bool,
) -> _Taken:
    """Label frames as they are read, then make them pictures or numbers."""
    known = [mark for mark in marks if mark is not None]
    taken = _Taken(len(known) == len(marks), episode.held_out)
    for row, frame in frames:
        name = f"{episode.name}, frame {row}"
        if taken.listed:
            seen = frame if len(frame) > 1 else next(iter(frame.values()))
            taken.labels.append([mark(row, seen) for mark in known])
        for key, value in frame.items():
            state = taken_one(value, f"{name}: {key or 'it'}", side_of(sides, key, True), stack)
            taken.frames.setdefault(key, []).append(state)
        taken.names.append(name)
    return taken


def _given(episodes: Sequence[_Taken], keys: Sequence[str]) -> Given:
    """The frames of some episodes, one after another."""
    names = [*chain.from_iterable(one.names for one in episodes)]
    labels = [*chain.from_iterable(one.labels for one in episodes)]
    states = {}
    for key in keys:
        frames = [*chain.from_iterable(one.frames[key] for one in episodes)]
        states[key] = stacked(frames, names)
    return Given(states if len(keys) > 1 else states[keys[0]], names, np.array(labels, dtype=np.bool_))


def _require_listed(rule: Rule, names: Sequence[str]) -> None:
    """Refuse (``UserError``) a table that lists an episode which there is not."""
    for name, where in rule.listed.items():
        if name not in names:
            known = f"They are {names[0]} to {names[-1]}." if names else "There are none."
            raise UserError(f"a label is of an unknown episode, {name!r}", where, known)


def split_episodes(
    listed: Sequence[bool], held_out: Sequence[bool], seed: int, where: object
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """The episodes that are labelled, unlabelled and held out: ``SPLIT`` of those ``listed``, the others unlabelled.

    Those that the recording holds out are, and no others then.
    """
    known, fixed = np.array(listed, np.bool_), np.array(held_out, np.bool_)
    others, given = np.flatnonzero(~known), np.flatnonzero(known & fixed)
    free = np.flatnonzero(known & ~fixed)
    order = free[rng_for(seed, "minari").permutation(len(free))]
    wanted = np.array([True, not len(others), not len(given)])
    if len(order) < wanted.sum():
        roles = ["labelled", *["unlabelled"] * (not len(others)), *["held out"] * (not len(given))]
        fault = f"{len(order)} episodes cannot be {', '.join(roles)}"
        raise UserError(fault, where, f"Give at least {wanted.sum()}, with labels.")
    shares = np.cumsum(SPLIT * wanted)
    ends = np.round(shares[:2] / shares[2] * len(order)).astype(int)
    least, rest = np.cumsum(wanted)[:2], np.array([wanted[1:].sum(), wanted[2]])
    labelled, unlabelled, heldout = np.split(order, np.clip(ends, least, len(order) - rest))
    return labelled, np.concatenate([unlabelled, others]), np.concatenate([heldout, given])
