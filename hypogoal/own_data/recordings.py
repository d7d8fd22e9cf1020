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
from hypogoal.domains.observations import shrunk_picture
from hypogoal.observations import Fields, Observations, mixed_type
from hypogoal.own_data.parts import Parts

SPLIT = (0.4, 0.4, 0.2)  # shares of episodes that are labelled, unlabelled and held out
LAST, TABLE = "last:", ".csv"  # how rules begin and end that are no columns
COLUMNS = ("episode", "from", "to")  # of a table of positive frames; ``to`` is the first frame behind them
SUCCESS = ("next.success", "success", "next.reward", "reward", "rewards")  # columns that say so, the first there is


class Recording(ABC):
    """Episodes of T frames each, whose observations are read last, each once."""

    path: Path
    names: Sequence[str]  # of the episodes
    lengths: Sequence[int]  # T of each
    columns: Sequence[str] = ()  # that can label frames
    fields: Fields  # type and shape of what is read, by key, pictures as they will be stored

    def column(self, episode: int, name: str) -> NDArray[Any]:
        """The values of one of ``columns`` for an episode's frames, (T, ...)."""
        raise NotImplementedError

    @abstractmethod
    def fill(self, states: Mapping[int, Observations], every: int) -> None:
        """Read the frames that :func:`kept` has of episodes into mixed ``states`` (rows,) of each."""

    def store(self, states: Observations, row: int, key: str, picture: NDArray[np.uint8], where: Path) -> None:
        """Shrink a frame, uint8 (H, W, C), into its place; one of another size is a ``UserError``."""
        wanted = self.fields[key][1]
        small = shrunk_picture(picture, max(wanted[:2]))
        if small.shape != wanted:
            fault = f"a frame of {key} is {picture.dtype} {picture.shape}, which does not match the other frames"
            raise UserError(fault, where, "Record it again, or leave that key out.")
        states[key][row] = small


def kept(length: int, every: int) -> NDArray[np.int64]:
    """Every n-th frame of an episode, and always its last."""
    return np.arange((length - 1) % every, length, every)


def chosen_keys(keys: Sequence[str], known: Sequence[str], path: Path) -> list[str]:
    """The keys to read, all ``known`` ones if none are given; an unknown one is a ``UserError``."""
    for key in keys:
        if key not in known:
            do = meant(key, known) or f"It has {', '.join(known)}."
            raise UserError(f"no observation {key!r}", path, do)
    if not known:
        raise UserError("it has no observations", path, "Give a recording with some.")
    return sorted(set(keys or known))


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
    listed = [episode for episode in range(len(recording.names)) if all(episode in marks for marks in by_goal)]
    parts = split_episodes(len(recording.names), listed, seed, recording.path)
    frames = [kept(length, every) for length in recording.lengths]
    order, dtype = np.concatenate(parts).tolist(), mixed_type(recording.fields)
    ends = np.cumsum([len(frames[episode]) for episode in order])
    states: Any = np.empty(ends[-1], dtype)
    recording.fill(dict(zip(order, np.split(states, ends[:-1]), strict=True)), every)
    states = states[dtype.names[0]] if len(recording.fields) == 1 and dtype.names else states
    labels = [
        np.concatenate([np.stack([marks[episode] for marks in by_goal], 1)[frames[episode]] for episode in part])
        for part in (parts[0], parts[2])
    ]
    names = [f"{recording.names[episode]}, frame {frame}" for episode in order for frame in frames[episode]]
    first, second = len(labels[0]), len(states) - len(labels[1])
    begins = {"observations": 0, "unlabelled": first, "heldout_observations": second}

    def name(field: str, row: int) -> str:
        return names[begins[field] + row]

    split = states[:first], labels[0], states[first:second], states[second:], labels[1]
    return Parts(*split, sub_goals=tuple(rules), name=name)


def split_episodes(
    count: int, listed: Sequence[int], seed: int, where: object
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """The episodes that are labelled, unlabelled and held out; those that are not ``listed`` are unlabelled."""
    order = np.array(listed, dtype=np.int64)[rng_for(seed, "minari").permutation(len(listed))]
    others = np.setdiff1d(np.arange(count), order)
    shares, needed = np.array([SPLIT[0], SPLIT[1] * (not len(others)), SPLIT[2]]), 2 if len(others) else 3
    if len(order) < needed:
        fault = f"{len(order)} episodes cannot be labelled, {'' if len(others) else 'unlabelled '}and held out"
        raise UserError(fault, where, f"Give {needed}, with labels.")
    ends = np.round(np.cumsum(shares)[:2] / shares.sum() * len(order)).astype(int)
    ends = np.clip(ends, (1, needed - 1), (len(order) - needed + 1, len(order) - 1))
    labelled, unlabelled, heldout = np.split(order, ends)
    return labelled, np.concatenate([unlabelled, others]), heldout


def _marks(recording: Recording, rule: str) -> dict[int, NDArray[np.bool_]]:
    """Which frames of each episode are positive, bool (T,); a table may leave episodes out."""
    if rule.endswith(TABLE):
        return _listed(recording, Path(rule))
    lengths = dict(enumerate(recording.lengths))
    if rule.startswith(LAST):
        last = rule.removeprefix(LAST)
        if not last.isdecimal() or not int(last):
            raise UserError("the number of last frames is not above 0", rule, "Give last:10, for example.")
        says = next((name for name in SUCCESS if name in recording.columns), "")
        succeeded = {at: not says or bool((recording.column(at, says) > 0).any()) for at in lengths}
        return {at: (np.arange(length) >= length - int(last)) & succeeded[at] for at, length in lengths.items()}
    if rule not in recording.columns:
        do = meant(rule, recording.columns) or f"Its columns are {', '.join(recording.columns) or 'none'}."
        raise UserError(f"no column {rule!r} to label by", recording.path, f"{do} last:N and TABLE.csv label, too.")
    marks = {at: recording.column(at, rule).reshape(-1) for at in lengths}
    for at, values in marks.items():
        if values.dtype.kind not in "biuf" or len(values) != lengths[at] or not np.isfinite(values).all():
            fault = f"the column {rule!r} of {recording.names[at]} is not one number for each frame"
            raise UserError(fault, recording.path, "Give another.")
    return {at: values > 0 for at, values in marks.items()}


def _listed(recording: Recording, table: Path) -> dict[int, NDArray[np.bool_]]:
    """Positive frames by a table: of each row those from ``from`` up to, not including, ``to``."""
    text = read_text(table, "the table of labels is", "Give a CSV file.")
    try:
        reader = csv.DictReader(io.StringIO(text))
        rows, names = list(reader), reader.fieldnames or ()
    except csv.Error:
        raise UserError("the table of labels is damaged", table, "Give a CSV file.") from None
    if not {*COLUMNS} <= {*names}:
        do = "Name them in line 1, with commas between."
        raise UserError(f"the table of labels lacks a column of {', '.join(COLUMNS)}", table, do)
    marks: dict[int, NDArray[np.bool_]] = {}
    for number, row in enumerate(rows, 2):
        where, name = f"{table}, line {number}", str(row["episode"]).strip()
        if name not in recording.names:
            known = f"They are {recording.names[0]} to {recording.names[-1]}."
            raise UserError(f"a label is of an unknown episode, {name!r}", where, known)
        episode = recording.names.index(name)
        length = recording.lengths[episode]
        try:
            first, end = int(row["from"]), int(row["to"])
            if not 0 <= first <= end <= length:
                raise ValueError(row)
        except (TypeError, ValueError):
            fault = f"a label is of frames {row['from']} up to {row['to']}, episode {name} has {length}"
            raise UserError(fault, where, "Give integers, 0 <= from <= to <= its frames.") from None
        marks.setdefault(episode, np.zeros(length, np.bool_))[first:end] = True
    return marks
