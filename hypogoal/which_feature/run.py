"""Spec H1: the benchmark's entries, their training and scores, and the folder of its results."""

import csv
import io
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from operator import itemgetter
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hypogoal.core.config import as_dict, from_values, resolve, setting
from hypogoal.core.drafts import sweep_up
from hypogoal.core.errors import UserError
from hypogoal.core.files import read_json, read_text, replace_text, write_table
from hypogoal.core.progress import Progress
from hypogoal.core.seeding import rng_for, seed_for
from hypogoal.diversity import load_objective
from hypogoal.evaluation.numbers import grouped
from hypogoal.hypotheses.config import EnsembleConfig
from hypogoal.hypotheses.proposals import agreements
from hypogoal.hypotheses.training import fit
from hypogoal.which_feature.scores import balanced_accuracies, labels_needed, rankings
from hypogoal.which_feature.states import (
    FACTORS,
    KNOWN,
    MOVED,
    Draw,
    Scenes,
    crossed_states,
    drawn,
    labelled_states,
    unlabelled_states,
)
from hypogoal.which_feature.textures import textured

# Entries without objective: one member; one trained on the truth of each factor; members taught by proposals.
CNN, ORACLE, JOINT = "cnn", "oracle", "joint"
DEFAULTS: Mapping[str, Any] = {  # where they differ from those of train-ensemble
    "members": 4,
    "diversity_weight": 0.01,
    "network": "tiles",
    "steps": 150,
    "learning_rate": 2e-3,
    "batch_size": 32,
}
DRAW: Mapping[str, Draw] = {"tiles": drawn, "textures": textured}
RESULTS = "results.csv"
SCORES = ("ranking", "balanced_accuracy", "at_best")
COLUMNS = ("entry", "mix", "seed", "member", "factor", *SCORES, "labels")
AGAIN = "Remove it and give the same command again, or choose another --out."


@dataclass(frozen=True)
class WhichFeatureConfig(EnsembleConfig):
    """Settings of ensembles are those of training, except ``diversity``, which names all entries."""

    mix: tuple[float, ...] = setting((0.5,), "shares of unlabelled states with crossed factors", low=0.0, high=1.0)
    seeds: tuple[int, ...] = setting((0, 1, 2, 3, 4), "seeds", low=0)
    factors: tuple[str, ...] = setting(FACTORS, f"planted features, of {', '.join(KNOWN)}", choices=KNOWN)
    scenes: str = setting(
        "tiles",
        "tiles: MiniGrid's; textures: objects of any size at any pixel over textures",
        choices=("tiles", "textures"),
    )
    labelled: int = setting(256, "labelled states", low=4, high=100_000)
    unlabelled: int = setting(512, "unlabelled states; an oracle has more in proportion", low=1, high=100_000)
    high: float = setting(0.95, "a member owns a factor that it ranks at least this well", low=0.5, high=1.0)
    low: float = setting(0.6, "if it ranks every other factor at most this well, either way round", low=0.5, high=1.0)


def resolved(options: Mapping[str, Any], assignments: Iterable[str] = ()) -> WhichFeatureConfig:
    """The settings with the benchmark's defaults; see :func:`hypogoal.core.config.resolve`."""
    stage = "train-ensemble"
    return resolve(WhichFeatureConfig, stage=stage, options=options, assignments=assignments, defaults=DEFAULTS)


class Entry(NamedTuple):
    """A method under test: its name as given, its objective (or ``cnn``, ...), its weight (None: setting's)."""

    name: str
    objective: str
    weight: float | None


@dataclass(frozen=True)
class Scored:
    """An entry, trained and scored on crossed states; F factors, K members."""

    entry: str
    mix: float
    seed: int
    ranking: NDArray[np.float64]  # (K, F), see ``scores.rankings``
    balanced_accuracy: NDArray[np.float64]  # (K, F), at 0.5
    at_best: NDArray[np.float64]  # (K, F), at the best threshold
    labels: NDArray[np.int64]  # (F,), see ``scores.labels_needed``


def copies(factors: Sequence[str]) -> int:
    """Copies of each combination of factors for the test and the oracle: 320 states, more with five factors."""
    return max(20, 320 >> len(factors))


def parse_entry(text: str) -> Entry:
    """``dbat``, ``module:object``, ``cnn``, ``oracle`` or ``joint``; objectives may have a weight, ``dbat:0.01``.

    An unknown objective, code that was not allowed, or a wrong weight is a ``UserError``.
    """
    objective, _, last = text.rpartition(":")
    try:
        entry = Entry(text, objective, float(last)) if objective else Entry(text, text, None)
    except ValueError:
        entry = Entry(text, text, None)
    if entry.objective in (CNN, ORACLE, JOINT):
        if entry.weight is not None:
            raise UserError(f"{entry.objective} has no weight", text, f"Give {entry.objective}.")
    else:
        load_objective(entry.objective)
    return entry


def objectives_in(text: str) -> list[str]:
    """The possible names of objectives in a user's entries, for :func:`hypogoal.core.own_code.given`."""
    names = [name.strip() for name in text.split(",")]
    return [*names, *(name.rpartition(":")[0] for name in names)]


def config_of(entry: Entry, config: WhichFeatureConfig) -> WhichFeatureConfig:
    """The settings that the entry's members are trained with."""
    if entry.objective in (CNN, ORACLE):
        return replace(config, members=1, diversity="none", proposals="none")
    if entry.objective == JOINT:
        return replace(config, diversity="none", proposals="joint")
    weight = {} if entry.weight is None else {"diversity_weight": entry.weight}
    return from_values(WhichFeatureConfig, {**as_dict(config), "diversity": entry.objective, **weight}, entry.name)


def run_cell(entry: Entry, mix: float, seed: int, config: WhichFeatureConfig) -> Scored:
    """Train an entry's members with ``fit``, as train-ensemble does, and score them on crossed states.

    Entries of one seed have the same states, initial weights and batches.
    """
    test = crossed_states(copies(config.factors), seed, config.factors, DRAW[config.scenes])
    return scored(entry.name, mix, seed, _trained(entry, mix, seed, config_of(entry, config), test), test)


def scored(entry: str, mix: float, seed: int, probabilities: NDArray[np.float32], test: Scenes) -> Scored:
    """The scores of members by their probabilities (N, K) on crossed states."""
    ranked = rankings(probabilities, test.factors)
    at_half, at_best = balanced_accuracies(probabilities, test.factors)
    labels = labels_needed(probabilities, test.factors, ranked, rng_for(seed, "which-feature", "labels"))
    return Scored(entry, mix, seed, ranked, at_half, at_best, labels)


def _trained(entry: Entry, mix: float, seed: int, config: WhichFeatureConfig, test: Scenes) -> NDArray[np.float32]:
    """Probabilities (N, K) of the trained members on the test states."""
    names, draw = config.factors, DRAW[config.scenes]
    if entry.objective == ORACLE:
        more = max(1, config.unlabelled // WhichFeatureConfig.unlabelled)
        crossed = crossed_states(copies(names) * more, seed, names, draw, split=ORACLE)
        members = [
            fit(crossed.observations, truth, crossed.observations[:0], config, seed_for(seed, ORACLE, factor))
            for factor, truth in enumerate(crossed.factors.T)
        ]
        return np.concatenate([member.predict(test.observations) for member in members], axis=1)
    labelled = labelled_states(config.labelled, seed, names, draw)
    unlabelled = unlabelled_states(config.unlabelled, mix, seed, names, draw).observations
    ensemble = fit(labelled.observations, labelled.factors[:, 0], unlabelled, config, seed_for(seed, "ensemble"))
    return ensemble.predict(test.observations)


def run(config: WhichFeatureConfig, out: Path, quiet: bool) -> list[Scored]:
    """Score what ``results.csv`` in ``out`` lacks, seed by seed, and write it there; returns all scores.

    A ``UserError`` if ``out`` is something else or was begun with other settings, or if a file in it is damaged.
    """
    entries = [parse_entry(name) for name in dict.fromkeys(name.strip() for name in config.diversity.split(","))]
    for entry in entries:
        agreements(config_of(entry, config))  # refuse wrong settings
    if MOVED in config.factors and config.scenes != "tiles":
        raise UserError(f"{MOVED} needs two frames of tiles", f"scenes={config.scenes}", "Set scenes=tiles.")
    if not config.factors or len(set(config.factors)) < len(config.factors):
        raise UserError("each feature is planted once", f"factors {config.factors}", "Name each once.")
    wanted = [(entry, mix, seed) for seed in config.seeds for mix in config.mix for entry in entries]
    if not wanted:
        raise UserError("there is nothing to run", f"seeds {config.seeds}, mixes {config.mix}", "Give one of each.")
    _begin(out, config)
    results = out / RESULTS
    cells = read_cells(results) if results.exists() else []
    complete = {(cell.entry, cell.mix, cell.seed) for cell in cells}
    with Progress("which-feature", len(wanted), quiet) as progress:
        progress.resume(sum((entry.name, mix, seed) in complete for entry, mix, seed in wanted))
        for entry, mix, seed in wanted:
            if (entry.name, mix, seed) not in complete:
                cells.append(run_cell(entry, mix, seed, config))
                write_table(results, COLUMNS, rows_of(cells, config.factors))
                progress.advance()
    return read_cells(results)  # as it is on disk, rounded


def rows_of(cells: Iterable[Scored], factors: Sequence[str]) -> Iterator[tuple[Any, ...]]:
    """The lines of ``results.csv``, by entry, mix, seed, member and factor: the values of ``COLUMNS``."""
    for cell in sorted(cells, key=lambda cell: (cell.entry, cell.mix, cell.seed)):
        for member, factor in np.ndindex(*cell.ranking.shape):
            scores = (table[member, factor] for table in (cell.ranking, cell.balanced_accuracy, cell.at_best))
            numbers = (*(f"{score:.4f}" for score in scores), int(cell.labels[factor]))
            yield (cell.entry, cell.mix, cell.seed, member, factors[factor], *numbers)


def read_cells(path: Path) -> list[Scored]:
    """The scores in a ``results.csv``, which may come from anyone; a damaged one is a ``UserError``."""
    lines = csv.DictReader(io.StringIO(read_text(path, "the results are", AGAIN), newline=""))
    cells = []
    try:
        for (entry, mix, seed), rows in grouped(lines, itemgetter("entry", "mix", "seed")).items():
            shape = (-1, len({row["factor"] for row in rows}))
            ranked, at_half, at_best = (np.array([float(row[name]) for row in rows]).reshape(shape) for name in SCORES)
            labels = np.array([int(row["labels"]) for row in rows[: shape[1]]], dtype=np.int64)
            cells.append(Scored(entry, float(mix), int(seed), ranked, at_half, at_best, labels))
        for cell in cells:
            if not all(((table >= 0) & (table <= 1)).all() for table in (getattr(cell, name) for name in SCORES)):
                raise ValueError("a score out of range")
    except (TypeError, ValueError, KeyError, OverflowError, csv.Error):
        raise UserError("the results are damaged", path, AGAIN) from None
    return cells


def _begin(out: Path, config: WhichFeatureConfig) -> None:
    """Make the folder and write its settings, those that all of its results share."""
    varied = ("diversity", "mix", "seeds", "high", "low")
    shared = {name: value for name, value in as_dict(config).items() if name not in varied}
    path = out / "settings.json"
    if not path.exists():
        if out.exists() and (not out.is_dir() or any(out.iterdir())):
            raise UserError("this is not a folder of the benchmark", out, "Choose another --out.")
        out.mkdir(parents=True, exist_ok=True)
        replace_text(path, json.dumps(shared, indent=1) + "\n")
    elif read_json(path, "the benchmark's settings are", "Choose another --out.") != shared:
        raise UserError("this benchmark was begun with other settings", out, "Give those, or choose another --out.")
    sweep_up(out)
