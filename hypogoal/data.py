"""The HDF5 file of collected states, which are labelled, unlabelled or held out.

The file has the datasets ``labelled/<sub-goal>/{observations,labels}``, ``unlabelled/observations`` and
``heldout/<sub-goal>/{observations,labels}``. Beside the observations, ``origin/*`` has a number for each state.
Sub-goals with the same states share one dataset on disk (hard links). The root's attributes are the version of the
format, the domain, the observation space, the arguments and the versions. The attribute ``complete`` becomes true last,
so a file in which it is false was cut off.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import chain
from math import prod
from pathlib import Path
from typing import Any

import numpy as np

from hypogoal.core import hdf5
from hypogoal.core.arrays import Array, Bools, Ints
from hypogoal.core.artefacts import versions
from hypogoal.core.errors import UserError
from hypogoal.label_checks import require_names
from hypogoal.observations import (
    NUMBERS,
    DType,
    Observations,
    Shape,
    digest,
    fields_of,
    is_stored,
    numbers_of,
    type_of,
    type_text,
)

DATA_FORMAT = 2  # in format 1 texts had variable length
SPLITS = ("labelled", "heldout")
GROUP = "group"  # an origin; to choose a weight, the states of a group are held out together
PLANTED = "planted_"  # the beginning of the names of origins that say whether a state has a feature


@dataclass(frozen=True)
class States:
    """States with their true labels.

    Attributes:
        observations: uint8 or float32 (N, *observation_shape), or mixed (N,).
        labels: bool (N, G), one column per sub-goal, or (N,) for a single sub-goal.
        origins: by name, int (N,), where each state comes from (layout_seed, agent_x, ...).
    """

    observations: Observations
    labels: Bools
    origins: Mapping[str, Ints] = field(default_factory=dict)

    def where(self, kept: Array) -> States:
        """Return the states that ``kept`` names, either a mask, bool (N,), or their rows, int (M,)."""
        origins = {name: values[kept] for name, values in self.origins.items()}
        observations = self.observations[kept]
        return States(observations, self.labels[kept], origins)


@dataclass(frozen=True)
class Collected:
    """What a domain's ``collect`` returns.

    Attributes:
        observation_shape: the shape of one observation.
        sub_goals: the names of the sub-goals (G).
        labelled, unlabelled, heldout: the three sets of states.
        features: the names of an observation's numbers, or empty if they have no names.
        channels: for stacked pictures, how many frames of how many colours their channels are, by key. The key of an
            observation that is not mixed is "".
    """

    observation_shape: Shape
    sub_goals: tuple[str, ...]
    labelled: States
    unlabelled: States
    heldout: States
    features: tuple[str, ...] = ()
    channels: Mapping[str, Sequence[int]] = field(default_factory=dict)


def leave_out(states: States, *training: Observations) -> States:
    """Return the states whose observations are in none of the sets ``training``, of observations (M, ...) each."""
    digests = set(map(digest, chain(*training)))
    apart = [digest(observation) not in digests for observation in states.observations]
    return states.where(np.array(apart, bool))


def joined(parts: Sequence[States]) -> States:
    """Return the states of all parts as one set, with the origins that all parts have."""
    if len(parts) == 1:
        return parts[0]
    observations = np.concatenate([part.observations for part in parts])
    labels = np.concatenate([part.labels for part in parts])
    shared = set.intersection(*[{*part.origins} for part in parts])
    origins = {}
    for name in sorted(shared):
        origins[name] = np.concatenate([part.origins[name] for part in parts])
    return States(observations, labels, origins)


def write_dataset(
    path: Path,
    collected: Collected,
    *,
    domain: str,
    config: Mapping[str, Any],
    seed: int,
) -> None:
    """Write collected states to ``path``. An earlier file there is replaced once the new file is complete.

    Raises ``UserError`` if a name cannot be a file name, if labels are not truth values, if numbers are not finite, or
    if observations are of a type or shape that could not be read again.
    """
    require_names(collected.sub_goals)
    _require_one_kind(collected)
    attributes = {
        "format": DATA_FORMAT,
        "domain": domain,
        "sub_goals": json.dumps(collected.sub_goals),
        "observation_shape": json.dumps(collected.observation_shape),
        "observation_dtype": type_text(collected.unlabelled.observations.dtype),
        "config": json.dumps(dict(config)),
        "seed": seed,
        "versions": json.dumps(versions()),
        "complete": False,
    }
    if collected.channels:
        attributes["channels"] = json.dumps(dict(collected.channels))
    with hdf5.create_hdf5(path) as file:
        for name, value in attributes.items():
            stored = hdf5.fixed(value) if isinstance(value, str) else value
            file.attrs[name] = stored
        _write_split(file, "labelled", collected.labelled, collected.sub_goals)
        _write_split(file, "heldout", collected.heldout, collected.sub_goals)
        _write_states(file.create_group("unlabelled"), collected.unlabelled)
        if collected.features:  # a dataset, because they may exceed an attribute's size
            file["features"] = hdf5.fixed(json.dumps(collected.features))
        file.attrs.modify("complete", True)


def _require_one_kind(collected: Collected) -> None:
    """Raise ``UserError`` if observations are of a type that files do not keep, or if sets differ in type or shape."""
    dtype = collected.unlabelled.observations.dtype
    shape = tuple(collected.observation_shape)
    for name in ("labelled", "unlabelled", "heldout"):
        observations = getattr(collected, name).observations
        is_alike = observations.dtype == dtype and observations.shape[1:] == shape
        if not is_alike or not is_stored(dtype):
            fault = f"the domain's {name} observations cannot be stored"
            do = f"Give all sets as uint8, as float32 or as hypogoal.observations.packed makes them, of shape {shape}."
            raise UserError(fault, f"{observations.dtype} {observations.shape}", do)


def _write_split(file: Any, split: str, states: States, sub_goals: Sequence[str]) -> None:
    """Write a group for each sub-goal. The states are stored once, with a hard link in each group."""
    labels = np.asarray(states.labels)
    if labels.dtype != bool:  # NumPy turns the text 'False' into True
        raise UserError(f"the domain's {split} labels are not truth values", labels.dtype, "Give bool (N, sub-goals).")
    first = file.create_group(f"{split}/{sub_goals[0]}")
    _write_states(first, states)
    columns = labels.reshape(len(labels), len(sub_goals))
    for sub_goal, column in zip(sub_goals, columns.T, strict=True):
        group = file.require_group(f"{split}/{sub_goal}")
        for name in ("observations", "origin"):  # in this order, whatever the hashes of this process
            if name in first and name not in group:
                group[name] = first[name]
        hdf5.store(group, "labels", column)


def _write_states(group: Any, states: States) -> None:
    finite = np.isfinite(numbers_of(states.observations)).all(axis=1)
    if not finite.all():
        fault = "the domain's observations have numbers that are not finite"
        raise UserError(fault, f"{group.name}, state {finite.argmin()}", "Clip or replace them.")
    hdf5.store(group, "observations", states.observations)
    for name, values in states.origins.items():
        hdf5.store(group, f"origin/{name}", values)


@dataclass(frozen=True)
class Dataset:
    """A complete data file, from which states are read when they are asked for. Use :func:`open_dataset`."""

    path: Path
    domain: str
    config: dict[str, Any]
    seed: int
    sub_goals: tuple[str, ...]
    observation_shape: Shape
    observation_dtype: DType
    channels: Mapping[str, Sequence[int]] = field(default_factory=dict)  # see :class:`Collected`

    @property
    def observation_bytes(self) -> int:
        """The size of one observation in bytes."""
        return prod(self.observation_shape) * self.observation_dtype.itemsize

    def features(self) -> list[str]:
        """Return the names of an observation's numbers, in order.

        If the file has no names, they are ``x[0]``, ``x[1]``, ... For a mixed observation they are ``key[0]``,
        ``key[1]``, ..., but a picture or a single number has its key alone.
        """
        with hdf5.opened(self.path) as file:
            if "features" in file:
                return [*json.loads(file["features"][()])]
        names = []
        for key, (kind, shape) in fields_of(self.observation_shape, self.observation_dtype).items():
            size = prod(shape) if kind == NUMBERS else 1
            numbered = [f"{key or 'x'}[{place}]" for place in range(size)]
            names += [key] if key and size == 1 else numbered
        return names

    def labelled(self, sub_goal: str) -> States:
        """Return the labelled states of one sub-goal."""
        return self._states("labelled", sub_goal)

    def heldout(self, sub_goal: str) -> States:
        """Return the held-out states of one sub-goal with their true labels, which are for evaluation only."""
        return self._states("heldout", sub_goal)

    def all_heldout(self) -> dict[str, States]:
        """Return the held-out states by sub-goal. Observations that the file holds once are one array."""
        read: dict[int, Observations] = {}
        return {sub_goal: self._states("heldout", sub_goal, read) for sub_goal in self.sub_goals}

    def unlabelled(self) -> Observations:
        """Return the observations of the unlabelled states, (M, *observation_shape)."""
        return self.unlabelled_states().observations

    def unlabelled_states(self) -> States:
        """Return the unlabelled states with their origins, if the file has any. Their labels are empty, (M, 0)."""
        return self._states("unlabelled")

    def counts(self) -> dict[str, Any]:
        """Count the states of each set, and the positives among them by sub-goal, without reading the observations."""
        with hdf5.opened(self.path) as file:
            counts: dict[str, Any] = {"unlabelled": len(file["unlabelled/observations"])}
            for split in SPLITS:
                counts[split] = {}
                for goal in self.sub_goals:
                    labels = _column(file[f"{split}/{goal}"], "labels")
                    counts[split][goal] = {"states": len(labels), "positives": int(labels.sum())}
            return counts

    def _states(self, split: str, sub_goal: str = "", read: dict[int, Observations] | None = None) -> States:
        """Return the states of a split. Raises ``UserError`` if they are not as the root's attributes say.

        ``read`` are the observations that were read already, by their place in the file.
        """
        import h5py

        read = {} if read is None else read
        if sub_goal not in ("", *self.sub_goals):
            goals = ", ".join(self.sub_goals)
            raise UserError("unknown sub-goal", sub_goal, f"{self.path} has {goals}.")
        with hdf5.opened(self.path) as file:
            group = file[f"{split}/{sub_goal}"]
            data = hdf5.whole(group["observations"])
            has_shape = data.shape[1:] == self.observation_shape
            if not has_shape or data.dtype != self.observation_dtype:
                raise ValueError(f"{data.name} is {data.dtype} {data.shape}")
            place = h5py.h5o.get_info(data.id).addr
            if place not in read:
                read[place] = data[()]
            values = read[place]
            if not np.isfinite(numbers_of(values)).all():
                raise ValueError(f"{data.name} has numbers that are not finite")
            labels = np.zeros((len(values), 0), bool)
            if sub_goal:
                labels = _column(group, "labels").astype(bool)
            origins = {}
            for name in group.get("origin", ()):
                origins[name] = _column(group, f"origin/{name}").astype(int)
            return States(values, labels, origins)


def _column(group: Any, name: str) -> Array:
    """Return the values of a dataset that has one value for each state of a group, (N,)."""
    values, states = hdf5.whole(group[name])[()], len(group["observations"])
    if values.shape != (states,):
        raise ValueError(f"{group.name}/{name} of shape {values.shape} for {states} states")
    return values


def open_dataset(path: Path) -> Dataset:
    """Open a data file that ``collect`` wrote, or the user in the same schema. Raises ``UserError`` for other files."""
    with hdf5.opened(path) as file:
        attributes = {name: hdf5.plain(value) for name, value in file.attrs.items()}
        version = attributes.get("format")
        if not isinstance(version, int):
            raise UserError("not a hypogoal data file", path, "'hypogoal collect' and 'hypogoal import' make one.")
        if version != DATA_FORMAT:
            do = hdf5.RECOLLECT if version < DATA_FORMAT else "Upgrade hypogoal."
            raise UserError(f"the data file has format {version}, this hypogoal reads {DATA_FORMAT}", path, do)
        if not attributes["complete"]:
            raise UserError("the data file is not complete", path, hdf5.RECOLLECT)
        dataset = Dataset(
            path=path,
            domain=attributes["domain"],
            config=json.loads(attributes["config"]),
            seed=attributes["seed"],
            sub_goals=tuple(json.loads(attributes["sub_goals"])),
            observation_shape=tuple(json.loads(attributes["observation_shape"])),
            observation_dtype=type_of(attributes["observation_dtype"]),
            channels=json.loads(attributes.get("channels", "{}")),
        )
        require_names(dataset.sub_goals)
    return dataset
