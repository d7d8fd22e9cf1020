"""The ensemble of one sub-goal: its settings are checked, and it is trained with a log, written and first judged."""

import contextlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hypogoal.core.drafts import Draft
from hypogoal.core.errors import UserError
from hypogoal.core.processes import prepare
from hypogoal.core.progress import MetricsLog, Progress, say
from hypogoal.data import Dataset, joined, open_dataset
from hypogoal.diversity import load_objective
from hypogoal.hypotheses import networks, scores, teacher, thresholds, views
from hypogoal.hypotheses.auto import training_of
from hypogoal.hypotheses.config import TrainEnsembleConfig
from hypogoal.hypotheses.ensemble import Ensemble, write_ensemble
from hypogoal.observations import spread_rows

LOOKED_AT = 1_000  # the number of held-out or unlabelled states that are judged, which is cheap beside training


@dataclass(frozen=True)
class Trained:
    """The result of one sub-goal's training.

    Attributes:
        accuracies: balanced accuracies by name, see :func:`heldout_accuracy`.
        chosen: what was chosen where settings are ``auto``, and the members that are ``idle``
            (:func:`scores.idle_members`).
    """

    accuracies: dict[str, float]
    chosen: dict[str, Any]


def check_names(config: TrainEnsembleConfig) -> None:
    """Load everything that settings name, before there is any data. Raises ``UserError`` if a name is unknown."""
    load_objective(config.diversity)
    thresholds.threshold_rule(config.threshold)
    if config.teacher:
        teacher.load_teacher(config.teacher)
    if config.view != views.FULL:
        views.load_view(config.view)
    for name in networks.names_in(config.network):
        if name != networks.AUTO:
            networks.load_network(name)


def checked(config: TrainEnsembleConfig, dataset: Dataset) -> tuple[TrainEnsembleConfig, Sequence[str]]:
    """Return the settings with the network that fits the data, and the sub-goals to train.

    Raises ``UserError`` if something cannot be trained.
    """
    check_names(config)
    dtype = dataset.observation_dtype
    view = views.view_of(config.view, config.view_settings, dataset.observation_shape, dtype)
    network = networks.network_for(config.network, view.shape, dtype)
    config = config.model_copy(update={"network": network})
    sub_goals = config.sub_goals or dataset.sub_goals
    if len({*sub_goals}) < len(sub_goals):
        raise UserError("a sub-goal is named twice", ", ".join(sub_goals), "Name each once.")
    for sub_goal in sub_goals:
        if sub_goal not in dataset.sub_goals:
            raise UserError("unknown sub-goal", sub_goal, f"{dataset.path} has {', '.join(dataset.sub_goals)}.")
    labelled = dataset.counts()["labelled"]
    for sub_goal in sub_goals:
        states, positives = labelled[sub_goal]["states"], labelled[sub_goal]["positives"]
        if positives in (0, states):
            fault = f"{sub_goal} has no {'negatives' if positives else 'positives'} among {states} labelled states"
            raise UserError(fault, dataset.path, "Collect others, or leave it out: --set sub_goals=...")
    return config, sub_goals


def train_sub_goal(
    draft: Draft,
    data: Path,
    others: Sequence[Path],
    sub_goal: str,
    config: TrainEnsembleConfig,
    seed: int,
    device: str,
    tensorboard: Path | None,
    quiet: bool,
) -> Trained:
    """Train the ensemble of one sub-goal, write it, and return what came of it.

    This function runs in a process of its own. ``others`` are the files of unlabelled states. If ``others`` is empty,
    the unlabelled states of ``data`` are used. The log has the steps of the last training only.
    """
    prepare()
    dataset = open_dataset(data)
    labelled = dataset.labelled(sub_goal)
    unlabelled = joined([open_dataset(file).unlabelled_states() for file in others or [data]])
    checkpoints = draft.checkpoints(sub_goal)
    saved = checkpoints.load()
    begun = saved["training"] if saved else None
    training = training_of(labelled, unlabelled, sub_goal, config, seed, device=device, saved=begun)
    if training.folds and not quiet:
        once = training.cost(folds=0, weights=0)
        steps = f"at most {training.most} steps, {once} of them when the weight is chosen"
        say(f"train-ensemble {sub_goal}: {steps}", err=True)
    log = MetricsLog(log_of(draft, sub_goal), tensorboard)
    log.restore(saved["log"] if saved else 0)

    def state() -> dict[str, Any]:
        return {"training": training.snapshot(), "log": log.snapshot()}

    with contextlib.closing(log), Progress(f"train-ensemble {sub_goal}", training.most, quiet) as progress:
        progress.resume(training.step)
        for losses in training.steps():
            now = training.now
            if now and now.due:
                progress.total = training.most
                progress.update(training.step)
                if training.is_last:
                    log.write(sub_goal=sub_goal, step=now.step, **losses.numbers())
            checkpoints.offer(state)
    checkpoints.save(state())
    write_ensemble(draft.files, sub_goal, training.ensemble)
    some = unlabelled.where(spread_rows(len(unlabelled.observations), LOOKED_AT))
    predictions = training.ensemble.predictions(some.observations)
    idle = scores.idle_members(predictions, some.origins.get("layout_seed")) if len(predictions) else []
    return Trained(heldout_accuracy(training.ensemble, dataset, sub_goal), training.summary() | {"idle": idle})


def log_of(draft: Draft, sub_goal: str) -> Path:
    """Return the path of the log of one sub-goal's training, which lies beside its checkpoint."""
    return draft.checkpoint / f"{sub_goal}.jsonl"


def heldout_accuracy(ensemble: Ensemble, dataset: Dataset, sub_goal: str) -> dict[str, float]:
    """Return the best, mean and worst member's balanced accuracy on some held-out states.

    All three are NaN if there are no held-out states of both classes.
    """
    try:
        states = dataset.heldout(sub_goal)
        states = states.where(spread_rows(len(states.labels), LOOKED_AT))
        predictions = ensemble.predictions(states.observations)
    except UserError:  # training needs no held-out states, and ``evaluate`` says what is wrong with them
        return scores.best_mean_worst(np.full(len(ensemble), np.nan))
    return scores.best_mean_worst(scores.member_scores(predictions, states.labels)["balanced_accuracy"])
