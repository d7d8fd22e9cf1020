"""What the pages and the notebook for users show runs as it stands, on tiny artefacts; so do the doctests (Spec B6)."""

import ast
import doctest
import importlib
import json
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import own_domain
import pandas as pd
import pytest
from command_line import FIXED, run, settings
from test_docs import DOCS, blocks, commands

from hypogoal.check import check_domain, require
from hypogoal.cli import main
from hypogoal.data import open_dataset

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def demo(tiny_run: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with ``runs/demo/ensemble`` and ``runs/demo/meta``, as the demo leaves them, hardly trained."""
    folder = tmp_path_factory.mktemp("demo")
    made = folder / "runs" / "demo"
    few = settings("steps=2", "workers=1")
    run("train-ensemble", tiny_run / "data.h5", "--out", made / "ensemble", "-q", *few)
    play = settings("steps=320", "warm_up=100", "max_episode_steps=60")
    run("train-meta", made / "ensemble", "--out", made / "meta", "-q", *play)
    return folder


@pytest.fixture
def in_demo(demo: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(demo)


@pytest.mark.parametrize("name", ["hypogoal.api", "hypogoal.options.env"])
def test_doctests(in_demo: None, name: str) -> None:
    """The examples in docstrings of the Python interface."""
    found = doctest.testmod(importlib.import_module(name), optionflags=doctest.ELLIPSIS)
    assert found.failed == 0 and found.attempted > 2


@pytest.mark.slow
def test_the_page_of_the_library(in_demo: None) -> None:
    """docs/library.md: its blocks one after the other, as one program."""
    space: dict[str, object] = {"__name__": "__main__"}
    code = blocks(ROOT / "docs" / "library.md", "python")
    assert len(code) >= 5
    for block in code:
        exec(compile(block, "library.md", "exec"), space)


def test_the_page_of_own_data(demo: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """docs/own-data.md: the arrays it makes, and its commands."""
    page = ROOT / "docs" / "own-data.md"
    monkeypatch.chdir(tmp_path)
    (tmp_path / "runs").mkdir()
    (tmp_path / "runs" / "demo").symlink_to(demo / "runs" / "demo")
    for block in blocks(page, "python"):
        exec(compile(block, "own-data.md", "exec"), {})
    for words in commands(page):
        short = settings("steps=2", "members=2") if words[1] == "train-ensemble" else []
        short = ["--episodes", "2"] if "--episodes" in words else short
        assert main([*words[1:], *short]) == 0, words
    assert open_dataset(tmp_path / "runs/own/data.h5").sub_goals == ("square-seen",)
    assert (tmp_path / "minari" / "solved-v0" / "data" / "main_data.hdf5").is_file()


def test_the_page_of_own_domains_shows_a_test_that_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    """docs/own-domain.md: the test for one's own test-suite, of a smaller domain than the page's."""
    monkeypatch.delenv("HYPOGOAL_TRUST", raising=False)
    monkeypatch.setitem(sys.modules, "unlock_pickup", own_domain)
    [code] = [block for block in blocks(ROOT / "docs" / "own-domain.md", "python") if "check_domain" in block]
    space: dict[str, object] = {}
    exec(compile(code, "own-domain.md", "exec"), space)
    space["test_my_domain"]()  # type: ignore[operator]


def module_of(words: str, folder: Path, name: str) -> Any:
    """The page's block with these words as a file in a folder."""
    [code] = [block for block in blocks(DOCS / "own-domain.md", "py") if words in block]
    path = folder / f"{name}.py"
    path.write_text(code, encoding="utf-8")
    module = ModuleType(name)
    exec(compile(code, str(path), "exec"), module.__dict__)
    return module


@pytest.mark.usefixtures("trusted")
def test_the_smallest_domain_without_gymnasium(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It keeps the contract, and its option is learned."""
    require(check_domain(module_of("class Line(Engine)", tmp_path, "line").DOMAIN))
    monkeypatch.syspath_prepend(str(tmp_path))
    data, ensemble, options = tmp_path / "data.h5", tmp_path / "ensemble", tmp_path / "options"
    run("collect", "line:DOMAIN", "--out", data, "-q")
    run("train-ensemble", data, "--out", ensemble, "-q", *settings("members=1", "diversity=none", "workers=1"))
    run("train-options", ensemble, "--out", options, "-q", *settings("steps=4000", "epsilon_steps=1000"))
    episodes = pd.read_csv(options / "episodes.csv").tail(20)
    assert episodes["succeeded"].all() and episodes["length"].median() <= 5  # four steps from the start


@pytest.mark.slow
@pytest.mark.usefixtures("trusted")
def test_four_rooms_from_the_page_to_a_report(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Labelled in a corner, planned and played elsewhere; no engine is written."""
    module_of("FourRoomsEnv", tmp_path, "four_rooms")
    monkeypatch.syspath_prepend(str(tmp_path))
    folder = tmp_path / "run"
    data, ensemble = folder / "data.h5", folder / "ensemble"
    small = settings("labelled_seeds=5,6", "unlabelled_seeds=1", "heldout_seeds=1,3,5,6", "steps=500", "explore=0")
    run("collect", "four_rooms:DOMAIN", "--out", data, "-q", *small)
    heldout = open_dataset(data).heldout("target")
    np.testing.assert_array_equal(heldout.origins["planted_goal"], heldout.labels)
    assert (heldout.origins["planted_corner"] != heldout.labels).sum() > 1
    run("train-ensemble", data, "--out", ensemble, "-q", *settings("members=2", "steps=20", "workers=1", *FIXED))
    run(
        "train-meta",
        ensemble,
        "--out",
        folder / "meta",
        "-q",
        *settings("network=planned", "steps=300", "layouts=4", "max_episode_steps=40"),
    )
    assert json.loads((folder / "meta" / "manifest.json").read_text(encoding="utf-8"))["config"]["network"] == "planned"
    run("evaluate", folder, "-q")
    run("report", folder, "-q")
    assert (folder / "report" / "index.html").is_file()


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
