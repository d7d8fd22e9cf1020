"""A small data file in the real format, and manifests that somebody edited."""

import csv
import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from hypogoal.core.artefacts import LOG, MANIFEST
from hypogoal.core.drafts import create
from hypogoal.core.hdf5 import create_hdf5
from hypogoal.core.tensors import save_tensors
from hypogoal.data import Collected, States, write_dataset
from hypogoal.hypotheses.ensemble import Ensemble, write_ensemble

SHAPE = (4, 5, 3)


def write(path: Path, states: int = 7, domain: str = "toy", goals: tuple[str, ...] = ("one", "two")) -> Path:
    """Three sets of random states; ``path``."""
    rng = np.random.default_rng(0)

    def some(count: int) -> States:
        images = rng.integers(0, 256, size=(count, *SHAPE), dtype=np.uint8)
        return States(images, rng.random((count, len(goals))) < 0.5, {"layout_seed": np.arange(count)})

    collected = Collected(SHAPE, goals, some(states), some(states), some(states))
    write_dataset(path, collected, domain=domain, config={"a": 1}, seed=3)
    return path


def write_table(path: Path, columns: Sequence[str], rows: Iterable[Sequence[Any]]) -> None:
    """Write a CSV file with a header."""
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(columns)
        writer.writerows(rows)


def files_of(kind: str, config: Mapping[str, Any]) -> set[str]:
    """The files that a stage always writes, by its artefact's kind and settings, besides the manifest.

    Others (figures, films, ``executions.csv``, ``exploits.csv``) depend on what happened.
    """
    if kind in ("options", "meta", "audit"):
        played = {LOG, "episodes.csv", "layout.json", "options.safetensors", "choices.csv", "terminations.h5"}
        played |= {"visited.h5"} if config.get("save_visited") else set()
        played |= {"audit.json", "exploits.csv"} if kind == "audit" else set()
        chooses = kind == "meta" and config.get("chooser") in ("ppo", "symbols")
        return played | ({"meta.safetensors"} if chooses else set())
    return {
        "ensemble": {LOG, *(f"{sub_goal}.safetensors" for sub_goal in config.get("sub_goals", ()))},
        "baseline": {LOG, "episodes.csv", "layout.json", "policy.safetensors"},
        "evaluation": {"run.json", "numbers.csv", "arrays.h5", "summary.txt"},
        "report": {"index.html"},
        "comparison": {"index.html", "pairs.csv", "summary.txt"},
    }[kind]


def untrained(folder: Path, domain: Any, members: int = 2, network: str = "montezuma", seed: int = 0) -> Path:
    """An ensemble artefact of random weights for a domain's sub-goals, of Montezuma's for the paper's."""
    shape, sub_goals = domain.observation_shape, list(domain.sub_goals)
    if domain.name == "montezuma":
        sub_goals = sub_goals[:1]
    config = {
        "domain": domain.name, "domain_config": {}, "sub_goals": sub_goals, "members": members,
        "network": network, "observation_shape": list(shape), "observation_dtype": "uint8", "view": "full",
    }  # fmt: skip
    with create(folder, kind="ensemble", config=config, seed=seed, inputs=[]) as draft:
        for number, sub_goal in enumerate(sub_goals):
            ensemble = Ensemble(network, shape, members, torch.Generator().manual_seed(number))
            write_ensemble(draft.files, sub_goal, ensemble)
        fill(draft.files, "ensemble", config)
    return folder


def fill(artefact: Path, kind: str, config: Mapping[str, Any]) -> None:
    """Empty files in place of those that an artefact of a kind must have and a test does not read.

    Of options there are thresholds, which every evaluation reads: log-odds of 0, 1, and so on.
    """
    if kind in ("options", "meta"):
        thresholds = torch.arange(len(config["sub_goals"]) * config["members"], dtype=torch.float32)
        save_tensors(artefact / "options.safetensors", {"thresholds": thresholds})
    for name in files_of(kind, config):
        if name.endswith(".h5") and not (artefact / name).exists():
            with create_hdf5(artefact / name):
                continue
        (artefact / name).touch()


def reseal(artefact: Path, **changes: Any) -> dict[str, Any]:
    """Change keys of an artefact's manifest; returns the manifest."""
    manifest = json.loads((artefact / MANIFEST).read_bytes()) | changes
    (artefact / MANIFEST).write_text(json.dumps(manifest, indent=1) + "\n", encoding="utf-8")
    return manifest
