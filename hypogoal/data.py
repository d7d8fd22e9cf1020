"""The HDF5 schema of collected states: labelled, unlabelled, held-out (Spec A1, A8).

``labelled/<sub-goal>/{observations,labels}``, ``unlabelled/observations``, ``heldout/<sub-goal>/{observations,labels}``
and, beside each, ``origin/*`` per state. Sub-goals with the same states share one dataset on disk (hard links). The
root's attributes hold format version, domain, observation space, arguments and versions. ``complete`` is set last, so a
file without it was cut off.
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hypogoal.core import hdf5
from hypogoal.core.artefacts import DATA, claim, versions
from hypogoal.core.commands import advice
from hypogoal.core.errors import UserError
from hypogoal.core.files import FORMULA, NO_FILE_NAME, parse_json, path_part, plain_name, plain_names, replacing
from hypogoal.core.terminal import amount
from hypogoal.observations import MAX_SIDE, NUMBERS, Observations, digest, fields_of, numbers_of, type_of, type_text

if np.lib.NumpyVersion(np.__version__) < "2.0.0":  # it promotes integers differently, which fails late
    raise UserError("hypogoal needs NumPy 2", f"found {np.__version__}", "pip install 'numpy>=2,<3'")

DATA_FORMAT = 2  # 1: texts of variable length
SPLITS = ("labelled", "heldout")
ATTRIBUTES = (
    "format", "domain", "sub_goals", "observation_shape", "observation_dtype", "config", "seed", "versions", "complete",
)  # fmt: skip
RECOLLECT = "Collect it again."
GET_MORE = "Collect more steps or other layouts, or bring a policy that gets there."
FEW = 10  # warn below this number of labelled states of a class
RARE = 0.05  # warn below this share of a class
BLOCK = 8  # states of a sample that are read together
COLUMN_CHUNK = 1 << 16  # values of a label or origin
KINDS = "ufV"  # NumPy's letters of types of observations


@dataclass(frozen=True)
class States:
    """States with their true labels.

    Attributes:
        observations: uint8 or float32 (N, *observation_shape), or mixed (N,).
        labels: bool (N, G), one column per sub-goal; (N,) for a single sub-goal.
        origins: int (N,) arrays by name, where each state comes from (layout_seed, agent_x, ...).
    """

    observations: Observations
    labels: NDArray[np.bool_]
    origins: Mapping[str, NDArray[np.int64]] = field(default_factory=dict)

    def where(self, kept: NDArray[np.bool_]) -> States:
        """The states that are ``kept``, bool (N,)."""
        origins = {name: values[kept] for name, values in self.origins.items()}
        return States(self.observations[kept], self.labels[kept], origins)


@dataclass(frozen=True)
class Collected:
    """What a domain's ``collect`` returns: three sets of states, the names of sub-goals (G) and of features, if any."""

    observation_shape: tuple[int, ...]
    sub_goals: tuple[str, ...]
    labelled: States
    unlabelled: States
    heldout: States
    features: tuple[str, ...] = ()


class Unmet(UserError):
    """Play did not reach the states needed; ``collected`` has those it reached, if known."""

    collected: Collected | None = None


def leave_out(states: States, *training: Observations) -> States:
    """Spec B3: the states without those that look like one of ``training``, observations (M, ...) each."""
    digests = {digest(observation) for observations in training for observation in observations}
    return states.where(np.array([digest(observation) not in digests for observation in states.observations], np.bool_))


def joined(parts: Sequence[States]) -> States:
    """The states of all parts, with the origins that the first part has."""
    observations, labels = (
        np.concatenate([getattr(part, name) for part in parts]) for name in ("observations", "labels")
    )
    origins = {name: np.concatenate([part.origins[name] for part in parts]) for name in parts[0].origins}
    return States(observations, labels, origins)


def hard_to_learn(labels: NDArray[np.bool_], goals: Sequence[str]) -> list[str]:
    """A line for each sub-goal with few positives, or few negatives, among the labels (N, G)."""
    lines = []
    for goal, column in zip(goals, labels.T, strict=True):
        positives = int(column.sum())
        fewest = min(positives, len(labels) - positives)
        if fewest < max(FEW, RARE * len(labels)):
            few = amount(fewest, "positive" if fewest == positives else "negative")
            lines.append(f"{goal} has {few} among {len(labels)} labelled states: classes are unbalanced")
    return lines


def hard_to_judge(labels: NDArray[np.bool_], goals: Sequence[str]) -> list[str]:
    """A line for each sub-goal with one class only among the held-out labels (N, G)."""
    one_class = [goal for goal, column in zip(goals, labels.T, strict=True) if len(np.unique(column)) < 2]
    return [f"{goal} has one class only in the held-out states, so it cannot be judged by them" for goal in one_class]


def require_classes(labels: NDArray[np.bool_], goals: Sequence[str], where: object, do: str) -> None:
    """Refuse (``Unmet``) labels (N, G) of labelled states that have one class only for some sub-goal."""
    for goal, column in zip(goals, labels.T, strict=True):
        if len(np.unique(column)) < 2:
            lacking = "negatives" if column.any() else "positives"
            raise Unmet(f"{goal} has no {lacking} among {len(labels)} labelled states", where, do)


def require_names(sub_goals: Sequence[str]) -> None:
    """Refuse (``UserError``) an empty list, names that are not plain, and names that differ only in case."""
    if not sub_goals:
        raise UserError("there are no sub-goals", None, "Give at least one, with a name.")
    for name in sub_goals:
        if not plain_name(name):
            do = f"Leave out separators, {' '.join(NO_FILE_NAME)}, dot or space first or last, any of {FORMULA} first."
            raise UserError("a sub-goal's name must be usable as a file name", repr(name), do)
    if not plain_names(sub_goals):
        do = "Give them different names; some file systems ignore case."
        raise UserError("two sub-goals have the same name", ", ".join(sub_goals), do)


def write_dataset(
    path: Path,
    collected: Collected,
    *,
    domain: str,
    config: Mapping[str, Any],
    seed: int,
    force: bool = False,
) -> None:
    """Write collected states; the file appears under its name only once it is complete.

    Raises ``UserError`` if a name cannot be a file name, labels are not truth values, or the file exists.
    """
    require_names(collected.sub_goals)
    for origin in {*collected.labelled.origins, *collected.unlabelled.origins, *collected.heldout.origins}:
        if not path_part(origin):
            raise UserError("an origin's name must be usable as a file name", repr(origin), "Leave out separators.")
    path = claim(path, kind=DATA, force=force)
    parse_json(json.dumps([domain, dict(config)]), path, "names and settings are", "Give names in UTF-8.")
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as fresh, hdf5.create_hdf5(fresh) as file:
        hdf5.set_attribute(file, "format", DATA_FORMAT)
        hdf5.set_attribute(file, "domain", domain)
        hdf5.set_attribute(file, "sub_goals", json.dumps(list(collected.sub_goals)))
        hdf5.set_attribute(file, "observation_shape", json.dumps(list(collected.observation_shape)))
        hdf5.set_attribute(file, "observation_dtype", type_text(collected.unlabelled.observations.dtype))
        hdf5.set_attribute(file, "config", json.dumps(dict(config)))
        hdf5.set_attribute(file, "seed", seed)
        hdf5.set_attribute(file, "versions", json.dumps(versions()))
        hdf5.set_attribute(file, "complete", False)  # written first, so that a truncated file still has it
        for split, states in (("labelled", collected.labelled), ("heldout", collected.heldout)):
            _write_split(file, split, states, collected.sub_goals)
        group = file.create_group("unlabelled")
        write_observations(group, collected.unlabelled.observations)
        _write_origins(group, collected.unlabelled.origins)
        if collected.features:  # a dataset, because they may exceed an attribute's size
            file["features"] = hdf5.fixed(json.dumps(list(collected.features)))
        file.attrs.modify("complete", True)


def _write_split(file: Any, split: str, states: States, sub_goals: tuple[str, ...]) -> None:
    labels, shape = states.labels, (len(states.observations), len(sub_goals))
    if getattr(labels, "dtype", None) != np.bool_ or labels.shape != shape:  # NumPy turns the text 'False' into True
        kind = f"{labels.dtype} {labels.shape}" if isinstance(labels, np.ndarray) else type(labels).__name__
        raise UserError(f"the domain's {split} labels are not truth values", kind, f"Give bool {shape}.")
    first: Any = None
    for index, sub_goal in enumerate(sub_goals):
        group = file.create_group(f"{split}/{sub_goal}")
        if first is None:
            write_observations(group, states.observations)
            _write_origins(group, states.origins)
            first = group
        else:
            group.update({name: first[name] for name in ("observations", "origin") if name in first})
        _write_column(group, "labels", labels[:, index])


def write_observations(group: Any, observations: Observations) -> None:
    """Write ``observations`` to an HDF5 group, in compressed chunks of up to 64 states."""
    _store(group, "observations", observations, 64, compression="gzip", compression_opts=1)


def _write_column(group: Any, name: str, values: NDArray[Any]) -> None:
    """Write one value per state, with checksums: a flipped label, unlike a damaged compressed state, is still valid."""
    _store(group, name, values, COLUMN_CHUNK, fletcher32=True)


def _store(group: Any, name: str, values: NDArray[Any], most: int, **filters: Any) -> None:
    """Write a dataset in chunks of up to ``most`` states."""
    chunks = (min(most, len(values)), *values.shape[1:])
    group.create_dataset(name, data=values, **({"chunks": chunks, **filters} if len(values) else {}))


def _write_origins(group: Any, origins: Mapping[str, NDArray[np.int64]]) -> None:
    for name, values in origins.items():
        _write_column(group, f"origin/{name}", values)


class Dataset:
    """A complete data file, opened for reading. Use :func:`open_dataset`."""

    def __init__(self, path: Path):
        self.path = path
        foreign = UserError("not a hypogoal data file", path, advice("How to make one", "collect", "--help"))
        with self._file() as file:
            version = hdf5.attribute(file, "format")
            if not isinstance(version, int) or isinstance(version, bool):
                raise foreign
            if version > DATA_FORMAT:
                raise UserError(f"format {version} is newer than this hypogoal reads", path, "Upgrade hypogoal.")
            if version < DATA_FORMAT:
                raise UserError(f"format {version} comes from an earlier hypogoal", path, RECOLLECT)
            self.attributes = {name: hdf5.attribute(file, name) for name in ATTRIBUTES}
        if not self.attributes["complete"]:
            raise UserError("the data file is not complete", path, RECOLLECT)
        self.sub_goals: tuple[str, ...] = tuple(self._json("sub_goals", list))
        self.observation_shape: tuple[int, ...] = tuple(self._json("observation_shape", list))
        try:
            self.observation_dtype = type_of(self.attributes["observation_dtype"])
        except ValueError:
            raise foreign from None
        self.config: dict[str, Any] = self._json("config", dict)
        self.domain = self.attributes["domain"]
        sizes = all(type(size) is int and 0 < size <= MAX_SIDE for size in self.observation_shape)
        names = plain_names(self.sub_goals)
        fits = bool(self.observation_shape) != bool(self.observation_dtype.names)
        if not (sizes and names and fits and isinstance(self.domain, str)):
            raise foreign
        self.observation_bytes = prod(self.observation_shape) * self.observation_dtype.itemsize  # of one observation

    def features(self) -> list[str]:
        """The names of an observation's numbers, in order; ``x0``, ``x1``, ... if the file has no names.

        Of a mixed observation ``key[0]``, ``key[1]``, ..., and a picture's key alone.
        """
        count = prod(self.observation_shape)
        if self.observation_dtype.names:
            fields = fields_of((), self.observation_dtype).items()
            rows = [(key, prod(shape) if dtype == NUMBERS else 1) for key, (dtype, shape) in fields]
            return [f"{key}[{place}]" if size > 1 else key for key, size in rows for place in range(size)]
        with self._file() as file:
            if hdf5.find(file, "features") is None:
                return [f"x{number}" for number in range(count)]
            text = hdf5.read_array(file, "features", "S").tobytes().rstrip(b"\0").decode(errors="replace")
        names = parse_json(text, self.path, "names of features are", RECOLLECT)
        if not isinstance(names, list) or len(names) != count or not all(isinstance(name, str) for name in names):
            raise UserError("the data file's feature names do not fit", self.path, RECOLLECT)
        return names

    def labelled(self, sub_goal: str) -> States:
        """The labelled states of one sub-goal."""
        return self._split("labelled", sub_goal)

    def heldout(self, sub_goal: str) -> States:
        """The held-out states of one sub-goal with their true labels, for evaluation only."""
        return self._split("heldout", sub_goal)

    def unlabelled(self) -> Observations:
        """The unlabelled states: uint8 or float32 (M, *obs)."""
        with self._file() as file:
            return self._observations(file, "unlabelled")

    def some_heldout(self, sub_goal: str, count: int) -> States:
        """About ``count`` held-out states of each class of a sub-goal, spread over the file; reads no others."""
        base = f"heldout/{sub_goal}"
        with self._file() as file:
            labels = self._labels(file, base)
            classes = (np.flatnonzero(labels), np.flatnonzero(~labels))
            chosen = [rows[part] for rows in classes if len(rows) > count for part in _spread(len(rows), count)]
            rows = np.sort(np.concatenate([*chosen, *(rows for rows in classes if len(rows) <= count)]))
            origins = {name: values[rows] for name, values in self._origins(file, base, len(labels)).items()}
            return States(self._observations(file, base, rows), labels[rows], origins)

    def unlabelled_origins(self) -> dict[str, NDArray[np.int64]]:
        """The unlabelled states' origins, int64 (M,) by name; empty if the file has none."""
        with self._file() as file:
            return self._origins(file, "unlabelled", self._count(file, "unlabelled"))

    def counts(self) -> dict[str, Any]:
        """Numbers of states and positives, without reading the observations."""
        with self._file() as file:
            rows: dict[str, Any] = {"unlabelled": self._count(file, "unlabelled")}
            for split in SPLITS:
                rows[split] = {}
                for goal in self.sub_goals:
                    labels = self._labels(file, f"{split}/{goal}")
                    rows[split][goal] = {"states": len(labels), "positives": int(labels.sum())}
        return rows

    def _split(self, split: str, sub_goal: str) -> States:
        if sub_goal not in self.sub_goals:
            raise UserError("unknown sub-goal", sub_goal, f"{self.path} has {', '.join(self.sub_goals)}.")
        base = f"{split}/{sub_goal}"
        with self._file() as file:
            observations = self._observations(file, base)
            labels = self._labels(file, base)
            return States(observations, labels, self._origins(file, base, len(observations)))

    def _labels(self, file: Any, base: str) -> NDArray[np.bool_]:
        labels, states = hdf5.read_array(file, f"{base}/labels", "bui"), self._count(file, base)
        if labels.shape != (states,):
            raise hdf5.Foreign(f"{base}: labels of shape {labels.shape} for {states} states")
        return labels.astype(np.bool_)

    def _observations(self, file: Any, base: str, rows: slice | NDArray[np.int64] | None = None) -> Observations:
        name, dtype = f"{base}/observations", self.observation_dtype
        data = hdf5.checked(file, name, KINDS)
        if data.shape[1:] != self.observation_shape or data.dtype != dtype:
            raise hdf5.Foreign(f"{name!r} is {data.dtype} {data.shape}, not {dtype} (N, {self.observation_shape})")
        values = hdf5.read_array(file, name, KINDS, rows)
        if not np.isfinite(numbers_of(values)).all():
            raise hdf5.Foreign(f"{name!r} has numbers that are not finite")
        return values

    @staticmethod
    def _count(file: Any, base: str) -> int:
        shape = hdf5.checked(file, f"{base}/observations", KINDS).shape
        if not shape:
            raise hdf5.Foreign(f"{base}/observations is a single number")
        return int(shape[0])

    @staticmethod
    def _origins(file: Any, base: str, count: int) -> dict[str, NDArray[np.int64]]:
        group = hdf5.find(file, f"{base}/origin")
        names = hdf5.members(group) if group is not None else []
        origins = {name: hdf5.read_array(file, f"{base}/origin/{name}", "iub") for name in names}
        for name, values in origins.items():
            if values.shape != (count,):
                raise hdf5.Foreign(f"{base}/origin/{name}: shape {values.shape} for {count} states")
        return {name: values.astype(np.int64) for name, values in origins.items()}

    def _json(self, name: str, kind: type) -> Any:
        parsed = self.attributes[name]
        if isinstance(parsed, str):
            parsed = parse_json(parsed, self.path, f"not a hypogoal data file, its attribute {name!r} is", RECOLLECT)
        if not isinstance(parsed, kind):
            do = f"Its attribute {name!r} is not a JSON {kind.__name__}."
            raise UserError("not a hypogoal data file", self.path, do)
        return parsed

    def _file(self) -> contextlib.AbstractContextManager[Any]:
        return hdf5.open_hdf5(self.path, "the data file", RECOLLECT)


def _spread(length: int, count: int) -> list[slice]:
    """Blocks of about ``count`` of ``length`` rows."""
    blocks = max(1, min(-(-count // BLOCK), length // BLOCK))  # blocks do not overlap
    starts = np.linspace(0, max(0, length - BLOCK), blocks).astype(np.int64)
    return [slice(start, start + min(count, BLOCK)) for start in starts]


def open_dataset(path: Path) -> Dataset:
    """Open a data file written by ``collect``, or by the user in the same schema; else a ``UserError``."""
    if path.is_dir():
        do = "Give the .h5 file in it."
        raise UserError("a folder where a data file is needed", path, do)
    if not path.exists():
        raise UserError("no such data file", path, advice("How to make it", "collect", "--help"))
    return Dataset(path)
