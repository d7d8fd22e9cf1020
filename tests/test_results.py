"""Published tables are drawn from the committed cells (Spec F5, H7)."""

import importlib
import re
import sys
from pathlib import Path

import numpy as np
import pytest

from hypogoal.cli import main
from hypogoal.core.errors import UserError
from hypogoal.domains.rooms.domain import DOMAIN
from studies import hypotheses, pages
from studies.cells import collect_once, difference, interval, run_cells

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "docs" / "results"


def test_the_tables_of_the_pages_are_drawn_from_their_cells() -> None:
    """``python -m studies.pages`` would change nothing, and no other page than two has a table of its own."""
    drawn = set()
    for path in pages.PAGES:
        page = path.read_text(encoding="utf-8")
        marks = pages.MARKED.findall(page)
        drawn |= {name for name, _ in marks}
        assert pages.drawn(page) == page, path.name
        assert path.stem in ("index", "history") or len(pages.tables_in(page.splitlines())) == len(marks)
    assert drawn == {*pages.TABLES}


def test_the_table_of_the_readme_has_the_numbers_of_the_pages() -> None:
    """Every decimal in it stands in a table that is drawn from cells."""
    shown = _numbers((ROOT / "README.md").read_text(encoding="utf-8"))
    published: set[str] = set()
    for path in RESULTS.glob("*.md"):
        if path.stem not in ("index", "history"):
            published |= _numbers(path.read_text(encoding="utf-8"))
    assert shown and shown <= published


def test_each_claim_of_the_paper_names_a_command_that_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An experiment lists what it would do (``--dry-run``), a study its arguments."""
    monkeypatch.chdir(ROOT)
    claims = (RESULTS / "index.md").read_text(encoding="utf-8").split("\n## ")[1].partition("\n### ")[0]
    rows = [line.rstrip(" |").split("|") for line in claims.splitlines() if line.startswith("| ")][1:]
    commands = {row[-1].strip(" `") for row in rows}
    assert len(rows) == 10 and len(commands) >= 7
    for command in commands:
        runner, *words = command.split()
        if runner == "hypogoal":
            assert main([*words, "--dry-run", "--out", str(tmp_path / "out")]) == 0, command
        else:
            study = importlib.import_module(words[1])
            monkeypatch.setattr(sys, "argv", [command, "--help"])
            with pytest.raises(SystemExit, match="0"):
                study.main()
    assert not list(tmp_path.iterdir())


NAMED = re.compile(r"(?<![\w/.-])(?:docs|studies|examples|benchmarks|tests)/[\w./-]*\w")
MODULE = re.compile(r"(?<![\w/.-])(?:studies|examples|benchmarks)\.[a-z_]\w*")


def test_pages_and_files_that_are_named_are_there() -> None:
    """By a setting's source, by code and by the docs."""
    texts = {path: path.read_text(encoding="utf-8") for path in [ROOT / "README.md", *(ROOT / "docs").rglob("*.md")]}
    for folder in ("hypogoal", "studies", "examples", "benchmarks"):
        for path in (ROOT / folder).rglob("*"):
            if path.suffix in (".py", ".toml", ".json", ".html"):
                texts[path] = path.read_text(encoding="utf-8")
    named = {path: {*NAMED.findall(text), *map(as_path, MODULE.findall(text))} for path, text in texts.items()}
    assert sum(map(len, named.values())) > 50
    gone = [
        f"{path.relative_to(ROOT)}: {name}"
        for path, names in named.items()
        for name in sorted(names)
        if not (ROOT / name).exists()
    ]
    assert not gone


def as_path(module: str) -> str:
    """The file of a module."""
    return f"{module.replace('.', '/')}.py"


def _numbers(text: str) -> set[str]:
    lines = "\n".join(line for line in text.splitlines() if line.startswith("|"))
    return {number.lstrip("0") for number in re.findall(r"\d*\.\d+", lines)}


def test_intervals_of_shares_stay_within_0_and_1() -> None:
    """From eight on a seeded bootstrap, below that the lowest and highest; a difference may be anything."""
    shares = np.array([1.0] * 7 + [0.3, 0.5, 1.0])
    assert interval(shares, 2) == interval(shares, 2)
    mean, low, high = map(float, re.findall(r"[\d.]+", interval(shares)))
    assert mean == 0.88 and 0.7 < low < mean < high <= 1
    assert interval(shares[:7], 2) == "1.00 (1.00 to 1.00)"
    assert interval(shares[5:9], 2) == "0.70 (0.30 to 1.00)"
    assert interval(shares[:1], 1) == "1.0" and interval(shares[:0]) == "-"
    assert difference(np.array([0.0, 0.5, 1.0]), 2) == "0.50 [-0.74, 1.74]"


def test_unfinished_seeds_do_not_count(tmp_path: Path) -> None:
    """A mean over some of the sub-goals is of no use beside one over all."""
    lines = (RESULTS / "hypotheses-doorkey.csv").read_text(encoding="utf-8").splitlines()
    few = [line for line in lines if not line.startswith("choice,none,go-to-goal,100")]
    (tmp_path / "few.csv").write_text("\n".join(few) + "\n")
    numbers = hypotheses.read(tmp_path / "few.csv", "choice")
    assert ("none", 100) not in {(method, seed) for method, _, seed in numbers}
    assert ("dbat", 100) in {(method, seed) for method, _, seed in numbers}


def test_a_run_goes_on_where_it_stopped(tmp_path: Path) -> None:
    """Cells that are there are not run again, nor are their rows written twice when more steps are wanted."""
    ran: list[tuple[str, int]] = []

    def job(cell: str, last: int) -> list[dict[str, object]]:
        ran.append((cell, last))
        return [{"cell": cell, "step": step, "score": step / 7} for step in range(1, last + 1)]

    path = tmp_path / "cells.csv"

    def run(cells: str, last: int) -> None:
        jobs = {(cell,): lambda cell=cell: job(cell, last) for cell in cells}
        run_cells(path, ("cell", "step", "score"), ("cell",), jobs, lambda _: range(1, last + 1), 1)

    run("a", 2)
    run("ab", 2)
    run("a", 3)
    assert ran == [("a", 2), ("b", 2), ("a", 3)]
    rows = path.read_text(encoding="utf-8").splitlines()
    assert rows == ["cell,step,score", "a,1,0.1429", "a,2,0.2857", "b,1,0.1429", "b,2,0.2857", "a,3,0.4286"]


def test_a_study_keeps_its_data_and_refuses_others(tmp_path: Path) -> None:
    """Begun again, it goes on with the states it has; with other settings it says so."""
    path, config = tmp_path / "data.h5", DOMAIN.config_class(labelled=16, unlabelled=32)
    collect_once(DOMAIN, config, path)
    states = path.read_bytes()
    collect_once(DOMAIN, config, path)
    assert path.read_bytes() == states
    with pytest.raises(UserError, match="unlabelled"):
        collect_once(DOMAIN, config.model_copy(update={"unlabelled": 48}), path)
