"""Members whose diversity weight is chosen from the user's own labels: ``diversity_weight=auto`` (beyond the paper).

Too small a weight leaves members alike, too large a one makes them forget the labels. Both show without labels of
other places. So a quarter of the labels is held out; members are trained without diversity, then with each of
``WEIGHTS`` from the largest down, and the first is taken at which every member is as right about the held-out labels,
within a standard error (Breiman et al. 1984, section 3.4.3)::

    accuracy >= a - s
    a = (right_1 / n_1 + right_0 / n_0) / 2
    s = sqrt(q_1 (1 - q_1) / n_1 + q_0 (1 - q_0) / n_0) / 2,  q_c = (right_c + 1) / (n_c + 2)

Of the ``n_c`` held-out states of class c, ``right_c`` are predicted right without diversity. q_c is Laplace's rule of
succession: a member without a fault would have s = 0. A member that predicts one class for all unlabelled states is no
hypothesis, so its weight is passed over, unless members without diversity do so, too.

The first member of a sequential ensemble is trained on the labels alone, once for all weights. If it mixes features,
later members can only mix what is left. So ``restarts`` of them begin, and after ``EARLY`` of its steps the one stays
that is most certain of unlabelled states, by the mean of abs(2 p - 1): a mixture is in doubt where its features part.
"""

from collections.abc import Callable, Generator, Iterator
from dataclasses import dataclass
from math import isnan, nan, sqrt
from typing import Any, Literal, TypeAlias

import numpy as np
import torch

from hypogoal.core.arrays import Bools, Doubles, Ints
from hypogoal.core.checkpoints import State
from hypogoal.core.seeding import rng_for, seed_for
from hypogoal.diversity import load_objective
from hypogoal.hypotheses.config import AUTO, LABELS, TrainEnsembleConfig
from hypogoal.hypotheses.ensemble import THRESHOLD, Ensemble
from hypogoal.hypotheses.fit import Losses
from hypogoal.hypotheses.scores import mean_disagreement, member_scores
from hypogoal.hypotheses.training import EnsembleTraining
from hypogoal.hypotheses.views import StateOrigins
from hypogoal.observations import Observations

WEIGHTS = (1.0, 0.3, 0.1, 0.03, 0.01, 0.003, 0.001, 3e-4, 1e-4)
SMALLEST = WEIGHTS[-1]  # the paper's on DoorKey
FOLDS = 4  # one state in so many is held out
FEWEST = (
    8  # held-out states of a class, below which each fold is held out in turn; below which, in all, nothing is tried
)
EARLY = 1 / 3  # of a first member's steps
GROUP = "group"  # the origin of states that are held out together

Share: TypeAlias = float | Literal["labels"]
Outcome: TypeAlias = Generator[Losses, None, State]  # of a training: yields after each step, returns what came out


@dataclass(frozen=True)
class Tried:
    """What one weight did: the worst member on held-out labels, and how members differ on unlabelled states."""

    weight: float
    accuracy: float
    disagreement: float | None  # None with one member
    constant: bool  # some member predicts one class for all unlabelled states
    kept: bool


def fold_of(labels: Bools, groups: Ints | None, seed: int) -> Ints:
    """A fold 0 .. ``FOLDS`` - 1 for each state (N,), at random; states of a group are in one fold, classes in all."""
    units = np.arange(len(labels)) if groups is None else np.unique(groups, return_inverse=True)[1]
    count = units.max() + 1
    positives = np.bincount(units, labels, count)
    sizes = np.bincount(units, minlength=count)
    kinds = np.stack([positives > 0, positives < sizes], axis=1)
    folds = np.empty(count, np.int64)
    rng = rng_for(seed, "folds")
    for kind in np.unique(kinds, axis=0):
        alike = np.flatnonzero((kinds == kind).all(axis=1))
        folds[rng.permutation(alike)] = np.arange(len(alike)) % FOLDS
    return folds[units]


def lowest_kept(right: Bools, labels: Bools) -> float:
    """The balanced accuracy that members must keep, from what members without diversity have right (N, K): a - s."""
    worst = accuracies_of(right, labels).argmin()
    variance = 0.0
    for inside in (labels, ~labels):
        count = inside.sum()
        share = (right[inside, worst].sum() + 1) / (count + 2)
        variance += share * (1 - share) / count
    return float(accuracies_of(right, labels)[worst] - sqrt(variance) / 2)


def accuracies_of(right: Bools, labels: Bools) -> Doubles:
    """Members' balanced accuracies (K,), from what they have right (N, K)."""
    return member_scores(right == labels[:, None], labels)["balanced_accuracy"]


class Trainings:
    """Trainings one after the other; after a break those that are done are not trained again.

    Attributes:
        step: how many steps are done, of all of them.
    """

    def __init__(self, saved: State | None = None):
        saved = saved or {"outcomes": [], "now": None, "step": 0}
        self.step: int = saved["step"]
        self._outcomes: list[State] = [*saved["outcomes"]]
        self._saved: State | None = saved["now"]
        self._turn = 0
        self._now: EnsembleTraining | None = None

    def snapshot(self) -> State:
        """All that the next steps depend on."""
        now = self._now.snapshot() if self._now else self._saved
        return {"outcomes": self._outcomes, "now": now, "step": self.step}

    def run(
        self,
        make: Callable[[State | None], EnsembleTraining],
        outcome_of: Callable[[EnsembleTraining], State],
        is_over: Callable[[EnsembleTraining], bool],
    ) -> Outcome:
        """Make the next training, from what is saved of it, and train it, if ``is_over`` says so not to its end."""
        self._turn += 1
        if self._turn <= len(self._outcomes):
            return self._outcomes[self._turn - 1]
        training = make(self._saved)
        self._now, self._saved = training, None
        for _, losses in training.steps():
            self.step += 1
            yield losses
            if is_over(training):
                break
        outcome = outcome_of(training)
        self._outcomes.append(outcome)
        self._now = None
        return outcome


@dataclass(frozen=True)
class Choice:
    """What was chosen for one sub-goal, and why: for people and for the manifest.

    Attributes:
        weight, share: of diversity, and the share of positives expected among unlabelled states.
        held_out: positives and negatives among held-out labels; lowest: the balanced accuracy to keep there.
        tried: the weights in turn.
        remark: what a user should know of how labels were held out; empty if nothing.
    """

    weight: float
    share: Share
    held_out: tuple[int, int]
    lowest: float | None
    tried: tuple[Tried, ...]
    remark: str

    def lines(self, sub_goal: str) -> list[str]:
        """For the terminal; nothing where nothing was to be chosen."""
        if self.remark and not self.tried:
            return [f"{sub_goal}: {self.remark}"]
        if not self.tried:
            return []
        positives, negatives = self.held_out
        lines = [
            f"{sub_goal}: diversity_weight={self.weight:g}, by {positives} positives, {negatives} negatives held out",
            f"  weight  accuracy there (at least {self.lowest:.3f})  disagreement on unlabelled states",
        ]
        for tried in self.tried:
            disagreement = "-" if tried.disagreement is None else f"{tried.disagreement:.2f}"
            remark = "  chosen" if tried.kept else "  a member is constant" if tried.constant else ""
            lines.append(f"  {tried.weight:<6g}  {tried.accuracy:<32.3f}  {disagreement}{remark}")
        if not self.tried[-1].kept:
            lines.append("  members bear none of them: the smallest is taken")
        return [*lines, f"  {self.remark}"] if self.remark else lines


class AutoTraining:
    """One sub-goal's ensemble in training, with what is ``auto`` chosen first; else as :class:`EnsembleTraining`.

    Args:
        observations, labels, unlabelled, seed, device, saved: as of :class:`EnsembleTraining`.
        config: the settings.
        origins: as there; the labelled states' origin ``group``, if any, says which are held out together.

    Attributes:
        last: the training of the outcome, once it has begun.
        weight: the diversity weight, once it is chosen; share: likewise.
        tried: what each weight did that was tried.
        lowest: the balanced accuracy on held-out labels that members had to keep.
        judged: the held-out labels (n,).
        remark: what a user should know of how labels were held out; empty if nothing.
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
        self.trainings = Trainings(saved)
        objective = load_objective(config.diversity)
        self.acts = objective.acts(config.members) and config.diversity_weight != 0
        self.needs_share = self.acts and objective.ensemble_loss is not None and config.share == AUTO
        self.searches = self.acts and config.diversity_weight == AUTO
        one_by_one = config.schedule == "sequential" and config.members > 1 and not config.teacher
        self.begins_alone = self.acts and one_by_one and (self.searches or config.restarts > 1)
        self.last: EnsembleTraining | None = None
        self.weight = config.diversity_weight if config.diversity_weight != AUTO else 0.0
        self.share: Share = config.share if config.share != AUTO else LABELS
        self.tried: list[Tried] = []
        self.lowest: float = nan
        self.folds, self.remark = self._held_out() if self.searches else ([], "")
        held = [np.flatnonzero(fold) for fold in self.folds]
        self.judged = labels[np.concatenate(held)] if held else labels[:0]

    @property
    def ensemble(self) -> Ensemble:
        """The members, once the last training has begun."""
        assert self.last is not None
        return self.last.ensemble

    @property
    def step(self) -> int:
        """How many steps are done, of all trainings."""
        return self.trainings.step

    @property
    def choice(self) -> Choice:
        """What was chosen, once all steps are done."""
        held_out = int(self.judged.sum()), int((~self.judged).sum())
        lowest = None if isnan(self.lowest) else self.lowest
        return Choice(self.weight, self.share, held_out, lowest, tuple(self.tried), self.remark)

    @property
    def steps_of_first(self) -> int:
        """The steps of all first members that begin, and of the one that stays."""
        config = self.config
        return config.steps + (config.restarts - 1) * self._early

    def cost(self, weights: int) -> int:
        """The steps of all trainings, if so many weights are tried and each is trained to its end."""
        config = self.config
        rounds = config.members if config.schedule == "sequential" else 1
        if self.begins_alone:
            others = (rounds - 1) * config.steps
            return len(self.folds) * (self.steps_of_first + weights * others) + self.steps_of_first + others
        every = rounds * config.steps
        alone = config.steps if self.needs_share and not self.folds else 0
        return len(self.folds) * (1 + weights) * every + alone + every

    @property
    def most(self) -> int:
        """How many steps there are at most, those done included, as far as weights are tried."""
        left = 0 if self.last or not self.searches else len(WEIGHTS) - len(self.tried)
        if self.last:
            left_of_last = self.last.config.steps * len(self.last.rounds) - self.last.step
            return self.step + left_of_last
        return self.cost(len(self.tried) + left)

    @property
    def _early(self) -> int:
        return max(1, round(self.config.steps * EARLY))

    def snapshot(self) -> State:
        """All that the next steps depend on."""
        return self.trainings.snapshot()

    def steps(self) -> Iterator[Losses]:
        """Take the steps that are left; yields the losses of each.

        ``NumericalError``: a loss is NaN or Inf.
        """
        if self.searches:
            yield from self._search()
        everything = np.ones(len(self.labels), np.bool_)
        begun: State = {"seed": self.seed, "first": None}
        if self.begins_alone:
            begun = yield from self._begin(everything)
        elif self.needs_share and not self.folds:
            alone = yield from self._without(everything, self.seed, members=1)
            begun["positive"] = alone["positive"]
        if "positive" in begun and self.needs_share:
            self.share = begun["positive"]

        def make(saved: State | None) -> EnsembleTraining:
            self.last = self._made(everything, begun["seed"], saved, self.weight, begun["first"])
            return self.last

        yield from self.trainings.run(make, lambda _: {}, never)

    def _search(self) -> Iterator[Losses]:
        """Try weights from the largest down, until members bear one."""
        self.weight = SMALLEST
        if not self.folds:
            return
        without: list[State] = []
        for fold in self.folds:
            if self.begins_alone:
                outcome = yield from self._begin(~fold, fold)
            else:
                outcome = yield from self._without(~fold, self.seed, fold)
            without.append(outcome)
        if self.needs_share:
            self.share = float(np.mean([outcome["positive"] for outcome in without]))
        right = np.concatenate([outcome["right"] for outcome in without])
        self.lowest = lowest_kept(right, self.judged)
        for weight in WEIGHTS:
            tried = yield from self._try(weight, without)
            self.tried.append(tried)
            if tried.kept:
                self.weight = weight
                return

    def _try(self, weight: float, without: list[State]) -> Generator[Losses, None, Tried]:
        """Train with one weight, fold by fold, until a member has lost too many labels or all have kept them."""
        right = np.ones((len(self.judged), self.config.members), np.bool_)  # of what is not judged yet, too
        was_constant = any(outcome["constant"] for outcome in without)
        is_constant = False
        disagreements = []
        first_row = 0
        for fold, begun in zip(self.folds, without, strict=True):
            rows = slice(first_row, first_row + int(fold.sum()))
            first_row = rows.stop

            def accuracy_of(training: EnsembleTraining, fold: Bools = fold, rows: slice = rows) -> float:
                right[rows] = self._right(training, fold)
                return float(accuracies_of(right[:, : trained_of(training)], self.judged).min())

            def is_lost(training: EnsembleTraining, accuracy_of: Any = accuracy_of) -> bool:
                return training.done == self.config.steps and accuracy_of(training) < self.lowest

            def outcome_of(training: EnsembleTraining, fold: Bools = fold, accuracy_of: Any = accuracy_of) -> State:
                return {**self._outcome(training, fold), "accuracy": accuracy_of(training)}

            def make(saved: State | None, fold: Bools = fold, begun: State = begun) -> EnsembleTraining:
                return self._made(~fold, begun["seed"], saved, weight, begun["first"])

            outcome = yield from self.trainings.run(make, outcome_of, is_lost)
            right[rows, : outcome["right"].shape[1]] = outcome["right"]
            is_constant |= outcome["constant"]
            disagreements.append(outcome["disagreement"])
            if outcome["accuracy"] < self.lowest:
                break
        is_new = is_constant and not was_constant
        kept = outcome["accuracy"] >= self.lowest and not is_new
        disagreement = float(np.mean(disagreements))
        return Tried(weight, outcome["accuracy"], None if isnan(disagreement) else disagreement, is_new, kept)

    def _begin(self, rows: Bools, held: Bools | None = None) -> Outcome:
        """Train the first member on some labels: of those that begin the most certain one."""
        candidates: list[State] = []
        best: State = {"seed": self.seed, "training": None}
        for restart in range(self.config.restarts if self.config.restarts > 1 else 0):
            seed = seed_for(self.seed, "restart", restart) if restart else self.seed
            candidate = yield from self._candidate(rows, seed)
            candidates.append(candidate)
            best = max(candidates, key=lambda each: each["certainty"])
            for other in candidates:
                if other is not best:
                    other["training"] = None  # which may be large
        outcome = yield from self._without(rows, best["seed"], held, members=1, begun=best["training"])
        return outcome

    def _candidate(self, rows: Bools, seed: int) -> Outcome:
        """Begin to train a first member."""

        def outcome_of(training: EnsembleTraining) -> State:
            return {"seed": seed, "certainty": self._certainty(training), "training": training.snapshot()}

        def make(saved: State | None) -> EnsembleTraining:
            return self._made(rows, seed, saved, members=1)

        outcome = yield from self.trainings.run(make, outcome_of, lambda training: training.done == self._early)
        return outcome

    def _without(
        self, rows: Bools, seed: int, held: Bools | None = None, *, members: int = 0, begun: State | None = None
    ) -> Outcome:
        """Train members without diversity on some labels, from where they have ``begun``."""

        def outcome_of(training: EnsembleTraining) -> State:
            outcome = self._outcome(training, held)
            if members == 1:
                outcome["first"] = training.ensemble.networks[0].state_dict()
            return {"seed": seed, "first": None, **outcome}

        def make(saved: State | None) -> EnsembleTraining:
            return self._made(rows, seed, saved or begun, members=members)

        outcome = yield from self.trainings.run(make, outcome_of, never)
        return outcome

    def _made(
        self,
        rows: Bools,
        seed: int,
        saved: State | None,
        weight: float = 0.0,
        first: State | None = None,
        members: int = 0,
    ) -> EnsembleTraining:
        """A training on some labels."""
        config = self.config.training(weight, self.share, members=members or self.config.members)
        origins = {name: values[rows] for name, values in self.origins.labelled.items()}
        return EnsembleTraining(
            self.observations[rows],
            self.labels[rows],
            self.unlabelled,
            config,
            seed,
            origins=StateOrigins(origins, self.origins.unlabelled),
            device=self.device,
            first=first,
            saved=saved,
        )

    def _outcome(self, training: EnsembleTraining, held: Bools | None) -> State:
        """What trained members predict: what of held-out labels they have right, and of unlabelled states."""
        predictions = training.ensemble.predict(self.unlabelled)[:, : trained_of(training)] > THRESHOLD
        positive = predictions.mean(axis=0)
        outcome: State = {
            "positive": float((predictions[:, 0].sum() + 1) / (len(predictions) + 2)),
            "constant": bool(((positive == 0) | (positive == 1)).any()),
            "disagreement": mean_disagreement(predictions),
        }
        if held is not None:
            outcome["right"] = self._right(training, held)[:, : trained_of(training)]
        return outcome

    def _right(self, training: EnsembleTraining, held: Bools) -> Bools:
        predictions = training.ensemble.predict(self.observations[held]) > THRESHOLD
        return predictions == self.labels[held][:, None]

    def _certainty(self, training: EnsembleTraining) -> float:
        probabilities = training.ensemble.predict(self.unlabelled)
        return float(np.abs(2 * probabilities - 1).mean())

    def _held_out(self) -> tuple[list[Bools], str]:
        """The states (N,) that are held out in each fold, and a remark."""
        counts = {"positives": int(self.labels.sum()), "negatives": int((~self.labels).sum())}
        for kind, count in counts.items():
            if count < FEWEST:
                return [], f"{count} {kind} are too few to choose the diversity weight by, it is {SMALLEST:g}"
        remark = ""
        groups = self.origins.labelled.get(GROUP)
        fold = fold_of(self.labels, groups, self.seed)
        if groups is not None and not self._is_split(fold):
            remark = "too few groups have both classes, so single states are held out: near copies make them easy"
            fold = fold_of(self.labels, None, self.seed)
        held = self.labels[fold == 0]
        is_enough = min(held.sum(), (~held).sum()) >= FEWEST
        return [fold == number for number in range(1 if is_enough else FOLDS)], remark

    def _is_split(self, fold: Ints) -> bool:
        """Whether both classes are in the first fold, and outside of each."""
        parts = [self.labels[fold == 0]]
        parts += [self.labels[fold != number] for number in range(FOLDS)]
        return all(len(np.unique(part)) == 2 for part in parts)


def trained_of(training: EnsembleTraining) -> int:
    """How many members are trained, or being trained."""
    return training.rounds[training.number][-1] + 1


def never(_training: EnsembleTraining) -> bool:
    """Train to the end."""
    return False
