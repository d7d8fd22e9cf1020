"""Readers of arrays and of recorded episodes: Minari, robomimic's HDF5, folders of films, and LeRobotDataset.

Arrays are a ``.npz`` file, or a folder of ``.npy`` files with the same names.

A LeRobotDataset, formats v2.1 and v3.0, has tables in parquet, frames in films or in the tables, facts in ``meta/``. In
v2.1 each episode has files of its own, in v3.0 many episodes share files, and ``meta/episodes/`` says where in a film
an episode begins. The package lerobot is not needed, pyarrow and PyAV are (``hypogoal[lerobot]``).
"""

import json
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from hypogoal.core.arrays import Array, Ints
from hypogoal.core.errors import UserError
from hypogoal.core.files import AGAIN, reading
from hypogoal.data import opened, whole
from hypogoal.importing.pictures import FILMS, count_frames, frames_in, picture_of
from hypogoal.importing.states import HELDOUT, LABELLED, NAMED, UNLABELLED, Episode, files_of

MINARI = Path("data") / "metadata.json"  # in a dataset's folder
INFO, EPISODES = Path("meta") / "info.json", Path("meta") / "episodes"
OWNER = "episode_index"  # a column of every table
HDF5 = (".h5", ".hdf5")
DEMOS = "Give a file with data/demo_0/obs, as robomimic's dataset_states_to_obs.py writes it; arrays as .npz."
KEYS = "Choose those that have one by --key; () is a single value, None a broken link."
MASK = "Give names of data/*, or take the mask out: del file['mask/valid']."
TABLE = ".csv"  # labels of films, beside them
# Of each set of states: what the names of its observations begin with, and those of its other arrays.
SETS = {
    LABELLED: ("observations", ""),
    UNLABELLED: ("unlabelled", "unlabelled_"),
    HELDOUT: ("heldout_observations", "heldout_"),
}
NPZ = "Give a .npz file that numpy.savez wrote, of numbers, not of Python objects."
LABELS = "Give (N,), or (N, sub-goals) and --sub-goal NAME for each column: 1 where it holds, 0 where not."

Arrays = dict[str, Array]  # by name
Reader = Callable[[Path, Sequence[str]], Iterator[Episode]]  # from a source, the keys to read


def reader_of(source: Path, left: Counter[str]) -> Reader | None:
    """What reads a recording; None of what is none. ``left`` counts by suffix the files that are not read."""
    if (source / MINARI).exists():
        return read_minari
    if (source / INFO).exists():
        return read_lerobot
    if source.suffix.lower() in HDF5:
        return read_robomimic
    films = files_of(source, FILMS, Counter())
    return partial(read_films, left=left) if films else None


def read_arrays(path: Path, left: Counter[str]) -> Arrays:
    """The arrays of a file or a folder by name; observations of several keys are ``observations/front`` and so on.

    ``left`` counts other files of the folder.
    """
    arrays = {"sub_goals": np.array(["sub-goal"]), "features": np.array([])}
    for file in files_of(path, (".npy",), left):
        inner = file.relative_to(path).with_suffix("")
        with reading(file, NPZ):
            arrays[inner.as_posix()] = np.load(file)
    if path.is_file():
        with reading(path, NPZ), path.open("rb") as raw, np.load(raw) as stored:  # NumPy leaves a cut archive open
            arrays.update(stored)
    return arrays


def episodes_of(
    arrays: Arrays,
    sub_goals: Sequence[str],
    group: str,
    left: Counter[str],
) -> Iterator[Episode]:
    """The three sets of states as an episode each; labels that do not fit states and sub-goals are a ``UserError``.

    ``group`` names another array, (N,): labelled states with equal values there belong together, and unlabelled ones by
    the array ``unlabelled_GROUP``. ``left`` counts arrays that are not read.
    """
    if group and group not in arrays:
        names = ", ".join(arrays)
        raise UserError("no such array", group, f"There are {names}.")
    rest = arrays.keys() - {"sub_goals", "features"}
    for role, (name, prefix) in SETS.items():
        seen = {}
        for full, values in arrays.items():
            base, _, key = full.partition("/")
            if base == name:
                seen[key] = np.atleast_1d(values)
                rest.remove(full)
        count = max(map(len, seen.values()), default=0)
        unlabelled = 0 if role != UNLABELLED else count
        labels = arrays.get(f"{prefix}labels", np.zeros((unlabelled, len(sub_goals))))
        columns = np.atleast_2d(labels.T)
        if columns.shape != (len(sub_goals), count) or not np.isin(columns, (0, 1)).all():
            fault = f"labels of {count} {role} states and {len(sub_goals)} sub-goals are not 0 or 1 for each"
            raise UserError(fault, f"{labels.dtype} {labels.shape}", LABELS)
        by_goal = dict(zip(sub_goals, columns.astype(bool), strict=True))
        groups = arrays.get(f"{prefix}{group}", np.full(count, ""))
        rest -= {f"{prefix}labels", f"{prefix}{group}"}
        if count:
            yield Episode(name, count, seen, by_goal, role, groups.astype(str))
    for name in rest:
        left[f"array {name!r}"] += 1


def read_minari(source: Path, keys: Sequence[str]) -> Iterator[Episode]:
    """The episodes of a dataset in any of Minari's formats; T is one more than the steps."""
    import minari

    from hypogoal.domains.gymnasium.reader import recorded

    dataset = minari.MinariDataset(source / MINARI.parent)
    written = dataset.storage.read_raw_metadata(source / MINARI.parent).get("observation_space")
    space = json.loads(written, object_hook=_space_of) if written else dataset.observation_space
    for episode in dataset.iterate_episodes():
        columns = {
            "rewards": np.append(0, episode.rewards),
            "terminations": np.append(0, episode.terminations),
        }
        seen = recorded(space, episode.observations, keys)
        yield _episode(f"episode_{episode.id}", seen, columns, keys)


def _space_of(part: dict[str, Any]) -> Any:
    """A space as Minari wrote it, its parts being spaces already, in their order: Minari itself sorts them."""
    from gymnasium import spaces
    from minari.serialization import deserialize_space

    kind = part.get("type")
    if kind == "Dict":
        return spaces.Dict([*part["subspaces"].items()])
    if kind == "Tuple":
        return spaces.Tuple(part["subspaces"])
    return deserialize_space(part) if isinstance(kind, str) else part


def read_robomimic(source: Path, keys: Sequence[str]) -> Iterator[Episode]:
    """The demonstrations ``data/*/obs/KEY``; those that ``mask/valid`` lists are held out."""
    with opened(source, DEMOS, "the recording") as file:
        demos = file["data"]
        masks = file.get("mask", {})
        valid = set()
        if "valid" in [*masks]:
            listed = np.ravel(masks["valid"]).astype("S")
            valid = {name.decode().strip() for name in listed}
            strangers = sorted(valid.difference(demos))
            if strangers or not valid:
                raise UserError("mask/valid names no demonstrations", f"{source}: {strangers[:NAMED]}", MASK)
        by_number = sorted(demos, key=len)  # HDF5 lists names in order: demo_10 before demo_2
        for name in by_number:
            demo = demos[name]
            columns = {}
            for key, part in demo.items():
                if getattr(part, "ndim", 0) == 1 and part.dtype.kind in "biuf":
                    columns[key] = whole(part)[()]
            role = HELDOUT if name in valid else ""
            seen = _leaves(demo["obs"], "")
            episode = _episode(name, seen, columns, keys, role)
            for key in keys or seen:
                if key in seen:
                    whole(seen[key])
            yield episode


def read_films(source: Path, keys: Sequence[str], left: Counter[str]) -> Iterator[Episode]:
    """The films in a folder, an episode each, called by their path in it; each has one key, whatever ``keys`` say."""
    for file in files_of(source, FILMS, left):
        name = file.relative_to(source).with_suffix("")
        seen = {"video": partial(frames_in, file)}
        yield Episode(name.as_posix(), count_frames(file), seen, {})
    left.pop(TABLE, None)


def read_lerobot(source: Path, keys: Sequence[str]) -> Iterator[Episode]:
    """The episodes of a dataset, with ``keys`` of its features beside all ``observation*``."""
    info = json.loads((source / INFO).read_bytes())
    table_of = lru_cache(maxsize=1)(_table)  # the episodes of a file come together
    listed = _listed(source)
    for key in info["features"]:
        _cut_ends(listed, f"videos/{key}")
    listed["episode_chunk"] = listed[OWNER] // info.get("chunks_size", 1000)
    for row in listed.to_dict("records"):
        file = source / info["data_path"].format(**_facts(row, "data"))
        table = table_of(file)
        number = row[OWNER]
        frames = table[table[OWNER] == number]
        length = len(frames)
        if "timestamp" in frames:
            numbers = np.rint(frames["timestamp"].to_numpy(float) * info["fps"])
            if not np.array_equal(numbers, np.arange(row.get("length", length))):
                fault = "rows are not the frames of their episode in order, by their timestamps"
                raise UserError(fault, f"{file}, episode {number}", AGAIN)
        columns = {}
        seen = {}
        for key, feature in info["features"].items():
            if feature["dtype"] == "video":
                facts = _facts(row, f"videos/{key}")
                film = source / info["video_path"].format(video_key=key, **facts)
                begin = facts["from_timestamp"]
                shown = (row.get(f"videos/{key}/to_timestamp", np.inf) - begin) * info["fps"]
                if not shown > length - 0.5:
                    fault = f"the film has {shown:.0f} frames of an episode of {length}"
                    raise UserError(fault, f"{film}, episode {number}", AGAIN)
                values: Any = partial(frames_in, film, rate=info["fps"], begin=begin)
            elif feature["dtype"] == "image":
                values = partial(_cells, file, frames[key])
            else:
                values = np.array(frames[key].tolist())
                if values.ndim == 1:
                    columns[key] = values
            if key in keys or key.startswith("observation"):
                seen[key] = values
        yield Episode(str(number), length, seen, columns)


def _listed(source: Path) -> pd.DataFrame:
    """What ``meta/`` says of each episode."""
    file = source / EPISODES.with_suffix(".jsonl")
    if file.exists():
        return pd.read_json(file, lines=True, encoding="utf-8-sig")
    files = (source / EPISODES).glob("*/*.parquet")
    return pd.concat(map(_table, sorted(files)), ignore_index=True)


def _cut_ends(listed: pd.DataFrame, head: str) -> None:
    """Have each episode end in its film where the next one begins, at the latest."""
    begin, end = f"{head}/from_timestamp", f"{head}/to_timestamp"
    if begin in listed:
        films = listed.sort_values(begin).groupby([f"{head}/chunk_index", f"{head}/file_index"])
        following = films[begin].shift(-1).astype(float).fillna(np.inf)
        listed[end] = np.minimum(following, listed.get(end, np.inf))


def _facts(row: Mapping[Any, Any], head: str) -> dict[Any, Any]:
    """The row of an episode with what it says of its table or film in v3.0: the file's numbers, and when it begins."""
    facts = dict(row)
    for name in ("chunk_index", "file_index", "from_timestamp"):
        facts[name] = row.get(f"{head}/{name}", 0)
    return facts


def _table(file: Path) -> pd.DataFrame:
    with reading(file):
        return pd.read_parquet(file, engine="pyarrow", dtype_backend="pyarrow", partitioning=None)


def _cells(file: Path, column: Any, rows: Ints) -> Iterator[Array]:
    """The pictures in cells of a table, ``{bytes, path}``."""
    for cell in column.iloc[rows]:
        yield picture_of(cell["bytes"], file)


def _episode(
    name: str,
    seen: Mapping[str, Any],
    columns: Mapping[str, Array],
    keys: Sequence[str],
    role: str = "",
) -> Episode:
    """An episode of arrays (T, ...) by key; those that are wanted have one T, or it is a ``UserError``.

    A column that is shorter has no numbers for the last frames, and one that is longer has none at all.
    """
    shapes = {key: getattr(seen[key], "shape", None) for key in keys or seen if key in seen}
    lengths: set[tuple[int, ...]] = {(shape or ())[:1] for shape in shapes.values()}
    if len(lengths) > 1 or () in lengths:
        raise UserError("not all of these have an entry for each frame", f"{name}: {shapes}", KEYS)
    length = max(lengths)[0] if lengths else 1
    by_frame = {}
    for key, values in columns.items():
        by_frame[key] = np.full(length, np.nan)
        if len(values) <= length:
            by_frame[key][: len(values)] = values
    return Episode(name, length, seen, by_frame, role)


def _leaves(values: Any, place: str) -> dict[str, Any]:
    """The datasets in a group by key: ``robot/position``."""
    if not hasattr(values, "items"):
        return {place: values}
    leaves = {}
    for key, part in values.items():
        inner = f"{place}/{key}".removeprefix("/")
        leaves.update(_leaves(part, inner))
    return leaves
