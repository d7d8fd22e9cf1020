"""Goal misgeneralisation in MiniGrid as released: examples/misgeneralise.py and misgeneralise_goto.py (Spec B6, G4)."""

import importlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from command_line import run, settings

from hypogoal.core.progress import Progress
from hypogoal.domains.base import Layouts

EXAMPLES = Path(__file__).parents[2] / "examples"
NAMES = ("misgeneralise", "misgeneralise_goto")


def domain_of(name: str) -> Any:
    module = importlib.import_module(name)
    return module.FETCH if name == NAMES[0] else module.GOTO


@pytest.mark.parametrize("name", NAMES)
def test_its_kinds_of_level(name: str) -> None:
    """In labelled levels both features hold together, in new ones never; a view shows nothing of the target."""
    domain = domain_of(name)
    seeds = {"labelled_seeds": (0, 1), "unlabelled_seeds": (1000,), "heldout_seeds": (2000, 2001)}
    config = domain.config_class(**seeds, steps=900)
    found = domain.collect(config, 0, Progress("collect", 1, quiet=True))
    labelled, heldout = found.labelled, found.heldout
    for feature in ("planted_colour", "planted_shape"):
        np.testing.assert_array_equal(labelled.origins[feature], labelled.labels[:, 0])
        assert heldout.origins[feature].sum() > 0
    assert not (heldout.origins["planted_colour"] & heldout.origins["planted_shape"]).any()
    np.testing.assert_array_equal(heldout.origins["planted_shape"], heldout.labels[:, 0])
    assert labelled.origins["over"].mean() == 0.5 and labelled.labels.sum() < labelled.origins["over"].sum()
    assert found.unlabelled.origins["over"].all()
    np.testing.assert_array_equal(labelled.origins["group"], labelled.origins["layout_seed"])


@pytest.mark.parametrize("name", NAMES)
def test_the_reward_asks_for_one_feature(name: str) -> None:
    """By the plan of two levels: each task is solved at the end that has its feature, and at no other."""
    domain = domain_of(name)
    for task in ("colour", "shape"):
        engine = domain.make_engine(0, 2, 100, layouts=Layouts((3000, 3001)), task=task)
        plan = engine.plan()
        assert plan is not None and plan.solved.any()
        holds = engine.labels(plan.ids)[:, 0] & plan.final
        np.testing.assert_array_equal(holds & ~plan.solved, False)
        assert plan.final.sum() > plan.solved.sum() > 0


@pytest.mark.parametrize(("name", "most"), [(NAMES[0], 230), (NAMES[1], 60)])
def test_it_is_short(name: str, most: int) -> None:
    assert len((EXAMPLES / f"{name}.py").read_text(encoding="utf-8").splitlines()) <= most


@pytest.mark.slow
def test_from_nothing_to_a_report(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The command at the head of the file, in small: labels alone do not say what is rewarded in new levels."""
    monkeypatch.chdir(EXAMPLES)
    out = tmp_path / "fetch"
    few = settings("labelled=40", "unlabelled=60", "new=6", "workers=1")
    run("run", "misgeneralise:fetch", "--out", out, "--trust", *few)
    rows = pd.read_csv(out / "evaluation" / "results.csv")
    assert {*rows["task"].dropna()} == {"colour", "shape"} and {*rows["method"].dropna()} == {"independent", "one"}
    numbers = pd.read_csv(out / "evaluation" / "numbers.csv")
    assert {"planted_colour", "planted_shape"} <= {*numbers["scope"]}
    assert (out / "report" / "index.html").is_file()
    results = json.loads((out / "evaluation" / "run.json").read_text(encoding="utf-8"))
    assert results["task_of"]["one classifier, task=shape"].endswith("task=shape"), "unlike tasks are not compared"
