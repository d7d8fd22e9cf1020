"""What members know of held-out states while they are trained: scores.jsonl of train-ensemble."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from test_broken_training import Breaking, Broken

from hypogoal.core.artefacts import open_artefact
from hypogoal.core.checkpoints import checkpoints_of
from hypogoal.dataset import open_dataset
from hypogoal.domains.doorkey import DOMAIN, DoorKeyConfig
from hypogoal.hypotheses.ensemble import read_ensemble
from hypogoal.hypotheses.scores import best_threshold, member_scores, ranking
from hypogoal.stages import train_ensemble as stage
from hypogoal.stages.collect import collect
from hypogoal.stages.train_ensemble import TrainEnsembleConfig, train_ensemble

GOAL = "collect-red-key"
CONFIG = TrainEnsembleConfig(steps=12, score_every=5, members=2, workers=1, sub_goals=(GOAL,))


def scores(artefact: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (artefact / "scores.jsonl").read_text().splitlines()]


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Data of two held-out layouts, and an ensemble with its scores."""
    made = tmp_path_factory.mktemp("made")
    collect(DOMAIN, DoorKeyConfig(heldout_layouts=2, unlabelled_seeds=(1,)), made / "data.h5", seed=0, quiet=True)
    train_ensemble(made / "data.h5", CONFIG, made / "ensemble", seed=3, quiet=True)
    return made


def test_scores_are_those_of_the_ensemble(made: Path) -> None:
    """Spec F1: after the last step, of all states and of each half of the layouts."""
    rows = scores(made / "ensemble")
    assert [(row["step"], row["scope"], row["member"]) for row in rows] == [
        (step, scope, member) for step in (5, 10, 12) for scope in ("all", "first", "second") for member in (0, 1)
    ]
    artefact = open_artefact(made / "ensemble").whole()
    ensemble = read_ensemble(artefact.path, artefact.config, GOAL)
    dataset = open_dataset(made / "data.h5")
    heldout, seeds = dataset.heldout(GOAL), dataset.heldout(GOAL).origins["layout_seed"]
    probabilities, elsewhere = ensemble.predict(heldout.observations), ensemble.predict(dataset.unlabelled())
    quantiles = np.quantile(elsewhere, 0.95, axis=0, method="higher").clip(
        max=np.nextafter(np.float32(1), np.float32(0))
    )
    for scope, inside in (("all", seeds >= 0), ("first", seeds == seeds.min()), ("second", seeds == seeds.max())):
        here = [row for row in rows if (row["step"], row["scope"]) == (12, scope)]
        seen, labels = probabilities[inside], heldout.labels[inside]
        assert {row["states"] for row in here} == {inside.sum()} and {row["positives"] for row in here} == {
            labels.sum()
        }
        for name, expected in (
            ("ranking", ranking(seen, labels)),
            ("balanced_accuracy", member_scores(seen > 0.5, labels)["balanced_accuracy"]),
            ("at_q95", member_scores(seen > quantiles, labels)["balanced_accuracy"]),
            ("at_best", best_threshold(seen, labels)[1]),
        ):
            np.testing.assert_allclose([row[name] for row in here], expected, atol=1e-6)


def test_scores_change_nothing_else(made: Path, tmp_path: Path) -> None:
    """The same weights with and without."""
    config = TrainEnsembleConfig(steps=12, members=2, workers=1, sub_goals=(GOAL,))
    train_ensemble(made / "data.h5", config, tmp_path / "plain", seed=3, quiet=True)
    assert not (tmp_path / "plain" / "scores.jsonl").exists()
    weights = [(folder / f"{GOAL}.safetensors").read_bytes() for folder in (tmp_path / "plain", made / "ensemble")]
    assert weights[0] == weights[1]


def test_scores_are_the_same_after_a_break(made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Spec G1: what was scored after the last checkpoint is scored once."""

    def train(*, resume: bool) -> None:
        train_ensemble(made / "data.h5", CONFIG, tmp_path / "out", seed=3, resume=resume, quiet=True)

    for last in (7, 4):
        with monkeypatch.context() as patch:
            patch.setattr(stage, "checkpoints_of", lambda *of, last=last: Breaking(checkpoints_of(*of).path, last))
            with pytest.raises(Broken):
                train(resume=last == 4)
    train(resume=True)
    for name in ("scores.jsonl", f"{GOAL}.safetensors"):
        assert (tmp_path / "out" / name).read_bytes() == (made / "ensemble" / name).read_bytes()
