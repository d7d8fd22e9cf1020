"""Spec B6, E6, F6: sub-goals that the user's own labels told, on a domain that does not know where they are true."""

from __future__ import annotations

from pathlib import Path

import gymnasium
import numpy as np
import pytest
from command_line import refuses, run, settings

from hypogoal.core.artefacts import open_artefact
from hypogoal.data import open_dataset
from hypogoal.domains.doorkey.domain import DOMAIN
from hypogoal.domains.doorkey.env import SUB_GOALS
from hypogoal.evaluation.run import read_evaluation
from hypogoal.meta.config import TrainOptionsConfig
from hypogoal.meta.setup import Setup
from hypogoal.meta.training import assemble

FEW = [*settings("steps=600", "environments=4"), "-q"]


def walked(layout_seed: int, steps: int) -> np.ndarray:
    """What random play sees, uint8 (steps, 64, 64, 3)."""
    env = gymnasium.make("hypogoal.envs:hypogoal/DoorKey-8x8-v0", layout_seed=layout_seed)
    env.reset(seed=0)
    rng = np.random.default_rng(layout_seed)
    return np.stack([env.step(int(rng.integers(3)))[0] for _ in range(steps)])


@pytest.fixture(scope="module")
def own_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An ensemble of states that were labelled elsewhere, for DoorKey."""
    own_run = tmp_path_factory.mktemp("runs") / "own"
    own_run.mkdir()
    labels = np.arange(40) % 2
    np.savez(
        own_run / "own.npz", observations=walked(0, 40), labels=labels, unlabelled=walked(1, 40),
        heldout_observations=walked(5, 40), heldout_labels=labels,
    )  # fmt: skip
    given = ["--sub-goal", "at-the-door", "--domain", "doorkey", "-q"]
    run("import", own_run / "own.npz", "--out", own_run / "data.h5", *given)
    few = settings("steps=5", "members=2", "workers=1")
    run("train-ensemble", own_run / "data.h5", "--out", own_run / "ensemble", "-q", *few)
    return own_run


def test_an_agent_of_own_labels_is_evaluated(own_run: Path) -> None:
    """Spec A5, F6: everything but the match, of which nobody knows; that is said."""
    run("train-meta", own_run / "ensemble", "--out", own_run / "meta", *FEW)
    run("evaluate", own_run, "-q")
    results = read_evaluation(own_run)
    chosen = results.of(quantity="chosen", sub_goal="at-the-door")["value"]
    assert len(chosen) == 2 and chosen.sum() > 0 and results.of(quantity="match").empty
    text = "no truth of at-the-door to match members with: doorkey has collect-blue-key, collect-green-key, "
    (line,) = (line for line in results.facts["missing"] if line.startswith(text))
    assert line.endswith("and go-to-goal")
    assert not (own_run / "meta" / "exploits.csv").exists() and results.of(quantity="fires_far").empty
    run("report", own_run)
    assert "no truth of at-the-door" in (own_run / "report" / "index.html").read_text(encoding="utf-8")


def test_a_run_of_options_only_says_where_to_add_the_truth(
    corridor_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Spec A5, F6: in a domain of one's own, where the sub-goal's function belongs; added, it is matched."""
    data, ensemble, made = tmp_path / "data.h5", tmp_path / "ensemble", tmp_path / "made"
    shown = open_dataset(corridor_run / "data.h5").unlabelled()
    near = shown[:, 0, 32, 0] > 0  # cell 4 is white
    np.savez(tmp_path / "own.npz", observations=shown, labels=near, unlabelled=shown)
    given = ["--sub-goal", "near-the-end", "--domain", "own_domain:DOMAIN", "-q"]
    run("import", tmp_path / "own.npz", "--out", data, *given)
    run("train-ensemble", data, "--out", ensemble, *settings("steps=5", "members=2", "workers=1"), "-q")
    run("train-options", ensemble, "--out", made / "options", *FEW)
    assert "random choice while options learn" in " ".join(run("evaluate", made).out.split())
    assert read_evaluation(made).facts["missing"][1:] == [
        "no truth of near-the-end to match members with: own_domain:DOMAIN has left-end and right-end"
    ]
    run("report", made)
    page = (made / "report" / "index.html").read_text(encoding="utf-8")
    assert "andom choice while options learn" in page and "Whether hypotheses mattered is unknown" in page
    monkeypatch.setattr("own_domain.CorridorDomain.sub_goals", ("near-the-end",))
    monkeypatch.setattr("own_domain.TallCorridor.labels", lambda self, ids: (ids == 4)[:, None])
    run("evaluate", made, "--force", "-q")
    assert read_evaluation(made).facts["missing"] == ["no ensemble"]


def test_true_sub_goals_that_the_domain_does_not_have_are_refused(own_run: Path) -> None:
    """Spec E6, G2: options that end at other sub-goals under this one's name would be a wrong control."""
    out = ["--out", str(own_run / "oracle"), "--set", "termination=oracle", *FEW]
    for stage in ("train-options", "train-meta"):
        refuses("doorkey does not know where this sub-goal holds: at-the-door", stage, own_run / "ensemble", *out)
        assert not (own_run / "oracle").exists()


def test_oracles_of_some_sub_goals_are_of_those(own_run: Path) -> None:
    """Spec E6: one option for each of the ensemble's sub-goals, in its order, and no other."""
    about = {**open_artefact(own_run / "ensemble").config, "sub_goals": ["go-to-goal", "collect-red-key"]}
    config = TrainOptionsConfig.of(termination="oracle")
    loop = assemble(Setup(DOMAIN, about, own_run / "ensemble", config, seed=0))
    ids = loop.engine.reachable()
    assert ids is not None and loop.terminations.options == 2
    columns = [SUB_GOALS.index("go-to-goal"), SUB_GOALS.index("collect-red-key")]
    np.testing.assert_array_equal(loop.terminations.of(ids), loop.engine.labels(ids)[:, columns])
