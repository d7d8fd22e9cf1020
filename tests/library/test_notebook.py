"""docs/notebook.ipynb runs as it stands, in plain Python: every cell, and what the last line of each shows."""

import ast
import json
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import pytest

NOTEBOOK = Path(__file__).parents[2] / "docs" / "notebook.ipynb"
MOST_BYTES = 300_000


def shown_by(cell: str, space: dict[str, Any]) -> Any:
    """Run a cell; the value of its last line where that is an expression."""
    tree = ast.parse(cell)
    last = tree.body.pop() if isinstance(tree.body[-1], ast.Expr) else None
    exec(compile(tree, NOTEBOOK.name, "exec"), space)
    return eval(compile(ast.Expression(last.value), NOTEBOOK.name, "eval"), space) if last else None


@pytest.mark.slow
def test_the_notebook(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The demo's story with pictures: states, verdicts, attributions, options; numbers of each stage; a comparison."""
    monkeypatch.chdir(tmp_path)
    plt.switch_backend("agg")
    cells = json.loads(NOTEBOOK.read_text(encoding="utf-8"))["cells"]
    space: dict[str, Any] = {}
    values = [shown_by("".join(cell["source"]), space) for cell in cells if cell["cell_type"] == "code"]
    shown = [value._repr_html_() for value in values if value is not None]
    assert len(plt.get_fignums()) == 4
    plt.close("all")
    words = ("open-red-door", "labelled loss", "success", "option agent", "first wins")
    assert len(shown) == len(words)
    for html, word in zip(shown, words, strict=True):
        assert html.startswith("<pre") and word in html
    assert NOTEBOOK.stat().st_size < MOST_BYTES
