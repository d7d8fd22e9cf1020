"""Readers of arrays and of recorded episodes: Minari, robomimic's HDF5, folders of films, and LeRobotDataset.

Arrays are in one ``.npz`` file, or in a folder of ``.npy`` files named as the arrays.

A LeRobotDataset (format v2.1 or v3.0) has tables in parquet, frames in films or in the tables, and facts in ``meta/``.
In v2.1 each episode has files of its own. In v3.0 many episodes share a file, and ``meta/episodes/`` says where in a
film an episode begins. The readers need pyarrow and PyAV (``hypogoal[lerobot]``), but not the package lerobot.
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
from hypogoal.core.hdf5 import opened, whole
from hypogoal.importing.pictures import FILMS, count_frames, frames_in, picture_of
from hypogoal.importing.states import HELDOUT, LABELLED, NAMED, UNLABELLED, Episode, files_of

MINARI = Path("data") / "metadata.json"  # in the folder of a Minari dataset
INFO, EPISODES = Path("meta") / "info.json", Path("meta") / "episodes"  # in the folder of a LeRobotDataset
OWNER = "episode_index"  # the column of every table that says whose episode a row is
HDF5 = (".h5", ".hdf5")
DEMOS = "Give a file with data/demo_0/obs, as robomimic's dataset_states_to_obs.py writes it; arrays as .npz."
KEYS = "Choose those that have one by --key; () is a single value, None a broken link."
MASK = "Give names of data/*, or take the mask out: del file['mask/valid']."
EMBED = "Write their bytes into the table, as LeRobot's embed_images does."
TABLE = ".csv"  # a table of labels may lie beside films
# For each set of states, the name of its observations, and the prefix of the names of its other arrays.
SETS = {
    LABELLED: ("observations", ""),
    UNLABELLED: ("unlabelled", "unlabelled_"),
    HELDOUT: ("heldout_observations", "heldout_"),
}
NPZ = "Give a .npz file that numpy.savez wrote, of numbers, not of Python objects."
LABELS = "Give (N,), or (N, sub-goals) and --sub-goal NAME for each column: 1 where it holds, 0 where not."

Arrays = dict[str, Array]  # by name
Reader = Callable[[Path, Sequence[str]], Iterator[Episode]]  # takes the source and the keys to read


def reader_of(source: Path, left: Counter[str]) -> Reader | None:
    """Return the reader of a recording, or None if ``source`` is no recording.

    A reader of films counts other files in ``left``, by suffix.
    """
    if (source / MINARI).exists():
        return read_minari
    if (source / INFO).exists():
        return read_lerobot
    if source.suffix.lower() in HDF5:
        return read_robomimic
    films = files_of(source, FILMS, Counter())
    return partial(read_films, left=left) if films else None


def read_arrays(path: Path, left: Counter[str]) -> Arrays:
    """Read the arrays of a file or a folder, by name. Observations of several keys are ``observations/KEY``.

    Other files of the folder are counted in ``left``.
    """
    arrays = {"sub_goals": np.array(["sub-goal"]), "features": np.array([])}
    for file in files_of(path, (".npy",), left):
        inner = file.relative_to(path).with_suffix("")
        with reading(file, NPZ):
            arrays[inner.as_posix()] = np.load(file)
    if path.is_file():
        # The file is opened here, because NumPy leaves an archive open that was cut off.
        with reading(path, NPZ), path.open("rb") as raw, np.load(raw) as stored:
            arrays.update(stored)
    return arrays


def episodes_of(
    arrays: Arrays,
    sub_goals: Sequence[str],
    group: str,
    left: Counter[str],
) -> Iterator[Episode]:
    """Return the three sets of states, each as one episode.

    ``group`` names an array (N,). Labelled states with equal values in it belong together. For the other sets the array
    is ``unlabelled_GROUP`` or ``heldout_GROUP``. Arrays that are not read are counted in ``left``. Raises ``UserError``
    if labels do not fit the states and sub-goals.
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
    """Read the episodes of a dataset in any of Minari's formats. An episode has one frame more than steps."""
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
    """Return a space that Minari wrote, with its parts in their order, where Minari itself would sort them.

    ``part`` describes the space, and the spaces inside it have been made already.
    """
    from gymnasium import spaces
    from minari.serialization import deserialize_space

    kind = part.get("type")
    if kind == "Dict":
        return spaces.Dict([*part["subspaces"].items()])
    if kind == "Tuple":
        return spaces.Tuple(part["subspaces"])
    return deserialize_space(part) if isinstance(kind, str) else part


def read_robomimic(source: Path, keys: Sequence[str]) -> Iterator[Episode]:
    """Read the demonstrations ``data/*/obs/KEY``. Demonstrations that ``mask/valid`` lists are held out."""
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
        by_number = sorted(demos, key=len)  # because HDF5 lists demo_10 before demo_2
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
    """Read the films in a folder, each as an episode that is named by the film's path in the folder.

    A film has the one key ``video``, whatever ``keys`` are.
    """
    for file in files_of(source, FILMS, left):
        name = file.relative_to(source).with_suffix("")
        seen = {"video": partial(frames_in, file)}
        yield Episode(name.as_posix(), count_frames(file), seen, {})
    left.pop(TABLE, None)


def read_lerobot(source: Path, keys: Sequence[str]) -> Iterator[Episode]:
    """Read the episodes of a dataset. Observations are its features ``observation*`` and those that ``keys`` name."""
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
    """Return what ``meta/`` says of each episode, a row for each."""
    file = source / EPISODES.with_suffix(".jsonl")
    if file.exists():
        return pd.read_json(file, lines=True, encoding="utf-8-sig")
    files = (source / EPISODES).glob("*/*.parquet")
    return pd.concat(map(_table, sorted(files)), ignore_index=True)


def _cut_ends(listed: pd.DataFrame, head: str) -> None:
    """Let each episode end in its film where the next episode begins, at the latest."""
    begin, end = f"{head}/from_timestamp", f"{head}/to_timestamp"
    if begin in listed:
        films = listed.sort_values(begin).groupby([f"{head}/chunk_index", f"{head}/file_index"])
        following = films[begin].shift(-1).astype(float).fillna(np.inf)
        listed[end] = np.minimum(following, listed.get(end, np.inf))


def _facts(row: Mapping[Any, Any], head: str) -> dict[Any, Any]:
    """Return the row of an episode, with the numbers of its table or film, and the time when it begins there.

    The keys added are ``chunk_index``, ``file_index`` and ``from_timestamp``. Their values are the row's ``head/*`` in
    v3.0, and 0 in v2.1.
    """
    facts = dict(row)
    for name in ("chunk_index", "file_index", "from_timestamp"):
        facts[name] = row.get(f"{head}/{name}", 0)
    return facts


def _table(file: Path) -> pd.DataFrame:
    with reading(file):
        return pd.read_parquet(file, engine="pyarrow", dtype_backend="pyarrow", partitioning=None)


def _cells(file: Path, column: Any, rows: Ints) -> Iterator[Array]:
    """Return the pictures in some cells of a column. A cell is ``{bytes, path}``.

    Raises ``UserError`` if a cell has no bytes, but the path of a picture in a file of its own.
    """
    for cell in column.iloc[rows]:
        data = cell["bytes"]
        if data is None:
            raise UserError("pictures in files of their own are not read", f"{file}: {cell['path']}", EMBED)
        yield picture_of(data, file)


def _episode(
    name: str,
    seen: Mapping[str, Any],
    columns: Mapping[str, Array],
    keys: Sequence[str],
    role: str = "",
) -> Episode:
    """Return an episode of arrays (T, ...) by key. Raises ``UserError`` if arrays that are wanted differ in T.

    A shorter column has NaN for the last frames, and a longer column has NaN for all frames.
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
    """Return the datasets in a group by key, such as ``robot/position``."""
    if not hasattr(values, "items"):
        return {place: values}
    leaves = {}
    for key, part in values.items():
        inner = f"{place}/{key}".removeprefix("/")
        leaves.update(_leaves(part, inner))
    return leaves
