"""Spec H1: entries of the benchmark, the cells they are scored in, and the folder that keeps cell by cell."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from torch import nn

from hypogoal.core import own_code
from hypogoal.core.config import as_dict, from_values, parse_assignments, parse_integers, resolve
from hypogoal.core.errors import UserError
from hypogoal.core.files import MOST_INTEGER, read_json, replace_text, write_table
from hypogoal.core.progress import Progress
from hypogoal.core.seeding import rng_for, seed_for
from hypogoal.diversity import load_objective
from hypogoal.evaluation.plots import slug
from hypogoal.hypotheses.config import EnsembleConfig
from hypogoal.hypotheses.networks import Parts
from hypogoal.hypotheses.training import fit
from hypogoal.which_feature.scores import balanced_accuracies, labels_needed, rankings
from hypogoal.which_feature.states import (
    TILE,
    States,
    crossed_states,
    labelled_states,
    names_of,
    unlabelled_states,
)

CNN, ORACLE = "cnn", "oracle"  # entries that are no objectives: one member, and one taught by each factor's truth
NETWORK = f"{__name__}:tiles"
DEFAULTS: Mapping[str, Any] = {
    "members": 4, "network": NETWORK, "steps": 150, "learning_rate": 2e-3, "batch_size": 32, "diversity_weight": 0.01
}  # fmt: skip
LABELLED, UNLABELLED, COPIES = 256, 512, 20  # states; copies of each combination in the test, as many for the oracle
SHOWN = 4  # test states of each kind that a member is surest of
COLUMNS = ("entry", "mix", "seed", "member", "factor", "ranking", "balanced_accuracy", "at_best", "labels")
AGAIN = "Remove it and give the same command again, or choose another --out."


def tiles(channels: int) -> Parts:
    """The benchmark's member network: a layer that reads tiles, one of 3x3 tiles, one hidden dense layer."""
    layers: list[nn.Module] = []
    for inputs, kernel, stride in ((channels, TILE, TILE), (16, 3, 1)):
        layers += [nn.Conv2d(inputs, 16, kernel, stride, bias=False), nn.BatchNorm2d(16), nn.ReLU()]
    return layers, (64,)


@dataclass(frozen=True)
class Protocol:
    """What all entries have in common: the settings of training, and whether scenes are of two frames."""

    config: EnsembleConfig
    moved: bool = False


class Entry(NamedTuple):
    """A method under test: its name as given, its objective (or ``cnn``, ``oracle``), its weight (None: setting's)."""

    name: str
    objective: str
    weight: float | None


@dataclass(frozen=True)
class Cell:
    """One training of one entry, scored on crossed states; F factors, K members.

    Attributes:
        entry, mix, seed: which.
        ranking: float (K, F), see ``scores.rankings``.
        balanced_accuracy, at_best: float (K, F), at 0.5 and at the best threshold.
        labels: int (F,), see ``scores.labels_needed``.
        surest: int (K, 2, 4), the test states with the highest and with the lowest probability; empty where unknown.
    """

    entry: str
    mix: float
    seed: int
    ranking: NDArray[np.float64]
    balanced_accuracy: NDArray[np.float64]
    at_best: NDArray[np.float64]
    labels: NDArray[np.int64]
    surest: NDArray[np.int64]


def parse_entry(text: str) -> Entry:
    """``dbat``, ``module:object``, ``cnn`` or ``oracle``; of objectives also with a weight, ``dbat:0.01``.

    Raises:
        UserError: no such objective, code that was not allowed, or no weight.
    """
    objective, _, last = text.rpartition(":")
    try:
        entry = Entry(text, objective, float(last)) if objective else Entry(text, text, None)
    except ValueError:
        entry = Entry(text, text, None)
    if entry.objective in (CNN, ORACLE):
        if entry.weight is not None:
            raise UserError(f"{entry.objective} has no weight", text, f"Give {entry.objective}.")
    else:
        load_objective(entry.objective)
    return entry


def parse_entries(text: str, protocol: Protocol) -> list[Entry]:
    """Entries with commas between, each once; see :func:`parse_entry`. Weights are checked, too."""
    entries = [parse_entry(name) for name in dict.fromkeys(name.strip() for name in text.split(","))]
    for entry in entries:
        config_of(entry, protocol)
    return entries


def objectives_in(text: str) -> list[str]:
    """What stands for an objective in a user's entries, as :func:`hypogoal.core.own_code.given` wants it."""
    names = [name.strip() for name in text.split(",")]
    return [*names, *(name.rpartition(":")[0] for name in names)]


def parse_mixes(text: str) -> list[float]:
    """``0.1,0.5``, each from 0 to 1.

    Raises:
        UserError: they are not.
    """
    try:
        mixes = [float(mix) for mix in text.split(",")]
    except ValueError:
        mixes = []
    if not mixes or not all(0 <= mix <= 1 for mix in mixes):
        raise UserError("these are no shares of states", repr(text[:200]), "Write them as 0,0.5,1.")
    return list(dict.fromkeys(mixes))


def parse_seeds(text: str) -> list[int]:
    """``0-4`` or ``0,3,7``.

    Raises:
        UserError: they are no seeds.
    """
    seeds = parse_integers(text)
    if not all(0 <= seed <= MOST_INTEGER for seed in seeds):
        raise UserError("these are no seeds", repr(text[:200]), f"They go from 0 to {MOST_INTEGER}.")
    return list(dict.fromkeys(seeds))


def protocol_of(members: int | None, assignments: Iterable[str], moved: bool) -> Protocol:
    """The benchmark's defaults with what was given.

    Raises:
        UserError: a setting that there is not, or that is an entry's own.
    """
    given = list(assignments)
    if "diversity" in parse_assignments(given):
        raise UserError("objectives are entries here", "--set diversity", "Give --diversity NAME,NAME:WEIGHT.")
    options = {"members": members}
    stage = "train-ensemble"
    config = resolve(EnsembleConfig, stage=stage, defaults=DEFAULTS, options=options, assignments=given)
    return Protocol(config, moved)


def config_of(entry: Entry, protocol: Protocol) -> EnsembleConfig:
    """The settings that the entry's members are trained with."""
    if entry.objective in (CNN, ORACLE):
        return replace(protocol.config, members=1, diversity="none")
    weight = {} if entry.weight is None else {"diversity_weight": entry.weight}
    values = {**as_dict(protocol.config), "diversity": entry.objective, **weight}
    return from_values(EnsembleConfig, values, "train-ensemble")


def run_cell(entry: Entry, mix: float, seed: int, protocol: Protocol) -> Cell:
    """Train an entry's members with the product's own ``fit`` and score them on crossed states.

    Entries of one seed have the same states, initial weights and batches.
    """
    test = crossed_states(COPIES, seed, protocol.moved)
    probabilities = _trained(entry, mix, seed, protocol, test)
    ranked = rankings(probabilities, test.factors)
    at_half, at_best = balanced_accuracies(probabilities, test.factors)
    labels = labels_needed(probabilities, test.factors, ranked, rng_for(seed, "which-feature", "labels"))
    order = probabilities.argsort(axis=0, kind="stable").T
    surest = np.stack([order[:, : -SHOWN - 1 : -1], order[:, :SHOWN]], axis=1)
    return Cell(entry.name, mix, seed, ranked, at_half, at_best, labels, surest)


def _trained(entry: Entry, mix: float, seed: int, protocol: Protocol, test: States) -> NDArray[np.float32]:
    """Probabilities (N, K) of the trained members on the test states."""
    config, moved = config_of(entry, protocol), protocol.moved
    with own_code.vouched(NETWORK):
        if entry.objective == ORACLE:
            told = crossed_states(COPIES, seed, moved, split=ORACLE)
            seeds = [seed_for(seed, ORACLE, factor) for factor in range(told.factors.shape[1])]
            members = [
                fit(told.observations, truth, told.observations[:0], config, own)
                for truth, own in zip(told.factors.T, seeds, strict=True)
            ]
            return np.concatenate([member.predict(test.observations) for member in members], axis=1)
        labelled = labelled_states(LABELLED, seed, moved)
        unlabelled = unlabelled_states(UNLABELLED, mix, seed, moved).observations
        ensemble = fit(labelled.observations, labelled.factors[:, 0], unlabelled, config, seed_for(seed, "ensemble"))
        return ensemble.predict(test.observations)


def run(
    entries: Sequence[Entry], mixes: Sequence[float], seeds: Sequence[int], protocol: Protocol, out: Path, quiet: bool
) -> list[Cell]:
    """Every cell that is not in ``out`` yet, seed by seed; then all that are there, ``results.csv`` with them.

    Raises:
        UserError: ``out`` is something else, was begun with other settings, or a cell in it is damaged.
    """
    _begin(out, protocol)
    wanted = [(entry, mix, seed) for seed in seeds for mix in mixes for entry in entries]
    paths = [out / "cells" / f"{slug(entry.name)}_{mix}_{seed}.json" for entry, mix, seed in wanted]
    with Progress("which-feature", len(wanted), quiet) as progress:
        progress.resume(sum(path.exists() for path in paths))
        for cell, path in zip(wanted, paths, strict=True):
            if not path.exists():
                replace_text(path, _text(run_cell(*cell, protocol)))
                progress.advance()
    cells = [_read(path, protocol.moved) for path in sorted((out / "cells").glob("*.json"))]
    write_table(out / "results.csv", COLUMNS, rows_of(cells, protocol.moved))
    return cells


def rows_of(cells: Iterable[Cell], moved: bool) -> Iterator[tuple[Any, ...]]:
    """The lines of ``results.csv``: one for each cell, member and factor, in ``COLUMNS``."""
    for cell in cells:
        for member, factor in np.ndindex(*cell.ranking.shape):
            scores = (table[member, factor] for table in (cell.ranking, cell.balanced_accuracy, cell.at_best))
            numbers = (*(f"{score:.4f}" for score in scores), int(cell.labels[factor]))
            yield (cell.entry, cell.mix, cell.seed, member, names_of(moved)[factor], *numbers)


def _begin(out: Path, protocol: Protocol) -> None:
    """The folder, with the settings that all of its cells share."""
    path, settings = out / "settings.json", {**as_dict(protocol.config), "moved": protocol.moved}
    if not path.exists():
        if out.exists() and (not out.is_dir() or any(out.iterdir())):
            raise UserError("this is no folder of the benchmark", out, "Choose another --out.")
        (out / "cells").mkdir(parents=True)
        replace_text(path, json.dumps(settings, indent=1) + "\n")
    elif read_json(path, "the benchmark's settings are", "Choose another --out.") != settings:
        raise UserError("this benchmark was begun with other settings", out, "Give those, or choose another --out.")


def _text(cell: Cell) -> str:
    """A cell as JSON."""
    return json.dumps(vars(cell), default=lambda array: array.tolist()) + "\n"


def _read(path: Path, moved: bool) -> Cell:
    """A cell from its file, which may be anyone's."""
    data = read_json(path, "the cell is", AGAIN)
    try:
        ranked, at_half, at_best = (np.array(data[name], dtype=np.float64) for name in COLUMNS[5:8])
        labels, surest = (np.array(data[name], dtype=np.int64) for name in ("labels", "surest"))
        named = str(data["entry"]), float(data["mix"]), int(data["seed"])
    except (TypeError, ValueError, KeyError, OverflowError):
        raise UserError("the cell is damaged", path, AGAIN) from None
    shape = (len(ranked) if ranked.ndim else 0, len(names_of(moved)))
    shapes = [array.shape for array in (ranked, at_half, at_best, labels, surest)]
    fitting = shapes == [shape, shape, shape, shape[1:], (shape[0], 2, SHOWN)] and shape[0] > 0
    within = all(((table >= 0) & (table <= 1)).all() for table in (ranked, at_half, at_best))
    if not (fitting and within and surest.min() >= 0 and surest.max() < COPIES * 2 ** shape[1]):
        raise UserError("the cell is damaged", path, AGAIN)
    return Cell(*named, ranked, at_half, at_best, labels, surest)
