"""Spec A2: train one ensemble of hypotheses per sub-goal; the sub-goals are independent and share the cores."""

from __future__ import annotations

import os
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from hypogoal.core.artefacts import claim, create_artefact
from hypogoal.core.checkpoints import FOLDER, checkpoints_of
from hypogoal.core.compute import prepare
from hypogoal.core.config import as_dict, setting
from hypogoal.core.errors import UserError
from hypogoal.core.own_code import given
from hypogoal.core.preflight import preflight
from hypogoal.core.progress import MetricsLog, Progress
from hypogoal.core.seeding import seed_for
from hypogoal.core.workers import in_processes
from hypogoal.dataset import open_dataset
from hypogoal.diversity import load_objective
from hypogoal.hypotheses.networks import load_network
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
    resume: bool = False,
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
    with given(config.diversity, config.network):
        load_objective(config.diversity)
        load_network(config.network)
    dataset = open_dataset(data)
    sub_goals = config.sub_goals or dataset.sub_goals
    for sub_goal in sub_goals:
        if sub_goal not in dataset.sub_goals:
            raise UserError("unknown sub-goal", sub_goal, f"{data} has {', '.join(dataset.sub_goals)}.")
    claim(out, force=force, resume=resume)
    about = as_dict(config) | {
        "sub_goals": list(sub_goals),
        "observation_shape": list(dataset.observation_shape),
        "domain": dataset.domain,
        "domain_config": dataset.config,
    }
    workers = min(config.workers or os.cpu_count() or 1, len(sub_goals))
    preflight("train-ensemble", out, ensemble_needs(data, config, len(sub_goals), workers), quiet=quiet)
    with create_artefact(
        out, kind="ensemble", config=about, seed=seed, inputs=[data], force=force, resume=resume
    ) as folder:
        jobs = [partial(_train_one, data, sub_goal, config, seed, folder) for sub_goal in sub_goals]
        summaries: list[dict[str, Any]] = [{} for _ in jobs]
        (folder.parent / FOLDER).mkdir(exist_ok=True)
        with Progress("train-ensemble", total=len(jobs), quiet=quiet) as progress:

            def done(number: int, summary: dict[str, Any]) -> None:
                summaries[number] = summary
                progress.advance(1)

            in_processes(jobs, workers, done)
        with (folder / "metrics.jsonl").open("w", encoding="utf-8") as joined:
            for sub_goal in sub_goals:
                joined.write(_metrics(folder, sub_goal).read_text(encoding="utf-8"))
    return summaries


def _metrics(folder: Path, sub_goal: str) -> Path:
    """Where a sub-goal's part of ``metrics.jsonl`` is while others are trained: beside its checkpoint."""
    return folder.parent / FOLDER / f"{sub_goal}.jsonl"


class _Report:
    """Writes the losses of a sub-goal's ensemble down as they come, and remembers the last ones."""

    def __init__(self, sub_goal: str, log: MetricsLog):
        self.sub_goal, self.log = sub_goal, log
        self.numbers: dict[str, float] = {}

    def __call__(self, step: int, losses: dict[str, float]) -> None:
        self.numbers.update(losses)
        self.log.write(sub_goal=self.sub_goal, step=step, **losses)

    def snapshot(self) -> dict[str, Any]:
        return {"log": self.log.snapshot(), "numbers": self.numbers}

    def restore(self, snapshot: dict[str, Any]) -> None:
        self.log.restore(snapshot["log"])
        self.numbers = snapshot["numbers"]


def _train_one(data: Path, sub_goal: str, config: TrainEnsembleConfig, seed: int, folder: Path) -> dict[str, Any]:
    """Train one sub-goal's ensemble; runs in its own process."""
    prepare()
    checkpoints = checkpoints_of(folder, sub_goal)
    dataset = open_dataset(data)
    split = dataset.labelled(sub_goal)
    report = _Report(sub_goal, MetricsLog(_metrics(folder, sub_goal)))
    if not checkpoints.saved:
        report.log.restore(0)
    with given(config.diversity, config.network):
        ensemble = fit(
            split.observations,
            split.labels,
            dataset.unlabelled(),
            config,
            seed_for(seed, "ensemble", sub_goal),
            report,
            origins=split.origins,
            unlabelled_origins=dataset.unlabelled_origins(),
            checkpoints=checkpoints,
        )
    write_ensemble(folder, sub_goal, ensemble)
    report.log.close()
    return {"sub_goal": sub_goal, **report.numbers}
