"""The example of distilled options, by its own commands (Spec H6)."""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path

import pytest
from test_examples import settings

from hypogoal.cli import main

EXAMPLE = Path(__file__).parents[2] / "examples" / "distilled.py"
SHORT = {  # appended to the page's commands, so that they end in seconds
    "collect": settings("heldout_layouts=1", "unlabelled_seeds=1"),
    "train-ensemble": settings("steps=2", "members=2", "workers=1"),
    "train-options": settings("steps=640", "rate_steps=640", "layouts=1000-1002", "random_episodes=0"),
    "train-meta": settings("steps=320", "random_episodes=0"),
    "evaluate": ["--layouts", "6000-6001"],
}


def test_distilled_options_go_through_all_stages(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Spec H6: from plans to play in other layouts, inside an engine and without it."""
    text = EXAMPLE.read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 40
    monkeypatch.chdir(tmp_path)
    lines = [line.split() for line in text.splitlines() if line.startswith("    hypogoal ")]
    assert len(lines) == 5
    for words in lines:
        assert main([*words[1:], *SHORT[words[1]], "-q"]) == 0, words
    metrics = json.loads(Path("runs/far/evaluation/metrics.json").read_text(encoding="utf-8"))
    assert metrics["zero_shot"]["layouts"] == [6000, 6001] and len(metrics["zero_shot"]["options"]) == 5 * 3
    spec = importlib.util.spec_from_file_location("distilled", EXAMPLE)
    assert spec is not None and spec.loader is not None
    example = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(example)
    played = example.play(6100)
    assert len(played) == 10 and all("steps its" in line for line in played)
