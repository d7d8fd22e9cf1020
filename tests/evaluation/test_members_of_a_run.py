"""Spec F1, F2: what the evaluation of a run says of members, recomputed from its data and weights."""

import csv
import json
import shutil

import numpy as np
import pytest

from hypogoal.core.artefacts import Artefact, open_artefact
from hypogoal.core.tensors import load_tensors, save_tensors
from hypogoal.data import open_dataset
from hypogoal.evaluation.run import thresholds_of
from hypogoal.hypotheses.ensemble import read_ensemble


@pytest.fixture(scope="module")
def metrics(tiny_run):
    """The numbers of the shared run."""
    return json.loads((tiny_run / "evaluation" / "metrics.json").read_text(encoding="utf-8"))


def test_members_are_judged_on_heldout_states(tiny_run, metrics):
    """Spec F1, F2: numbers of each ensemble, sub-goal and member, recomputed here from the file and the weights."""
    assert [(one["path"], one["name"]) for one in metrics["ensembles"]] == [
        ("another", "dbat, K=2"), ("ensemble", "dbat, K=2"), ("ensemble-none", "no diversity, K=2"),
    ]  # fmt: skip
    source = open_artefact(tiny_run / "ensemble")
    goal = metrics["ensembles"][1]["sub_goals"][0]
    split = open_dataset(tiny_run / "data.h5").heldout("collect-red-key")
    yes = read_ensemble(source.path, source.config, "collect-red-key").predict(split.observations) > 0.5
    recall, rejections = yes[split.labels].mean(0), (~yes)[~split.labels].mean(0)
    found = [member["balanced_accuracy"] for member in goal["heldout"]["members"]]
    np.testing.assert_allclose(found, (recall + rejections) / 2)
    assert goal["heldout"]["disagreement"] == pytest.approx((yes[:, 0] != yes[:, 1]).mean())
    assert goal["heldout"]["layouts"] == len(set(split.origins["layout_seed"].tolist()))
    assert len(metrics["hypotheses"]) == 3  # two sub-goals, one of them also without diversity


def test_thresholds_are_those_of_members_and_of_options(tiny_run, tmp_path):
    """Whatever rule set them; of options they are the artefact's, which may have fallen since."""
    source = open_artefact(tiny_run / "ensemble-none")
    wanted = read_ensemble(source.path, source.config, "open-red-door").thresholds.tolist()
    assert wanted[0] != 0.5
    with (tiny_run / "evaluation" / "numbers.csv").open(newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["quantity"] == "threshold" and row["scope"] == "heldout"]
    told = {
        name: [float(row["value"]) for row in rows if row["artefact"] == name] for name in ("another", source.path.name)
    }
    assert told == {"another": [0.5] * 4, "ensemble-none": wanted}

    shutil.copytree(tiny_run / "meta", tmp_path / "meta")
    weights = load_tensors(tmp_path / "meta" / "options.safetensors")
    weights["thresholds"][3] = -np.log(3.0)
    save_tensors(tmp_path / "meta" / "options.safetensors", weights)
    assert thresholds_of(Artefact(tmp_path / "meta")) == pytest.approx([0.5] * 3 + [0.25])
    assert np.isnan(thresholds_of(open_artefact(tiny_run / "meta-oracle"))).all()
