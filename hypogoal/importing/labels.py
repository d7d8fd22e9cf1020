"""What labels states: the rules of ``--label`` for episodes, and tables that people fill in."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from hypogoal.core.arrays import Array, Bools
from hypogoal.core.errors import UserError
from hypogoal.core.files import reading
from hypogoal.core.own_code import load
from hypogoal.data import Collected, joined, open_dataset, write_dataset
from hypogoal.importing.states import UNLABELLED, Frames
from hypogoal.observations import NUMBERS, digest

LAST, TABLE = "last:", ".csv"  # how rules begin and end that are no columns
SPANS = {"episode": str, "from": int, "to": int}  # columns of a table of positive frames; ``to`` is the first behind
SUCCESS = ("next.success", "success", "next.reward", "reward", "rewards")  # columns that say so, the first there is
TRUTHS = {"0": False, "1": True}


def labels_of(frames: Frames, rules: Mapping[str, str]) -> Bools:
    """Whether each sub-goal holds in frames, (N, G), by the rule for it.

    A column above 0; ``last:N`` frames of each success; a table, ``FILE.csv``; or ``module:function`` of what is seen,
    of several keys a dictionary. Episodes that a table does not list become unlabelled.
    """
    marks = [_marks(frames, rule) for rule in rules.values()]
    labels = np.stack(marks, axis=1)
    is_unknown = np.isnan(labels).any(axis=1)
    frames.table.loc[is_unknown, "role"] = UNLABELLED
    return labels > 0


def _marks(frames: Frames, rule: str) -> Any:
    """Numbers (N,), above 0 where a sub-goal holds, NaN where that is not known."""
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
                return is_last * numbers.groupby(episode).transform("max")  # NaN where it has none
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
    """1 in the frames of which a function of what is seen says so, NaN in those that are not kept."""
    holds = load(rule, "label", "", {})
    marks = np.full(len(frames.table), np.nan)
    by_key = pd.DataFrame(frames.seen).to_dict("records")
    marks[frames.table["kept"]] = [bool(holds(seen.get("", seen))) for seen in by_key]
    return marks


def _by_table(table: pd.DataFrame, path: Path) -> Array:
    """1 in the frames that a table of ``SPANS`` lists, NaN in episodes that it does not."""
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
    """The columns of a CSV file, by their types; a byte order mark is left out."""
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
    """Write a data file's states again, those that a table labels among the labelled ones; returns how many these are.

    ``audit`` proposes the table beside pictures of the states, a person or a script fills it in. One of other data,
    that names a state twice, and data of several sub-goals are a ``UserError``.
    """
    dataset = open_dataset(source)
    if dataset.sub_goals != (sub_goal,):
        goals = ", ".join(dataset.sub_goals)
        raise UserError("a table labels data of one sub-goal, its own", sub_goal, f"It has {goals}.")
    unlabelled = dataset.unlabelled_states()
    places = {digest(state).hex(): place for place, state in enumerate(unlabelled.observations)}
    table = read_table(path, {"label": str, "digest": str})
    filled = table[table["label"] != ""]
    with reading(path, "Give states of these data, each once, with 1 or 0; or audit an ensemble of these data again."):
        numbers = [places.pop(look) for look in filled["digest"]]
        labels = [TRUTHS[label] for label in filled["label"]]
    rows = np.array(numbers, int)
    marked = replace(unlabelled.where(rows), labels=np.array(labels, bool))
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
