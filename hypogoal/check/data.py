"""A check of a data file before hours of training: enough labels, more than one hypothesis, the cost of training."""

import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from math import ceil
from pathlib import Path
from time import perf_counter

from hypogoal.check.verdict import Verdict, verdicts
from hypogoal.core.processes import allowed, prepare
from hypogoal.data import Dataset, open_dataset
from hypogoal.hypotheses.auto import AutoTraining, training_of
from hypogoal.hypotheses.config import TrainEnsembleConfig
from hypogoal.hypotheses.scores import idle_members, mean_disagreement
from hypogoal.hypotheses.sub_goals import checked
from hypogoal.label_checks import doubts_of

SECONDS = 45.0  # how long all sub-goals together are trained
TIMED = 10  # steps that are timed
FEWEST = 50  # steps; with fewer, a training says nothing
USUAL = 4  # the median number of weights that are tried
PAIR = {"members": 2, "restarts": 2}  # enough to see whether there is a second hypothesis


def check_data(path: Path, config: TrainEnsembleConfig, *, seed: int = 0) -> Iterator[Verdict]:
    """Check whether ``train-ensemble`` can find more than one hypothesis in a data file, in a minute.

    The verdicts say whether there are enough labels, how much two members can differ on unlabelled states while they
    keep the labels, and how long training will take with the settings ``config``.
    """
    prepare()
    dataset = open_dataset(path)
    config, sub_goals = checked(config, dataset)
    yield from verdicts([_Data.labels, _Data.hypotheses, _Data.cost], _Data(dataset, config, sub_goals, seed))


@dataclass
class _Data:
    """A data file, and how it would be trained on."""

    dataset: Dataset
    config: TrainEnsembleConfig
    sub_goals: Sequence[str]
    seed: int
    seconds: dict[str, float] = field(default_factory=dict)  # seconds of a step, by sub-goal

    def labels(self) -> str:
        """Both classes have enough labels."""
        counts = []
        for sub_goal in self.sub_goals:
            labels = self.dataset.labelled(sub_goal).labels
            heldout = self.dataset.heldout(sub_goal).labels
            for line in doubts_of(labels[:, None], heldout[:, None], [sub_goal]):
                warnings.warn(line, stacklevel=1)
            if remark := self.training(sub_goal, self.config).remark:
                warnings.warn(f"{sub_goal}: {remark}", stacklevel=1)
            counts.append(f"{sub_goal} {labels.sum()} positives of {len(labels)}")
        return ", ".join(counts)

    def hypotheses(self) -> str:
        """Two members can keep the labels and differ elsewhere."""
        texts = []
        for sub_goal in self.sub_goals:
            self.seconds[sub_goal] = self.timed(sub_goal)
            few = self.config.model_copy(update=PAIR)
            per_step = self.training(sub_goal, few).cost(1, USUAL) / few.steps * self.seconds[sub_goal]
            steps = min(few.steps, int(SECONDS / len(self.sub_goals) / per_step))
            if steps < FEWEST:
                texts.append(f"{sub_goal} not looked at: {FEWEST} steps would take {FEWEST * per_step:.0f} s")
                continue
            training = self.training(sub_goal, few.model_copy(update={"steps": steps}))
            for _ in training.steps():
                pass
            predictions = training.ensemble.predictions(training.unlabelled)
            for line in idle_members(predictions):
                warnings.warn(f"{sub_goal}: {line} after {steps} steps: labels leave no other hypothesis", stacklevel=1)
            differ = f"two members differ on {mean_disagreement(predictions):.0%} of the unlabelled states"
            texts.append(f"{sub_goal}: with diversity_weight={training.weight:g} {differ} after {steps} steps")
        return "; ".join(texts)

    def cost(self) -> str:
        """The time that training takes is known."""
        usual = most = 0.0
        for sub_goal in self.sub_goals:
            training = self.training(sub_goal, self.config)
            usual += training.cost(len(training.folds), USUAL) * self.seconds[sub_goal]
            most += training.most * self.seconds[sub_goal]
        workers = min(allowed(self.config.workers), len(self.sub_goals))
        return f"train-ensemble takes some {_minutes(usual / workers)}, at most {_minutes(most / workers)}"

    def timed(self, sub_goal: str) -> float:
        """Return the seconds of a step, with the step's share of other work."""
        training = self.training(sub_goal, self.config.model_copy(update={"steps": TIMED, "restarts": 1}))
        begun = 0.0
        for _ in training.steps():
            if training.step == 1:  # not timed, because the first step compares pictures
                begun = perf_counter()
            if training.step == TIMED:
                break
        return (perf_counter() - begun) / (TIMED - 1)

    def training(self, sub_goal: str, config: TrainEnsembleConfig) -> AutoTraining:
        """Return the training of a sub-goal's ensemble, not begun."""
        labelled, unlabelled = self.dataset.labelled(sub_goal), self.dataset.unlabelled_states()
        return training_of(labelled, unlabelled, sub_goal, config, self.seed)


def _minutes(seconds: float) -> str:
    return f"{ceil(seconds)} s" if seconds < 100 else f"{ceil(seconds / 60)} min"
