"""The example of training over many layouts, by its own commands (Spec H6)."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import pytest
from openings import agrees
from test_examples import OWN_TASK, settings

from hypogoal.cli import main

EXAMPLE = Path(__file__).parents[2] / "examples" / "many_layouts.py"
PLAY = settings("steps=160", "environments=4", "warm_up=50", "max_episode_steps=40", "random_episodes=0")
SHORT = {  # appended to the page's commands, so that they end in seconds
    "collect": settings("labelled_seeds=0,1", "unlabelled_seeds=10", "heldout_seeds=11", "steps=2000"),
    "train-ensemble": settings("steps=20", "members=2", "workers=1"),
    "train-options": PLAY,
    "train-meta": PLAY,
    "evaluate": ["--layouts", "5000-5002"],
}


def test_many_layouts_go_through_all_stages(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Spec H6: what is trained over many layouts is told from others, and tried without learning on those given."""
    text = EXAMPLE.read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 40
    (tmp_path / EXAMPLE.name).write_text(text, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HYPOGOAL_TRUST", "many_layouts:DOMAIN")
    lines = [line.split() for line in text.splitlines() if line.startswith("    hypogoal")]
    for words in lines:
        assert main([*words[1:], *SHORT.get(words[1], ()), *(["-q"] if words[1] != "report" else [])]) == 0, words
    run = tmp_path / "runs" / "many"
    assert json.loads((run / "meta" / "layout.json").read_text(encoding="utf-8"))["layouts"] == "1000-1999"
    metrics = json.loads((run / "evaluation" / "metrics.json").read_text(encoding="utf-8"))
    told = metrics["zero_shot"]
    assert told["layouts"] == [5000, 5001, 5002] and len(told["agents"]) == 2 and len(told["options"]) == 3 * 3
    assert told["agents"][0]["success"]["n"] == 3 and told["agents"][0]["trained_on"] == 0
    assert told["agents"][0]["near"]["n"] == 0  # nobody knows the shortest path of a Gymnasium environment
    with (run / "evaluation" / "numbers.csv").open(newline="", encoding="utf-8") as file:
        rows = [row for row in csv.DictReader(file) if row["scope"] == "zero-shot"]
    assert {row["layout"] for row in rows} == {"5000", "5001", "5002"}
    assert {row["quantity"] for row in rows} == {"success", "length", "false_positives"}
    agrees(run, OWN_TASK, "Choosing made no difference over 3 layouts")
    page = (run / "report" / "index.html").read_text(encoding="utf-8")
    assert "On other layouts, without learning" in page and "layout seeds 1000-1999" in page
