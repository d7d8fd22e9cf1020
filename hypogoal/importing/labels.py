"""How states are labelled, by the rules of ``--label`` for episodes, and by tables that people fill in."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from hypogoal.core.arrays import Array, Bools
from hypogoal.core.errors import UserError
from hypogoal.core.files import reading
from hypogoal.core.own_code import load
from hypogoal.data import Collected, joined, open_dataset, write_dataset
from hypogoal.importing.states import HELDOUT, UNJUDGED, UNLABELLED, Frames
from hypogoal.observations import NUMBERS, digest

LAST, TABLE = "last:", ".csv"  # the beginning of a rule for last frames, and the end of a rule that names a table
SPANS = {"episode": str, "from": int, "to": int}  # the columns of a table of positive frames, without the frame ``to``
SUCCESS = ("next.success", "success", "next.reward", "reward", "rewards")  # columns of success, in order of preference
TRUTHS = {"0": False, "1": True}


def labels_of(frames: Frames, rules: Mapping[str, str]) -> Bools:
    """Return whether each sub-goal holds in each frame, bool (N, G).

    ``rules`` are, by sub-goal, one of four texts. The name of a column means the frames in which the column is above 0.
    ``last:N`` means the last N frames of each success. ``FILE.csv`` is a table of positive frames. ``module:function``
    is asked about each observation, which is a dictionary if there are several keys. Frames of which a rule knows
    nothing, such as those of episodes that a table does not list, become unlabelled, or unjudged if they are held out.
    """
    marks = [_marks(frames, rule) for rule in rules.values()]
    labels = np.stack(marks, axis=1)
    is_unknown = np.isnan(labels).any(axis=1)
    is_held = frames.table["role"] == HELDOUT
    frames.table.loc[is_unknown & ~is_held, "role"] = UNLABELLED
    frames.table.loc[is_unknown & is_held, "role"] = UNJUDGED
    return labels > 0


def _marks(frames: Frames, rule: str) -> Any:
    """Return numbers (N,) that are above 0 where a sub-goal holds, and NaN where nobody knows whether it holds."""
    if rule.endswith(TABLE):
        return _by_table(frames.table, Path(rule))
    episode = frames.table["episode"]
    columns = frames.columns
    count = rule.removeprefix(LAST)
    if count != rule and count.isdecimal():
        behind = episode.groupby(episode).cumcount(ascending=False)
        is_last = behind < int(count)
        for name in SUCCESS:
            if name in columns:
                numbers = pd.to_numeric(columns[name], errors="coerce").astype(float)
                return is_last * numbers.groupby(episode).transform("max")  # NaN if the episode has no numbers
        return is_last
    if ":" in rule and rule not in columns:
        return _by_function(frames, rule)
    values = columns.get(rule, episode)
    are_numbers = values.dtype.kind in "biuf"
    if not are_numbers or not np.isfinite(values).all():
        names = ", ".join([*columns]) or "none"
        gaps = frames.table["name"][values.isna()]
        where = ", not in ".join([rule, *gaps[:1]])
        raise UserError("no column with a number for each frame", where, f"There are {names}.")
    return values


def _by_function(frames: Frames, rule: str) -> Array:
    """Return marks (N,), 1 in the frames that a function of the observation calls positive, and NaN if not kept."""
    holds = load(rule, "label", "", {})
    marks = np.full(len(frames.table), np.nan)
    by_key = pd.DataFrame(frames.seen).to_dict("records")
    marks[frames.table["kept"]] = [bool(holds(seen.get("", seen))) for seen in by_key]
    return marks


def _by_table(table: pd.DataFrame, path: Path) -> Array:
    """Return marks (N,), 1 in the frames that a table of ``SPANS`` lists, and NaN in episodes that it does not list."""
    spans = read_table(path, SPANS)
    marks = np.full(len(table), np.nan)
    is_listed = table["episode"].isin(spans["episode"])
    marks[is_listed] = 0
    for name, first, end in spans[[*SPANS]].itertuples(index=False):
        rows = table.index[table["episode"] == name]
        fits = 0 <= first <= end <= len(rows)
        if not fits or rows.empty:
            fault = f"a label is of frames {first} up to {end} of {len(rows)} in {name!r}"
            raise UserError(fault, path, "Give an episode's name and 0 <= from <= to <= its frames.")
        marks[rows[first:end]] = 1
    return marks


def read_table(path: Path, columns: dict[str, Any]) -> pd.DataFrame:
    """Read ``columns``, types by name, of a CSV file. A byte order mark is left out."""
    names = ", ".join(columns)
    with reading(path, f"Give a CSV file, with commas, whose first line names {names}."):
        return pd.read_csv(
            path,
            usecols=[*columns],
            dtype=columns,
            keep_default_na=False,
            encoding="utf-8-sig",
        )


def add_labels(source: Path, file: Path, sub_goal: str, path: Path, seed: int) -> list[str]:
    """Write the states of the data file ``source`` to ``file``, with labels for the states in the table at ``path``.

    ``audit`` proposes the table beside pictures of the states, and a person or a script fills it in. Returns a line on
    how many states are labelled. States that equal a state in the table get that state's label, too. Raises
    ``UserError`` if the table is of other data or names a state twice, or if the data have several sub-goals.
    """
    dataset = open_dataset(source)
    if dataset.sub_goals != (sub_goal,):
        goals = ", ".join(dataset.sub_goals)
        raise UserError("a table labels data of one sub-goal, its own", sub_goal, f"It has {goals}.")
    unlabelled = dataset.unlabelled_states()
    places: dict[str, list[int]] = {}
    for place, state in enumerate(unlabelled.observations):
        look = digest(state).hex()
        alike = places.setdefault(look, [])
        alike.append(place)
    table = read_table(path, {"label": str, "digest": str})
    filled = table[table["label"] != ""]
    with reading(path, "Give states of these data, each once, with 1 or 0; or audit an ensemble of these data again."):
        copies = [places.pop(look) for look in filled["digest"]]
        labels = [TRUTHS[label] for label in filled["label"]]
    rows = np.array([*chain(*copies)], int)
    counts = np.array([*map(len, copies)], int)
    of_each = np.repeat(np.array(labels, bool), counts)
    marked = replace(unlabelled.where(rows), labels=of_each)
    every = np.arange(len(unlabelled.labels))
    others = np.delete(every, rows)
    features: Sequence[str] = ()
    if dataset.observation_dtype == NUMBERS:
        features = dataset.features()
    collected = Collected(
        dataset.observation_shape,
        dataset.sub_goals,
        joined([dataset.labelled(sub_goal), marked]),
        unlabelled.where(others),
        dataset.heldout(sub_goal),
        tuple(features),
        dataset.channels,
    )
    write_dataset(
        file,
        collected,
        domain=dataset.domain,
        config=dataset.config,
        seed=seed,
    )
    return [f"{len(rows)} states are labelled now, {len(others)} are not"]
