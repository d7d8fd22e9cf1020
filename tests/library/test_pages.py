"""What the pages for users of the library show runs as it stands, on tiny artefacts; so do the doctests."""

import doctest
import importlib
import sys
from pathlib import Path

import own_domain
import pytest
from command_line import run, settings
from test_docs import blocks, commands

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
