"""The examples go through the stages by the command line, as their readers would take them (Spec B6)."""

from __future__ import annotations

import ast
import json
from pathlib import Path

import pytest

from hypogoal.cli import main
from hypogoal.dataset import open_dataset

EXAMPLES = Path(__file__).parents[2] / "examples"
MOST_LINES = 30


@pytest.fixture(autouse=True)
def in_the_examples_folder(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(EXAMPLES)  # modules of the current folder are found
    monkeypatch.setenv("HYPOGOAL_TRUST", "unlock_pickup:DOMAIN,freeway:DOMAIN")


def code_lines(path: Path) -> int:
    """Lines of a module that are neither empty nor comments nor docstrings."""
    text = path.read_text(encoding="utf-8")
    lines = {number for number, line in enumerate(text.splitlines(), 1) if line.strip() and line.strip()[0] != "#"}
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            lines -= set(range(node.lineno, (node.end_lineno or node.lineno) + 1))
    return len(lines)


def settings(*pairs: str) -> list[str]:
    return [word for pair in pairs for word in ("--set", pair)]


def test_unlock_pickup_goes_through_all_stages_in_few_lines(tmp_path: Path) -> None:
    """Spec B6, A1-A5: an environment, two label functions and a way to wander are all that a user writes."""
    assert code_lines(EXAMPLES / "unlock_pickup.py") < MOST_LINES
    run = tmp_path / "run"
    data, ensemble, options, meta = (str(run / name) for name in ("data.h5", "ensemble", "options", "meta"))
    layouts = settings("labelled_seeds=0", "unlabelled_seeds=1", "heldout_seeds=2", "steps=600")
    assert main(["collect", "unlock_pickup:DOMAIN", "--out", data, "-q", *layouts]) == 0
    counts = open_dataset(Path(data)).counts()
    for sub_goal in ("hold-key", "open-door"):
        row = counts["labelled"][sub_goal]
        assert 10 < row["positives"] < row["states"] - 10
    assert counts["unlabelled"] > 50
    few = settings("steps=20", "members=2", "workers=1")
    assert main(["train-ensemble", data, "--out", ensemble, "-q", *few]) == 0
    play = settings("steps=240", "environments=2", "warm_up=50", "layout_seed=0", "max_episode_steps=60")
    assert main(["train-options", ensemble, "--out", options, "-q", *play]) == 0
    assert main(["train-meta", ensemble, "--options", options, "--out", meta, "-q", *play]) == 0
    assert main(["evaluate", str(run), "-q"]) == 0
    assert main(["report", str(run), "-q"]) == 0
    metrics = json.loads((run / "evaluation" / "metrics.json").read_text(encoding="utf-8"))
    assert [row["sub_goal"] for row in metrics["ensembles"][0]["sub_goals"]] == ["hold-key", "open-door"]
    assert metrics["agents"][0]["runs"]
    assert "open-door" in (run / "report" / "index.html").read_text(encoding="utf-8")


@pytest.mark.atari
def test_freeway_goes_through_collect_ensembles_and_evaluation(tmp_path: Path) -> None:
    """Spec B6: an Atari game other than Montezuma's Revenge, with sub-goals from its memory and defaults of its own."""
    run = tmp_path / "run"
    data, ensemble = str(run / "data.h5"), run / "ensemble"
    layouts = settings("unlabelled_seeds=1", "heldout_seeds=2", "steps=400", "states=200")
    assert main(["collect", "freeway:DOMAIN", "--out", data, "-q", *layouts]) == 0
    few = settings("steps=10", "members=2", "workers=1")
    assert main(["train-ensemble", data, "--out", str(ensemble), "-q", *few]) == 0
    assert json.loads((ensemble / "manifest.json").read_text(encoding="utf-8"))["config"]["network"] == "montezuma"
    assert main(["evaluate", str(run), "-q"]) == 0
    metrics = json.loads((run / "evaluation" / "metrics.json").read_text(encoding="utf-8"))
    rows = {row["sub_goal"]: row for row in metrics["ensembles"][0]["sub_goals"]}
    assert set(rows) == {"half-way", "far-side"}
    assert all(row["balanced_accuracy"]["best"] is not None for row in rows.values())
