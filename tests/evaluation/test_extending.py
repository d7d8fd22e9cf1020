"""examples/durations.py: a figure with its number is one file, its template and one line (docs/insides.md)."""

import importlib
import shutil
from importlib import resources
from pathlib import Path

import pandas as pd
import pytest

from hypogoal.evaluation import page, questions
from hypogoal.evaluation.figure_files import draw_figures
from hypogoal.stages.evaluate import evaluate
from hypogoal.stages.report import report

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"


def test_numbers_in_words() -> None:
    """From three in a row on, the first and the last."""
    assert page.spans([972, 5, 970, 971, 3, 4, 8, 9]) == "3 to 5, 8, 9 and 970 to 972"
    assert page.spans([2]) == "2" and page.spans([]) == "none"


def test_a_figure_with_its_number_is_one_file_and_one_line(small_ladders, tmp_path, monkeypatch):
    """The example as it stands: table, section, figure, and the figure for a paper."""
    monkeypatch.syspath_prepend(EXAMPLES)
    templates = shutil.copytree(str(resources.files("hypogoal.evaluation") / "templates"), tmp_path / "templates")
    shutil.copy(EXAMPLES / "durations.html", templates)
    monkeypatch.setattr(page, "TEMPLATES", templates)
    *others, _ = questions.QUESTIONS[:5]
    durations = questions.Question(importlib.import_module("durations"))
    monkeypatch.setattr(questions, "QUESTIONS", [*others, durations])
    evaluate(small_ladders, quiet=True)
    text = (report(small_ladders).path / "index.html").read_text(encoding="utf-8")
    drawn, _ = draw_figures(small_ladders, tmp_path / "figures")
    assert sum((EXAMPLES / f"durations.{kind}").read_text().count("\n") for kind in ("py", "html")) <= 60
    table = pd.read_csv(small_ladders / "evaluation/tables/durations.csv").set_index("method")["mean"]
    methods = ("D-BAT, 2 members", "one classifier", "oracle termination")
    assert table.to_dict() == dict.fromkeys(methods, pytest.approx(7 / 15))
    (pair,) = pd.read_csv(small_ladders / "evaluation/tables/durations-pairs.csv").to_dict("records")
    assert (pair["n"], pair["ties"], pair["N"]) == (2, 2, 2)
    assert "<h2>How long options take</h2>" in text and 'id="figure-durations"' in text
    assert (small_ladders / "report/figures/durations.svg").is_file()
    assert "durations" in [path.stem for path in drawn]
