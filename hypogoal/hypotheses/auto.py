"""Choice of the diversity weight from the user's own labels: ``diversity_weight=auto`` (beyond the paper).

A weight that is too small leaves the members alike, and a weight that is too large makes the members forget the labels.
Both faults show without any labels from other places. So a quarter of the labels is held out. Members are first trained
without diversity, then with each of ``WEIGHTS`` from the largest down. The search ends at the first weight at which
every member is as right about the held-out labels as members without diversity, within a standard error, see
:mod:`hypogoal.hypotheses.weighing`. A member that predicts one class for all unlabelled states is no hypothesis. So a
weight that makes a member constant is passed over, unless members without diversity are constant, too.

If the labelled place can be told from other places, members can keep all labels at any weight: the members then agree
in the labelled place and contradict each other elsewhere. So a weight is also passed over if two members differ, in
the mean over pairs, on more than ``1/2 + sqrt(1/4 / M)`` of the M unlabelled states. Half is the bound because two
rules that know nothing of each other, and say yes to shares a and b of the states, differ on ``a (1 - b) + b (1 - a)``.
That is at most 1/2 if neither rule says yes to more than half of the states.

The first member of a sequential ensemble is trained on the labels alone, once for all weights. If the first member
mixes features, later members can only mix what is left. So ``restarts`` first members begin training. After the share
``EARLY`` of the steps, only the member whose predictions tell most about unlabelled states goes on, see
:func:`hypogoal.hypotheses.weighing.information_of`. Members that are trained at once end in different mixtures. So
``restarts`` whole ensembles are trained, and the ensemble that tells most is kept.
"""

from collections.abc import Generator, Iterator
from dataclasses import asdict
from math import inf, isnan, sqrt
from operator import itemgetter
from typing import Any

import numpy as np
import torch

from hypogoal.core import seeding
from hypogoal.core.arrays import Bools
from hypogoal.core.checkpoints import State
from hypogoal.data import GROUP, States
from hypogoal.diversity import load_objective
from hypogoal.hypotheses import scores, weighing
from hypogoal.hypotheses.config import AUTO, LABELS, TrainEnsembleConfig
from hypogoal.hypotheses.ensemble import THRESHOLD, Ensemble
from hypogoal.hypotheses.fit import Losses
from hypogoal.hypotheses.training import EnsembleTraining, require_unlabelled
from hypogoal.hypotheses.views import StateOrigins
from hypogoal.observations import Observations

HALF = 0.5
EARLY = 1 / 3  # the share of its steps after which a first member is compared with the other restarts

Outcome = Generator[Losses, None, State]  # one training: it yields the losses of each step and returns its outcome


class AutoTraining:
    """The training of one sub-goal's ensemble, which first chooses the settings that are ``auto``.

    With no setting to choose, the training is the one of :class:`EnsembleTraining`.

    Args:
        observations, labels, unlabelled, seed, device: as for :class:`EnsembleTraining`.
        config: the settings.
        origins: as for :class:`EnsembleTraining`. Labelled states with the same origin ``group`` are held out together.
        saved: a ``snapshot`` from which to go on. The snapshot has the outcomes of the trainings that were finished, so
            they are not repeated.

    Attributes:
        now: the training at work. At the end, ``now`` is the training of the final ensemble.
        is_last: whether ``now`` is the training of the final ensemble.
        step: the number of steps done, over all trainings.
        most: the largest number of steps that there can be, over all trainings.
        weight: the weight of diversity, once chosen.
        share: the share of positives, once chosen.
        tried: the results of the weights that were tried.
        lowest: the balanced accuracy that members had to keep.
        remark: what a user should know of how labels were held out. The remark is empty if there is nothing to know.
    """

    def __init__(
        self,
        observations: Observations,
        labels: Bools,
        unlabelled: Observations,
        config: TrainEnsembleConfig,
        seed: int,
        *,
        origins: StateOrigins | None = None,
        device: torch.device | str = "cpu",
        saved: State | None = None,
    ):
        self.observations, self.labels, self.unlabelled = observations, labels, unlabelled
        self.config, self.seed, self.device = config, seed, device
        self.origins = origins or StateOrigins()
        saved = saved or {"outcomes": [], "now": None, "step": 0}
        self._outcomes = [*saved["outcomes"]]
        self._saved = saved["now"]
        self._turn = 0
        self._fresh = {"seed": seed, "first": None, "training": None, "information": -inf}
        self.step: int = saved["step"]
        self.now: EnsembleTraining | None = None
        self.is_last = False
        acts = load_objective(config.diversity).acts(config.members) and config.diversity_weight != 0
        if acts:
            require_unlabelled(unlabelled)
        self.searches = acts and config.diversity_weight == AUTO
        self.weight = config.diversity_weight if config.diversity_weight != AUTO else 0.0
        self.share = config.share if config.share != AUTO else LABELS
        self.tried: list[weighing.Tried] = []
        self.lowest = 0.0
        self.folds: list[Bools] = []
        self.remark = ""
        if self.searches:
            self.folds, self.remark = weighing.held_out(labels, self.origins.labelled.get(GROUP), seed)
        one_by_one = config.schedule == "sequential" and config.members > 1 and not config.teacher
        self.begins_alone = acts and one_by_one and (self.searches or config.restarts > 1)
        self.begins_together = acts and config.schedule == "simultaneous" and config.restarts > 1
        self.early = max(1, round(config.steps * EARLY))
        self.most = self.cost(len(self.folds), len(weighing.WEIGHTS))

    @property
    def ensemble(self) -> Ensemble:
        """The ensemble whose members are being trained now."""
        assert self.now is not None
        return self.now.ensemble

    def cost(self, folds: int, weights: int) -> int:
        """Return the number of steps of all trainings.

        ``weights`` weights are tried in each of ``folds`` folds, each to the end of its training.
        """
        config = self.config
        first = config.steps + (config.restarts - 1) * self.early if self.begins_alone else 0
        rounds = config.members if config.schedule == "sequential" else 1
        others = config.steps * (rounds - self.begins_alone)
        last = others * (config.restarts if self.begins_together else 1)
        return folds * ((first or others) + weights * others) + first + last

    def snapshot(self) -> State:
        """Return all that the next steps depend on."""
        now = self.now.snapshot() if self.now else self._saved
        return {"outcomes": self._outcomes, "now": now, "step": self.step}

    def summary(self) -> dict[str, Any]:
        """Return what was chosen and why, for a manifest, once all steps are done."""
        held = [self.labels[fold] for fold in self.folds]
        return {
            "diversity_weight": self.weight,
            "share": self.share,
            "positives": sum(int(labels.sum()) for labels in held),
            "negatives": sum(int((~labels).sum()) for labels in held),
            "lowest": self.lowest,
            "tried": [asdict(tried) for tried in self.tried],
            "remark": self.remark,
        }

    def steps(self) -> Iterator[Losses]:
        """Take the steps that are left, and yield the losses of each step.

        Raises ``NumericalError`` if a loss is NaN or Inf.
        """
        if self.searches:
            self.weight = yield from self._search()
            self.most = self.step + self.cost(folds=0, weights=0)
        everything = np.ones(len(self.labels), bool)
        begun = self._fresh
        if self.begins_alone:
            begun = yield from self._begin(everything)
        if self.begins_together:
            begun = yield from self._best_start(everything, self.config.members, self.config.steps, self.weight)
        self.is_last = True
        yield from self._train(everything, begun, self.weight)

    def _search(self) -> Generator[Losses, None, float]:
        """Try weights from the largest down until the members bear one, and return that weight."""
        without: list[State] = []
        for fold in self.folds:
            without.append((yield from self._begin(~fold, fold)))
        if not without:
            return weighing.WEIGHTS[-1]
        labels = np.concatenate([self.labels[fold] for fold in self.folds])
        self.lowest = weighing.lowest_kept(np.concatenate([begun["right"] for begun in without]), labels)
        was_constant = any(begun["constant"] for begun in without)
        half = HALF + sqrt(HALF**2 / len(self.unlabelled))
        for weight in weighing.WEIGHTS:
            outcomes = []
            for fold, begun in zip(self.folds, without, strict=True):
                outcomes.append((yield from self._train(~fold, begun, weight, held=fold)))
            trained = min(outcome["right"].shape[1] for outcome in outcomes)
            right = np.concatenate([outcome["right"][:, :trained] for outcome in outcomes])
            accuracy = float(weighing.accuracies_of(right, labels).min())
            differs = float(np.mean([outcome["disagreement"] for outcome in outcomes]))
            constant = any(outcome["constant"] for outcome in outcomes) and not was_constant
            contrary = differs > half
            kept = accuracy >= self.lowest and not constant and not contrary
            self.tried.append(
                weighing.Tried(weight, accuracy, None if isnan(differs) else differs, constant, contrary, kept)
            )
            if kept:
                break
        return weight

    def _begin(self, rows: Bools, held: Bools | None = None) -> Outcome:
        """Train without diversity on the labels of ``rows``: all members at once, or a first member alone.

        If the setting ``share`` is ``auto``, this also sets the share of positives to expect among unlabelled states:
        the share that the first member predicts.
        """
        members = 1 if self.begins_alone else self.config.members
        begun = self._fresh
        if self.begins_alone and self.config.restarts > 1:
            begun = yield from self._best_start(rows, members, self.early)
        outcome = yield from self._train(rows, begun, members=members, held=held)
        if self.config.share == AUTO:
            self.share = outcome["positive"]
        return outcome

    def _best_start(self, rows: Bools, members: int, until: int, weight: float = 0.0) -> Outcome:
        """Train ``restarts`` times for ``until`` steps, and return the start that tells most.

        A start is a training to go on from. The start that tells most is the one whose predictions have the most mutual
        information with the unlabelled states.
        """
        best = self._fresh
        for restart in range(self.config.restarts):
            seed = seeding.seed_for(self.seed, "restart", restart) if restart else self.seed
            begun = self._fresh | {"seed": seed}
            start = yield from self._train(rows, begun, weight, members=members, until=until)
            worse, best = sorted([start, best], key=itemgetter("information"))
            worse["training"] = None  # the snapshot of a training that is not continued may be large
        return best

    def _train(
        self,
        rows: Bools,
        begun: State,
        weight: float = 0.0,
        *,
        members: int = 0,
        held: Bools | None = None,
        until: int = 0,
    ) -> Outcome:
        """Train once on the labels of ``rows``, from the seed, the first member and the snapshot in ``begun``.

        The training ends after ``until`` steps, or at the end of all steps if ``until`` is 0. If there is only one
        fold, a sequential training also ends as soon as a member is trained that has too few of the labels of ``held``
        right.
        """
        self._turn += 1
        if self._turn <= len(self._outcomes):
            return self._outcomes[self._turn - 1]
        origins = {name: values[rows] for name, values in self.origins.labelled.items()}
        now = EnsembleTraining(
            self.observations[rows],
            self.labels[rows],
            self.unlabelled,
            self.config.training(weight, self.share, members=members or self.config.members),
            begun["seed"],
            origins=StateOrigins(origins, self.origins.unlabelled),
            device=self.device,
            first=begun["first"],
            saved=self._saved or begun["training"],
        )
        self.now, self._saved = now, None
        for _, losses in now.steps():
            self.step += 1
            yield losses
            if now.done == until or self._has_lost(now, held):
                break
        if self.is_last:
            return {}
        self._outcomes.append({"seed": begun["seed"], **self._outcome(now, held, until > 0)})
        self.now = None
        return self._outcomes[-1]

    def _outcome(self, now: EnsembleTraining, held: Bools | None, is_candidate: bool) -> State:
        """Return what members predict for unlabelled and held-out states, and what a later training needs to go on."""
        probabilities = now.predict(self.unlabelled)
        predictions = probabilities > THRESHOLD
        positive = predictions.mean(axis=0)
        is_first = self.begins_alone and len(now.ensemble) == 1
        return {
            "information": float(np.mean([weighing.information_of(member) for member in probabilities.T])),
            "training": now.snapshot() if is_candidate else None,
            "first": now.ensemble.networks[0].state_dict() if is_first and not is_candidate else None,
            "positive": float((predictions[:, 0].sum() + 1) / (len(predictions) + 2)),  # neither 0 nor 1
            "constant": bool(((positive == 0) | (positive == 1)).any()),
            "disagreement": scores.mean_disagreement(predictions),
            "right": None if held is None else self._right(now, held),
        }

    def _right(self, now: EnsembleTraining, held: Bools) -> Bools:
        """Return which held-out labels each member predicts right, bool (n, K)."""
        return (now.predict(self.observations[held]) > THRESHOLD) == self.labels[held][:, None]

    def _has_lost(self, now: EnsembleTraining, held: Bools | None) -> bool:
        """Say whether a member at the end of its training has a lower held-out accuracy than it must keep."""
        if held is None or now.done < self.config.steps or len(self.folds) > 1:
            return False
        accuracies = weighing.accuracies_of(self._right(now, held), self.labels[held])
        return bool(accuracies.min() < self.lowest)


def training_of(
    labelled: States, unlabelled: States, sub_goal: str, config: TrainEnsembleConfig, seed: int, **more: Any
) -> AutoTraining:
    """Return the training of a sub-goal's ensemble, before its first step.

    ``seed`` is the seed of the run. ``more`` are further arguments of :class:`AutoTraining`.
    """
    return AutoTraining(
        labelled.observations,
        labelled.labels,
        unlabelled.observations,
        config,
        seeding.seed_for(seed, "ensemble", sub_goal),
        origins=StateOrigins(labelled.origins, unlabelled.origins),
        **more,
    )
