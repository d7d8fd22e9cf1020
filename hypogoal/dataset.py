"""The HDF5 schema of collected states: labelled, unlabelled, held-out (Spec A1, A8).

``labelled/<sub-goal>/{observations,labels}``, ``unlabelled/observations``, ``heldout/<sub-goal>/{observations,labels}``
and ``origin/*`` per state beside each. Sub-goals that share their states share one dataset on disk (hard links).
The root's attributes say format version, domain, observation space, arguments and versions; ``complete`` is written
last, so a file without it was cut off.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hypogoal.core.artefacts import FORMAT_VERSION, claim, versions
from hypogoal.core.errors import UserError

SPLITS = ("labelled", "heldout")


@dataclass(frozen=True)
class States:
    """States with their true labels.

    Attributes:
        observations: uint8 (N, *observation_shape).
        labels: bool (N, G), one column per sub-goal.
        origins: int (N,) arrays that say where each state comes from (layout_seed, agent_x, ...).
    """

    observations: NDArray[np.uint8]
    labels: NDArray[np.bool_]
    origins: Mapping[str, NDArray[np.int64]] = field(default_factory=dict)


@dataclass(frozen=True)
class Collected:
    """What a domain's ``collect`` returns: three sets of states and the sub-goals' names (G of them)."""

    observation_shape: tuple[int, ...]
    sub_goals: tuple[str, ...]
    labelled: States
    unlabelled: States
    heldout: States


@dataclass(frozen=True)
class Split:
    """States of one sub-goal: observations uint8 (N, *obs), labels bool (N,), origins int (N,) each."""

    observations: NDArray[np.uint8]
    labels: NDArray[np.bool_]
    origins: Mapping[str, NDArray[np.int64]]


def write_dataset(
    path: Path,
    collected: Collected,
    *,
    domain: str,
    config: Mapping[str, Any],
    seed: int,
    force: bool = False,
) -> None:
    """Write collected states; the file appears under its name only when it is whole."""
    import h5py

    claim(path, force=force)
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.partial-{os.getpid()}")
    try:
        with h5py.File(partial, "w") as file:
            file.attrs["format"] = FORMAT_VERSION
            file.attrs["domain"] = domain
            file.attrs["sub_goals"] = json.dumps(list(collected.sub_goals))
            file.attrs["observation_shape"] = json.dumps(list(collected.observation_shape))
            file.attrs["config"] = json.dumps(dict(config))
            file.attrs["seed"] = seed
            file.attrs["versions"] = json.dumps(versions())
            for split, states in (("labelled", collected.labelled), ("heldout", collected.heldout)):
                _write_split(file, split, states, collected.sub_goals)
                file.flush()
            group = file.create_group("unlabelled")
            _write_observations(group, collected.unlabelled.observations)
            _write_origins(group, collected.unlabelled.origins)
            file.flush()
            file.attrs["complete"] = True
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


def _write_split(file: Any, split: str, states: States, sub_goals: tuple[str, ...]) -> None:
    first: Any = None
    for index, sub_goal in enumerate(sub_goals):
        group = file.create_group(f"{split}/{sub_goal}")
        if first is None:
            _write_observations(group, states.observations)
            _write_origins(group, states.origins)
            first = group
        else:
            group["observations"] = first["observations"]
            if "origin" in first:
                group["origin"] = first["origin"]
        group.create_dataset("labels", data=states.labels[:, index].astype(np.bool_))


def _write_observations(group: Any, observations: NDArray[np.uint8]) -> None:
    chunk = (min(64, max(1, len(observations))), *observations.shape[1:])
    group.create_dataset("observations", data=observations, chunks=chunk, compression="gzip", compression_opts=1)


def _write_origins(group: Any, origins: Mapping[str, NDArray[np.int64]]) -> None:
    for name, values in origins.items():
        group.create_dataset(f"origin/{name}", data=values)


class Dataset:
    """A complete data file, opened for reading. Use :func:`open_dataset`."""

    def __init__(self, path: Path):
        self.path = path
        with _open(path) as file:
            self.attributes = {key: _plain(value) for key, value in file.attrs.items()}
        foreign = UserError("not a hypogoal data file", path, "Make one with 'hypogoal collect'.")
        if not isinstance(self.attributes.get("format"), int):
            raise foreign
        if self.attributes["format"] > FORMAT_VERSION:
            raise UserError(
                f"format {self.attributes['format']} is newer than this hypogoal reads", path, "Upgrade hypogoal."
            )
        if not self.attributes.get("complete", False):
            raise UserError("the data file is not complete", path, "Collect it again.")
        try:
            self.sub_goals: tuple[str, ...] = tuple(map(str, json.loads(self.attributes["sub_goals"])))
            self.observation_shape: tuple[int, ...] = tuple(map(int, json.loads(self.attributes["observation_shape"])))
            self.domain = str(self.attributes["domain"])
            self.config: dict[str, Any] = dict(json.loads(self.attributes["config"]))
        except (KeyError, TypeError, ValueError):
            raise foreign from None

    def labelled(self, sub_goal: str) -> Split:
        """The labelled states of one sub-goal."""
        return self._split("labelled", sub_goal)

    def heldout(self, sub_goal: str) -> Split:
        """The held-out states of one sub-goal, with their true labels: for evaluation only."""
        return self._split("heldout", sub_goal)

    def unlabelled(self) -> NDArray[np.uint8]:
        """The unlabelled states: uint8 (M, *obs)."""
        with _open(self.path) as file:
            return _read(file, "unlabelled/observations", self.path)

    def unlabelled_origins(self) -> dict[str, NDArray[np.int64]]:
        """Where each unlabelled state comes from: int64 (M,) by name; empty where the file does not say."""
        with _open(self.path) as file:
            origins = file["unlabelled"].get("origin", {})
            return {name: origins[name][()] for name in origins}

    def counts(self) -> dict[str, Any]:
        """Numbers of states and positives, without reading the observations."""
        with _open(self.path) as file:
            rows: dict[str, Any] = {"unlabelled": int(file["unlabelled/observations"].shape[0])}
            for split in SPLITS:
                rows[split] = {}
                for goal in self.sub_goals:
                    labels = _read(file, f"{split}/{goal}/labels", self.path)
                    rows[split][goal] = {"states": len(labels), "positives": int(labels.sum())}
        return rows

    def _split(self, split: str, sub_goal: str) -> Split:
        if sub_goal not in self.sub_goals:
            raise UserError("unknown sub-goal", sub_goal, f"{self.path} has {', '.join(self.sub_goals)}.")
        with _open(self.path) as file:
            base = f"{split}/{sub_goal}"
            origins = file[base].get("origin", {})
            return Split(
                _read(file, f"{base}/observations", self.path),
                _read(file, f"{base}/labels", self.path).astype(np.bool_),
                {name: origins[name][()] for name in origins},
            )


def open_dataset(path: Path) -> Dataset:
    """Open a data file written by ``collect`` (or by the user in the same schema).

    Raises:
        UserError: missing, truncated, not HDF5, not ours, incomplete, or of a newer format.
    """
    if not path.exists():
        raise UserError("no such data file", path, "Make it with 'hypogoal collect'.")
    if path.is_dir():
        raise UserError(
            "a folder where a data file is needed", path, "Give the .h5 file that 'hypogoal collect' wrote."
        )
    return Dataset(path)


def _open(path: Path) -> Any:
    import h5py

    try:
        return h5py.File(path, "r")
    except OSError:
        raise UserError("the data file is truncated or not HDF5", path, "Collect it again.") from None


def _read(file: Any, name: str, path: Path) -> NDArray[Any]:
    try:
        return np.asarray(file[name][()])
    except (KeyError, OSError):
        raise UserError(f"the data file has no readable {name!r}", path, "Collect it again.") from None


def _plain(value: Any) -> Any:
    return value.item() if isinstance(value, np.generic) else value
