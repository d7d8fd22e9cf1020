"""Spec A2: train one ensemble of hypotheses per sub-goal; the sub-goals are independent and share the cores."""

from __future__ import annotations

import json
import multiprocessing
import os
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hypogoal.core.artefacts import claim, create_artefact
from hypogoal.core.compute import prepare
from hypogoal.core.config import as_dict, setting
from hypogoal.core.errors import UserError
from hypogoal.core.preflight import preflight
from hypogoal.core.progress import Progress
from hypogoal.core.seeding import seed_for
from hypogoal.dataset import open_dataset
from hypogoal.diversity import load_objective
from hypogoal.hypotheses.storage import write_ensemble
from hypogoal.hypotheses.training import EnsembleConfig, fit
from hypogoal.needs import ensemble_needs


@dataclass(frozen=True)
class TrainEnsembleConfig(EnsembleConfig):
    """An ensemble's settings, and which sub-goals to train it for."""

    sub_goals: tuple[str, ...] = setting((), "sub-goals to train, comma-separated; empty for all")
    workers: int = setting(0, "processes; 0 for one per core", low=0, high=1024)


def train_ensemble(
    data: Path,
    config: TrainEnsembleConfig,
    out: Path,
    *,
    seed: int = 0,
    force: bool = False,
    quiet: bool = False,
    device: str = "auto",
) -> list[dict[str, Any]]:
    """Train the ensembles of every sub-goal of a data file and write the artefact ``out``.

    Returns:
        Per sub-goal, the last losses.

    Raises:
        UserError: unknown sub-goal, unusable data, or ``out`` exists.
        NumericalError: a loss became NaN or Inf.
    """
    prepare(device)
    load_objective(config.diversity)
    dataset = open_dataset(data)
    sub_goals = config.sub_goals or dataset.sub_goals
    for sub_goal in sub_goals:
        if sub_goal not in dataset.sub_goals:
            raise UserError("unknown sub-goal", sub_goal, f"{data} has {', '.join(dataset.sub_goals)}.")
    claim(out, force=force)
    about = as_dict(config) | {
        "sub_goals": list(sub_goals),
        "observation_shape": list(dataset.observation_shape),
        "domain": dataset.domain,
        "domain_config": dataset.config,
    }
    workers = min(config.workers or os.cpu_count() or 1, len(sub_goals))
    preflight("train-ensemble", out, ensemble_needs(data, config, len(sub_goals), workers), quiet=quiet)
    with create_artefact(out, kind="ensemble", config=about, seed=seed, inputs=[data], force=force) as folder:
        jobs = [(data, sub_goal, config, seed, folder) for sub_goal in sub_goals]
        with Progress("train-ensemble", total=len(jobs), quiet=quiet) as progress:
            if workers == 1:
                summaries = []
                for job in jobs:
                    summaries.append(_train_one(*job))
                    progress.advance(1)
            else:
                spawn = multiprocessing.get_context("spawn")
                with ProcessPoolExecutor(workers, mp_context=spawn) as pool:
                    futures = [pool.submit(_train_one, *job) for job in jobs]
                    for future in as_completed(futures):
                        future.result()  # a failure is told at once
                        progress.advance(1)
                    summaries = [future.result() for future in futures]
        _join_metrics(folder, sub_goals)
    return summaries


def _train_one(data: Path, sub_goal: str, config: TrainEnsembleConfig, seed: int, folder: Path) -> dict[str, Any]:
    """Train one sub-goal's ensemble; runs in its own process."""
    prepare()
    dataset = open_dataset(data)
    split = dataset.labelled(sub_goal)
    numbers: dict[str, float] = {}
    with (folder / f"{sub_goal}.jsonl").open("w", encoding="utf-8") as log:

        def on_step(step: int, losses: dict[str, float]) -> None:
            numbers.update(losses)
            log.write(json.dumps({"sub_goal": sub_goal, "step": step, **losses}) + "\n")

        ensemble = fit(
            split.observations,
            split.labels,
            dataset.unlabelled(),
            config,
            seed_for(seed, "ensemble", sub_goal),
            on_step,
            origins=split.origins,
            unlabelled_origins=dataset.unlabelled_origins(),
        )
    write_ensemble(folder, sub_goal, ensemble)
    return {"sub_goal": sub_goal, **numbers}


def _join_metrics(folder: Path, sub_goals: tuple[str, ...]) -> None:
    with (folder / "metrics.jsonl").open("w", encoding="utf-8") as joined:
        for sub_goal in sub_goals:
            part = folder / f"{sub_goal}.jsonl"
            joined.write(part.read_text(encoding="utf-8"))
            part.unlink()
