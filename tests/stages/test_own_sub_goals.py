"""Spec B6, E6, F6: sub-goals that the user's own labels told, on a domain that does not know where they are true."""

from pathlib import Path

import numpy as np
import pytest
from command_line import FIXED, refuses, run, settings

from hypogoal.core.artefacts import open_artefact
from hypogoal.data import open_dataset
from hypogoal.domains.doorkey.domain import DOMAIN
from hypogoal.domains.doorkey.env import SUB_GOALS
from hypogoal.evaluation.run import read_evaluation
from hypogoal.meta.config import TrainOptionsConfig
from hypogoal.meta.setup import Setup, assemble

FEW = [*settings("steps=400", "environments=4", "max_episode_steps=30"), "-q"]


@pytest.fixture
def own_run(corridor_run: Path, tmp_path: Path) -> Path:
    """An ensemble of states that were labelled elsewhere, for the corridor: cell 4 is positive."""
    folder = tmp_path / "own"
    shown = open_dataset(corridor_run / "data.h5").unlabelled()
    np.savez(tmp_path / "own.npz", observations=shown, labels=shown[:, 0, 32, 0] > 0, unlabelled=shown)
    words = ["--sub-goal", "near-the-end", "--domain", "own_domain:DOMAIN", "-q"]
    run("import", tmp_path / "own.npz", "--out", folder / "data.h5", *words)
    few = settings("steps=5", "members=2", "workers=1", *FIXED)
    run("train-ensemble", folder / "data.h5", "--out", folder / "ensemble", *few, "-q")
    return folder


def test_an_agent_of_own_labels_is_evaluated(own_run: Path) -> None:
    """Spec A5, F6: everything but the match, of which nobody knows; that is said."""
    run("train-meta", own_run / "ensemble", "--out", own_run / "meta", *FEW)
    run("evaluate", own_run, "-q")
    results = read_evaluation(own_run)
    chosen = results.of(quantity="chosen", sub_goal="near-the-end")["value"]
    assert len(chosen) == 2 and chosen.sum() > 0 and results.of(quantity="match").empty
    assert not (own_run / "meta" / "exploits.csv").exists() and results.of(quantity="fires_far").empty


def test_a_run_of_options_only_says_where_to_add_the_truth(
    own_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Spec A5, F6: in a domain of one's own, where the sub-goal's function belongs; added, it is matched."""
    made = tmp_path / "made"
    run("train-options", own_run / "ensemble", "--out", made / "options", *FEW)
    assert "random choice while options learn" in " ".join(run("evaluate", made).out.split())
    assert read_evaluation(made).facts["missing"][1:] == [
        "no truth of near-the-end to match members with: own_domain:DOMAIN has left-end and right-end"
    ]
    run("report", made)
    page = (made / "report" / "index.html").read_text(encoding="utf-8")
    assert "andom choice while options learn" in page and "Whether hypotheses mattered is unknown" in page
    assert "no truth of near-the-end" in page
    monkeypatch.setattr("own_domain.CorridorDomain.sub_goals", ("near-the-end",))
    monkeypatch.setattr("own_domain.TallCorridor.labels", lambda self, ids: (ids == 4)[:, None])
    run("evaluate", made, "--force", "-q")
    assert read_evaluation(made).facts["missing"] == ["no ensemble"]


def test_true_sub_goals_that_the_domain_does_not_have_are_refused(own_run: Path) -> None:
    """Spec E6, G2: options that end at other sub-goals under this one's name would be a wrong control."""
    words = [own_run / "ensemble", "--out", own_run / "oracle", "--set", "termination=oracle", *FEW]
    for stage in ("train-options", "train-meta"):
        refuses("own_domain:DOMAIN does not know where this sub-goal holds: near-the-end", stage, *words)
        assert not (own_run / "oracle").exists()


def test_oracles_of_some_sub_goals_are_of_those(tiny_run: Path) -> None:
    """Spec E6: one option for each of the ensemble's sub-goals, in its order, and no other."""
    about = {**open_artefact(tiny_run / "ensemble").config, "sub_goals": ["go-to-goal", "collect-red-key"]}
    config = TrainOptionsConfig.of(termination="oracle")
    loop = assemble(Setup(DOMAIN, about, tiny_run / "ensemble", config, seed=0))
    ids = loop.engine.reachable()
    assert ids is not None and loop.terminations.options == 2
    columns = [SUB_GOALS.index("go-to-goal"), SUB_GOALS.index("collect-red-key")]
    np.testing.assert_array_equal(loop.terminations.of(ids), loop.engine.labels(ids)[:, columns])
