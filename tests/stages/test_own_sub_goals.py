"""Spec B6, E6, F6: sub-goals that the user's own labels told, on a domain that does not know where they are true."""

from __future__ import annotations

import json
from pathlib import Path

import gymnasium
import numpy as np
import pytest

from hypogoal.cli import main
from hypogoal.core.artefacts import open_artefact
from hypogoal.domains.doorkey import DOMAIN
from hypogoal.domains.doorkey_env import SUB_GOALS
from hypogoal.meta.config import TrainOptionsConfig
from hypogoal.meta.training import assemble

FEW = ["--set", "steps=600", "--set", "environments=4", "--set", "random_episodes=5", "-q"]


def walked(layout_seed: int, steps: int) -> np.ndarray:
    """What random play sees, uint8 (steps, 64, 64, 3)."""
    env = gymnasium.make("hypogoal/DoorKey-8x8-v0", layout_seed=layout_seed)
    env.reset(seed=0)
    rng = np.random.default_rng(layout_seed)
    return np.stack([env.step(int(rng.integers(3)))[0] for _ in range(steps)])


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An ensemble of states that were labelled elsewhere, for DoorKey."""
    run = tmp_path_factory.mktemp("runs") / "own"
    run.mkdir()
    labels = np.arange(40) % 2
    np.savez(
        run / "own.npz", observations=walked(0, 40), labels=labels, unlabelled=walked(1, 40),
        heldout_observations=walked(5, 40), heldout_labels=labels,
    )  # fmt: skip
    given = ["--sub-goal", "at-the-door", "--domain", "doorkey", "-q"]
    assert main(["import", str(run / "own.npz"), "--out", str(run / "data.h5"), *given]) == 0
    few = ["--set", "steps=5", "--set", "members=2", "--set", "workers=1", "-q"]
    assert main(["train-ensemble", str(run / "data.h5"), "--out", str(run / "ensemble"), *few]) == 0
    return run


def test_an_agent_of_own_labels_is_evaluated(run: Path) -> None:
    """Spec A5, F6: everything but the match, of which nobody knows; that is said."""
    assert main(["train-meta", str(run / "ensemble"), "--out", str(run / "meta"), *FEW]) == 0
    assert main(["evaluate", str(run), "-q"]) == 0
    metrics = json.loads((run / "evaluation" / "metrics.json").read_text(encoding="utf-8"))
    (goal,) = metrics["selection"][0]["runs"][0]["sub_goals"]
    assert goal["sub_goal"] == "at-the-door" and [member["match"] for member in goal["members"]] == [None, None]
    assert sum(member["chosen"] for member in goal["members"]) > 0
    assert "no truth of at-the-door in its domain, to match members with" in metrics["missing"]
    assert not (run / "meta" / "exploits.csv").exists() and metrics["exploits"]["over_runs"] == []
    assert main(["report", str(run)]) == 0
    assert "no truth of at-the-door" in (run / "report" / "index.html").read_text(encoding="utf-8")


def test_true_sub_goals_that_the_domain_does_not_have_are_refused(
    run: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Spec E6, G2: options that end at other sub-goals under this one's name would be a wrong control."""
    out = ["--out", str(run / "oracle"), "--set", "termination=oracle", *FEW]
    for stage in ("train-options", "train-meta"):
        assert main([stage, str(run / "ensemble"), *out]) == 2
        err = capsys.readouterr().err
        assert "doorkey does not know where this sub-goal holds: at-the-door" in err and err.count("\n") == 1
        assert not (run / "oracle").exists()


def test_oracles_of_some_sub_goals_are_of_those(run: Path) -> None:
    """Spec E6: one option for each of the ensemble's sub-goals, in its order, and no other."""
    about = {**open_artefact(run / "ensemble").config, "sub_goals": ["go-to-goal", "collect-red-key"]}
    config = TrainOptionsConfig(termination="oracle")
    loop = assemble(DOMAIN, run / "ensemble", about, config, seed=0)
    ids = loop.engine.reachable()
    assert ids is not None and loop.terminations.options == 2
    columns = [SUB_GOALS.index("go-to-goal"), SUB_GOALS.index("collect-red-key")]
    np.testing.assert_array_equal(loop.terminations.of(ids), loop.engine.labels(ids)[:, columns])
