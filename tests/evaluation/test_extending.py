"""examples/durations.py: a figure with its number is one file and one line (docs/extending.md)."""

import csv
import importlib
from pathlib import Path

import pytest

from hypogoal.evaluation import explorer
from hypogoal.evaluation.figure_files import draw_figures
from hypogoal.evaluation.questions import QUESTIONS
from hypogoal.stages.evaluate import evaluate
from hypogoal.stages.report import report

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"


def test_a_figure_with_its_number_is_one_file_and_one_line(small_ladders, tmp_path, monkeypatch):
    """The example as it stands: number, meaning, section, figure, and the figure for a paper."""
    monkeypatch.syspath_prepend(EXAMPLES)
    for name, count in {"MOST_STATES": 8, "MOST_EXPLAINED": 4}.items():
        monkeypatch.setattr(explorer, name, count)
    QUESTIONS.append(importlib.import_module("durations").QUESTION)
    try:
        metrics = evaluate(small_ladders, small_ladders / "evaluation", quiet=True).metrics
        page = (report(small_ladders).path / "index.html").read_text(encoding="utf-8")
        drawn, _ = draw_figures(small_ladders, tmp_path / "figures")
    finally:
        del QUESTIONS[-1]
    assert len((EXAMPLES / "durations.py").read_text(encoding="utf-8").splitlines()) < 80
    assert {entry["method"]: entry["seconds"]["mean"] for entry in metrics["durations"]} == {
        "single CNN": pytest.approx(7 / 15),
        "dbat, K=2": pytest.approx(7 / 15),
        "oracle termination": pytest.approx(7 / 15),
    }
    (pair,) = metrics["comparisons"]["durations"]
    assert (pair["n"], pair["ties"], pair["where"]) == (2, 2, "N=2")
    assert metrics["quantities"]["seconds"]["unit"] == "seconds"
    with (small_ladders / "evaluation/numbers.csv").open(encoding="utf-8", newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["quantity"] == "seconds"]
    assert len(rows) == 2 * (1 + 2 + 1)
    assert {float(row["value"]) for row in rows} == {7 / 15}
    assert "<h2>How long options take</h2>" in page
    assert 'id="figure-durations"' in page
    assert (small_ladders / "report/figures/durations.png").is_file()
    assert "durations" in [path.stem for path in drawn]
