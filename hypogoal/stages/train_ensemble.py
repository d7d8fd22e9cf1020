"""Spec A2: train one ensemble of hypotheses per sub-goal; the sub-goals are independent and share the cores."""

import contextlib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hypogoal.core.artefacts import LOG, Draft, open_artefact
from hypogoal.core.config import as_dict
from hypogoal.core.errors import UserError
from hypogoal.core.files import json_lines, read_end
from hypogoal.core.processes import allowed, in_processes, prepare
from hypogoal.core.progress import MetricsLog
from hypogoal.core.seeding import seed_for
from hypogoal.core.training import training
from hypogoal.data import Dataset, open_dataset
from hypogoal.diversity import load_objective
from hypogoal.hypotheses.config import FULL, TrainEnsembleConfig
from hypogoal.hypotheses.ensemble import Ensemble, write_ensemble
from hypogoal.hypotheses.networks import load_network, names_in, network_for
from hypogoal.hypotheses.scores import best_mean_worst, member_scores
from hypogoal.hypotheses.teacher import load_teacher
from hypogoal.hypotheses.thresholds import threshold_rule
from hypogoal.hypotheses.training import Watcher, fit
from hypogoal.hypotheses.views import StateOrigins, own_view
from hypogoal.observations import Observations, type_text
from hypogoal.options.visited import VISITED

HELDOUT, LOOKED_AT = "heldout", 100  # in what the stage returns; states of each class, cheap beside training


def train_ensemble(
    data: Path,
    config: TrainEnsembleConfig,
    out: Path,
    *,
    unlabelled: Sequence[Path] = (),
    seed: int = 0,
    force: bool = False,
    resume: bool = False,
    quiet: bool = False,
    device: str = "auto",
    tensorboard: Path | None = None,
) -> list[dict[str, Any]]:
    """Train the ensembles of every sub-goal of a data file and write the artefact ``out``.

    Spec B7: ``unlabelled`` are data files, or artefacts with visited states, whose unlabelled states are taken instead
    of those of ``data``. ``tensorboard``, a folder, gets the losses, each sub-goal's in a folder of its own. Returns
    per sub-goal the last losses and :func:`heldout_accuracy`. An unknown sub-goal, unusable data, or an ``out`` that
    exists is a ``UserError``, a loss that became NaN or Inf a ``NumericalError``.
    """
    device = prepare(device)
    load_objective(config.diversity)
    threshold_rule(config.threshold)
    if config.teacher:
        load_teacher(config.teacher)
    dataset = open_dataset(data)
    if config.view != FULL:
        own_view(config.view, config.view_settings, dataset.observation_shape)
    config = replace(config, network=network_for(config.network, dataset.observation_dtype))
    for name in names_in(config.network):
        load_network(name)
    sub_goals = config.sub_goals or dataset.sub_goals
    if len({*sub_goals}) < len(sub_goals):
        raise UserError("a sub-goal is named twice", ", ".join(sub_goals), "Name each once.")
    for sub_goal in sub_goals:
        if sub_goal not in dataset.sub_goals:
            raise UserError("unknown sub-goal", sub_goal, f"{data} has {', '.join(dataset.sub_goals)}.")
    others = tuple(unlabelled_file(path, dataset) for path in unlabelled)
    inputs = [data, *others]
    settings = as_dict(config) | {"sub_goals": list(sub_goals), "observation_shape": list(dataset.observation_shape)}
    settings |= {"observation_dtype": type_text(dataset.observation_dtype)}
    settings |= {"domain": dataset.domain, "domain_config": dataset.config}
    workers = min(allowed(config.workers), len(sub_goals))
    steps = len(sub_goals) * steps_of(config)
    artefact: dict[str, Any] = {"kind": "ensemble", "config": settings, "seed": seed, "inputs": inputs, "force": force}
    with training("train-ensemble", out, steps=steps, quiet=quiet, resume=resume, **artefact) as work:
        parts = work.draft.checkpoint
        jobs = []
        for sub_goal in sub_goals:
            board = Path(tensorboard, sub_goal) if tensorboard else None
            jobs.append(partial(_train_one, data, others, sub_goal, config, seed, work.draft, device, board))
        summaries: list[dict[str, Any]] = [{} for _ in jobs]
        parts.mkdir(exist_ok=True)
        logs = [log_of(parts, sub_goal) for sub_goal in sub_goals]
        work.progress.resume(steps_in(logs))
        with work.progress.following(partial(steps_in, logs)):
            in_processes(jobs, workers, summaries.__setitem__)
        texts = [log.read_text(encoding="utf-8") for log in logs]
        (work.folder / LOG).write_text("".join(texts), encoding="utf-8")
    return summaries


def log_of(parts: Path, sub_goal: str) -> Path:
    """The log of one sub-goal's training, beside its checkpoint."""
    return parts / f"{sub_goal}.jsonl"


def steps_of(config: TrainEnsembleConfig) -> int:
    """Training steps of a sub-goal's ensemble: of all members, where they are trained one after another."""
    return config.steps * (config.members if config.schedule == "sequential" else 1)


def steps_in(logs: Sequence[Path]) -> int:
    """How many steps of all sub-goals are in the logs that their processes are writing."""
    return sum(next((line.get("step", 0) for line in json_lines(reversed(read_end(log)))), 0) for log in logs)


def unlabelled_file(path: Path, dataset: Dataset) -> Path:
    """Spec B7: the file of unlabelled states: ``path``, or the file of an artefact with visited states.

    No such file, or one of another domain or shape than ``dataset``, is a ``UserError``.
    """
    file = path / VISITED if path.is_dir() else path
    if path.is_dir() and VISITED not in open_artefact(path, "options", "meta").manifest.files:
        raise UserError("no visited states", path, "Make it with --set save_visited=N.")
    source = open_dataset(file)
    for name, value, expected in (
        ("the domain", source.domain, dataset.domain),
        ("observations of shape", source.observation_shape, dataset.observation_shape),
        ("observations of type", source.observation_dtype, dataset.observation_dtype),
    ):
        if value != expected:
            do = "Give unlabelled states that fit the data."
            raise UserError(f"{name} {value}, the data have {expected}", file, do)
    return file


def joined_unlabelled(files: Sequence[Path]) -> tuple[Observations, dict[str, NDArray[np.int64]]]:
    """The unlabelled states (M, *obs) of some files one after another, and the origins that all files have."""
    sources = [(dataset.unlabelled(), dataset.unlabelled_origins()) for dataset in map(open_dataset, files)]
    names = set.intersection(*(set(origins) for _, origins in sources))
    joined = {name: np.concatenate([origins[name] for _, origins in sources]) for name in sorted(names)}
    states = [states for states, _ in sources]
    return states[0] if len(states) == 1 else np.concatenate(states), joined


class _Report(Watcher):
    """Logs the losses of a sub-goal's ensemble, and remembers the last ones."""

    def __init__(self, sub_goal: str, log: MetricsLog):
        super().__init__()
        self.sub_goal, self.log = sub_goal, log
        self.numbers: dict[str, float] = {}

    def report(self, step: int, losses: dict[str, float]) -> None:
        self.numbers.update(losses)
        self.log.write(sub_goal=self.sub_goal, step=step, **losses)

    def snapshot(self) -> dict[str, Any]:
        return {"log": self.log.snapshot(), "numbers": self.numbers}

    def restore(self, snapshot: Mapping[str, Any]) -> None:
        self.log.restore(snapshot["log"])
        self.numbers = snapshot["numbers"]


def _train_one(
    data: Path,
    others: Sequence[Path],
    sub_goal: str,
    config: TrainEnsembleConfig,
    seed: int,
    draft: Draft,
    device: str,
    tensorboard: Path | None,
) -> dict[str, Any]:
    """Train one sub-goal's ensemble; runs in its own process."""
    prepare()
    checkpoints = draft.checkpoints(sub_goal)
    dataset = open_dataset(data)
    split = dataset.labelled(sub_goal)
    unlabelled, origins = joined_unlabelled(others or (data,))
    log = MetricsLog(log_of(draft.checkpoint, sub_goal), tensorboard)
    if not checkpoints.saved:
        log.restore(0)
    report = _Report(sub_goal, log)
    with contextlib.closing(log):
        ensemble = fit(
            split.observations,
            split.labels,
            unlabelled,
            config,
            seed_for(seed, "ensemble", sub_goal),
            report,
            origins=StateOrigins(split.origins, origins),
            device=device,
            checkpoints=checkpoints,
        )
    write_ensemble(draft.files, sub_goal, ensemble)
    return {"sub_goal": sub_goal, **report.numbers, HELDOUT: heldout_accuracy(ensemble, dataset, sub_goal)}


def heldout_accuracy(ensemble: Ensemble, dataset: Dataset, sub_goal: str) -> dict[str, float]:
    """Best, mean and worst member's balanced accuracy on some held-out states; NaN without states of both classes."""
    try:
        states = dataset.some_heldout(sub_goal, LOOKED_AT)
        predictions = ensemble.predictions(states.observations)
    except UserError:  # training needs none of them: what is wrong is said by ``evaluate``
        return best_mean_worst(np.full(len(ensemble), np.nan))
    return best_mean_worst(member_scores(predictions, states.labels)["balanced_accuracy"])
