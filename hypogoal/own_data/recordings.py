"""Recorded episodes of any format: which frames are positive, which whole episodes are held out, and their states."""

from __future__ import annotations

import csv
import io
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hypogoal.core.config import meant
from hypogoal.core.errors import UserError
from hypogoal.core.files import read_text
from hypogoal.core.seeding import rng_for
from hypogoal.dataset import PICTURE, Fields, Observations, mixed_type
from hypogoal.domains.observations import shrunk_picture
from hypogoal.own_data.parts import Parts, require_memory

SPLIT = (0.4, 0.4, 0.2)  # shares of episodes that are labelled, unlabelled and held out
LAST, TABLE = "last:", ".csv"  # how rules begin and end that are no columns
COLUMNS = ("episode", "from", "to")  # of a table of positive frames; ``to`` is the first frame behind them
SUCCESS = ("next.success", "success", "next.reward", "reward", "rewards")  # columns that say so, the first there is
Frames = Mapping[str, Observations]  # by key, (rows, *shape) each, to be filled


class Recording(ABC):
    """Episodes of T frames each, whose frames are read last, each once."""

    path: Path
    names: Sequence[str]  # of the episodes
    lengths: Sequence[int]  # T of each
    columns: Sequence[str]  # that can label frames
    fields: Fields  # type and shape of what is read, by key, pictures as they will be stored

    @abstractmethod
    def column(self, episode: int, name: str) -> NDArray[Any]:
        """A column's values for an episode's frames, (T,)."""

    @abstractmethod
    def fill(self, frames: Mapping[int, Frames], every: int) -> None:
        """Read the observations of episodes, the frames that :func:`kept` has of each, into their places."""

    def succeeded(self, episode: int) -> bool:
        """Whether the first of ``SUCCESS`` that there is, is above 0 anywhere in an episode; True without any."""
        name = next((name for name in SUCCESS if name in self.columns), None)
        return name is None or bool((self.column(episode, name) > 0).any())


def kept(length: int, every: int) -> NDArray[np.int64]:
    """Every n-th frame of an episode, and always its last."""
    return np.arange((length - 1) % every, length, every)


def chosen_keys(keys: Sequence[str], known: Sequence[str], path: Path) -> list[str]:
    """The keys to read: all ``known`` ones if none are given; an unknown one is a ``UserError``."""
    for key in keys:
        if key not in known:
            do = meant(key, known) or f"It has {', '.join(known)}."
            raise UserError(f"no observation {key!r}", path, do)
    if not (keys or known):
        raise UserError("it has no observations", path, "Give a recording with some.")
    return sorted(set(keys or known))


def store(places: Frames, key: str, row: int, picture: NDArray[Any], where: object) -> None:
    """Shrink a frame, uint8 (H, W, C), into its place; of another size it is a ``UserError``."""
    place = places[key]
    longest = max(place.shape[1:3])
    small = shrunk_picture(picture, longest) if max(picture.shape[:2]) > longest else picture
    if small.shape != place.shape[1:] or small.dtype != PICTURE:
        fault = f"a frame of {key} is {picture.dtype} {picture.shape}, which does not match the other frames"
        raise UserError(fault, where, "Record it again, or leave that key out.")
    place[row] = small


def recorded_parts(recording: Recording, rules: Mapping[str, str], *, every: int = 1, seed: int = 0) -> Parts:
    """The frames of a recording; each whole episode is labelled, unlabelled or held out, drawn by ``seed``.

    ``rules`` say, for each sub-goal, which frames are positive: a column's values above 0; ``last:N`` frames of each
    successful episode; or a table, ``FILE.csv``, of ``COLUMNS``, where episodes that are not listed are unlabelled. Of
    each episode every n-th frame is taken.
    """
    if not rules:
        do = "Give --label NAME=COLUMN, NAME=last:N or NAME=TABLE.csv."
        raise UserError("nothing says where the sub-goal holds", recording.path, do)
    by_goal = [_marks(recording, rule) for rule in rules.values()]
    labels = [
        np.stack(marks, 1) if all(mark is not None for mark in marks) else None for marks in zip(*by_goal, strict=True)
    ]
    listed = [episode for episode, marks in enumerate(labels) if marks is not None]
    parts = split_episodes(len(labels), listed, seed, recording.path)
    frames = [kept(length, every) for length in recording.lengths]
    ends = np.cumsum([len(frames[episode]) for part in parts for episode in part])
    dtype = mixed_type(recording.fields)
    only = next(iter(recording.fields.items())) if len(recording.fields) == 1 else None
    require_memory(int(ends[-1]) * dtype.itemsize, recording.path)
    states = np.empty((ends[-1], *only[1][1]), only[1][0]) if only else np.empty(ends[-1], dtype)
    places = dict(zip(np.concatenate(parts).tolist(), np.split(states, ends[:-1]), strict=True))
    keys = recording.fields
    recording.fill(
        {episode: {key: rows if only else rows[key] for key in keys} for episode, rows in places.items()}, every
    )
    first, second = (sum(len(frames[episode]) for part in parts[:count] for episode in part) for count in (1, 2))

    def of(part: NDArray[np.int64]) -> NDArray[np.bool_]:
        return np.concatenate([marks[frames[episode]] for episode in part if (marks := labels[episode]) is not None])

    steps = [(recording.names[episode], int(frame)) for part in parts for episode in part for frame in frames[episode]]
    begin = {"observations": 0, "unlabelled": first, "heldout_observations": second}

    def name(field: str, row: int) -> str:
        return "{}, frame {}".format(*steps[begin[field] + row])

    split = states[:first], of(parts[0]), states[first:second], states[second:], of(parts[2])
    return Parts(*split, sub_goals=tuple(rules), name=name)


def split_episodes(
    count: int, listed: Sequence[int], seed: int, where: object
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """The episodes that are labelled, unlabelled and held out; those that are not ``listed`` are unlabelled."""
    order = np.array(listed, dtype=np.int64)[rng_for(seed, "minari").permutation(len(listed))]
    others = np.setdiff1d(np.arange(count), order)
    shares = np.array([SPLIT[0], SPLIT[1] * (not len(others)), SPLIT[2]])
    needed = 2 if len(others) else 3
    if len(order) < needed:
        fault = f"{len(order)} episodes cannot be labelled, {'' if len(others) else 'unlabelled '}and held out"
        raise UserError(fault, where, f"Give {needed}, with labels.")
    ends = np.round(np.cumsum(shares)[:2] / shares.sum() * len(order)).astype(int)
    low, high = (1, needed - 1), (len(order) - needed + 1, len(order) - 1)
    labelled, unlabelled, heldout = np.split(order, np.clip(ends, low, high))
    return labelled, np.concatenate([unlabelled, others]), heldout


def _marks(recording: Recording, rule: str) -> list[NDArray[np.bool_] | None]:
    """Which frames of each episode are positive, bool (T,); None for an episode that a table does not list."""
    if rule.endswith(TABLE):
        return _listed(recording, Path(rule))
    if rule.startswith(LAST):
        count = rule.removeprefix(LAST)
        if not count.isdecimal() or not int(count):
            raise UserError("the number of last frames is not above 0", rule, "Give last:10, for example.")
        last = [(np.arange(length) >= length - int(count)) for length in recording.lengths]
        return [mark & recording.succeeded(episode) for episode, mark in enumerate(last)]
    if rule not in recording.columns:
        known = ", ".join(recording.columns) or "none"
        do = meant(rule, recording.columns) or f"Its columns are {known}; last:N and TABLE.csv label, too."
        raise UserError(f"no column {rule!r} to label by", recording.path, do)
    marks: list[NDArray[np.bool_] | None] = []
    for episode in range(len(recording.names)):
        values = np.asarray(recording.column(episode, rule))
        fits = values.dtype.kind in "biuf" and values.size == recording.lengths[episode]
        if not fits or not np.isfinite(values).all():
            fault = f"the column {rule!r} of {recording.names[episode]} is not one number for each frame"
            raise UserError(fault, recording.path, "Give another.")
        marks.append(values.reshape(-1) > 0)
    return marks


def _listed(recording: Recording, table: Path) -> list[NDArray[np.bool_] | None]:
    """Positive frames by a table: of each row those from ``from`` up to, not including, ``to``."""
    rows = csv.DictReader(io.StringIO(read_text(table, "the table of labels is", "Give a CSV file.")))
    if not {*COLUMNS} <= {*(rows.fieldnames or ())}:
        raise UserError(
            f"the table of labels lacks a column of {', '.join(COLUMNS)}", table, "Name them in its first line."
        )
    marks: list[NDArray[np.bool_] | None] = [None] * len(recording.names)
    for number, row in enumerate(rows, 2):
        where, name = f"{table}, line {number}", str(row["episode"]).strip()
        if name not in recording.names:
            raise UserError(
                f"a label is of an unknown episode, {name!r}", where, f"Known are {_some(recording.names)}."
            )
        episode = recording.names.index(name)
        length = recording.lengths[episode]
        try:
            first, end = int(row["from"]), int(row["to"])
        except (TypeError, ValueError):
            raise UserError("a label has frames that are no integers", where, "Give from and to.") from None
        if not 0 <= first <= end <= length:
            fault = f"a label is of frames {first} up to {end}, episode {name} has {length}"
            raise UserError(fault, where, "Give 0 <= from <= to <= its frames.")
        mark = marks[episode]
        marks[episode] = mark = np.zeros(length, np.bool_) if mark is None else mark
        mark[first:end] = True
    return marks


def _some(names: Sequence[str]) -> str:
    return ", ".join(names) if len(names) < 6 else f"{', '.join(names[:3])}, ..., {names[-1]}"
