"""Published tables are drawn from the committed cells (Spec F5, H7)."""

import importlib
import os
import re
import shutil
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import binomtest

from hypogoal.cli import main
from hypogoal.core.errors import UserError
from hypogoal.domains.rooms.domain import DOMAIN
from hypogoal.evaluation import statistics
from hypogoal.evaluation.statistics import bounded, median_bounds
from studies import cells, coverage, hypotheses, pages, recompute, two_factors
from studies.cells import (
    amount,
    bootstrap_t,
    collect_once,
    interval,
    run_cells,
    share,
    won,
)

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


def test_each_claim_names_a_command_that_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """An experiment lists what it would do (``--dry-run``), a study prints its tables, as the command stands there."""
    monkeypatch.chdir(ROOT)
    page = (RESULTS / "index.md").read_text(encoding="utf-8")
    papers, _, beyond = page.partition("## How intervals")[0].partition("### Beyond the paper")
    commands = [re.findall(r"^\|.*\| `([^`]+)` \|$", claims, re.MULTILINE) for claims in (papers, beyond)]
    assert [len(each) for each in commands] == [13, 6]
    for command in {*commands[0], *commands[1]}:
        runner, *words = command.split()
        if runner == "hypogoal":
            assert main([*words, "--dry-run", "--out", str(tmp_path / "out")]) == 0, command
        else:
            study = importlib.import_module(words[1])
            monkeypatch.setattr(sys, "argv", words[1:])
            study.main()
            assert "|---|" in capsys.readouterr().out, command
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


def test_intervals_by_hand() -> None:
    """Gaffke's of zeros and ones is Clopper and Pearson's, the median's ends are values; of too few the range."""
    shares = np.array([1.0] * 7 + [0.3, 0.5, 1.0])
    assert share(shares) == share(shares)
    mean, low, high = map(float, re.findall(r"[\d.]+", share(shares)))
    assert mean == 0.88 and 0.5 < low < mean < high <= 1
    for wins in (0, 3, 10):
        exact = binomtest(wins, 10).proportion_ci(0.95, "exact")
        assert bounded(np.repeat([1.0, 0.0], [wins, 10 - wins])) == pytest.approx(exact, abs=0.01)
    assert (
        amount(np.arange(10.0), 1) == "4.5 [1.0, 8.0]" and amount(np.array([1.0, 2, np.inf]), 0) == "never (1 to never)"
    )
    assert amount(np.arange(5.0), 0) == "2 (0 to 4)" and interval(np.array([0.0, 0.5, 1.0]), 1) == "0.5 (0.0 to 1.0)"
    assert (
        interval(shares[:1], 1) == "1.0" and interval(shares[:0]) == "-" and interval(shares[:7], 1) == "1.0 [1.0, 1.0]"
    )
    assert won(np.array([1.0, 0, -1, 2, 2, 2, 2, 2])) == "6 of 8, p = 0.125"


def held_by(
    bounds: Callable[[np.ndarray], tuple[float, float]], kind: str, shape: str, n: int, of: str = "mean"
) -> float:
    """How often of 300 cases an interval holds the mean of a shape, or its median."""
    truth = coverage.truth_of(coverage.SHAPES[kind][shape], of)
    drawn = coverage.SHAPES[kind][shape](np.random.default_rng(7), (300, n))
    ends = np.array([bounds(values) for values in drawn])
    return float(((ends[:, 0] - 1e-6 <= truth) & (truth <= ends[:, 1] + 1e-6)).mean())


@pytest.mark.parametrize(
    ("written", "kind", "shape", "n", "of"),
    [
        (interval, "score", "near 1", 10, "mean"),
        (interval, "pair of scores", "near 1, from spread", 5, "mean"),
        (share, "solved", "one in ten fails", 10, "mean"),
        (share, "solved", "one in five fails", 3, "mean"),
        (amount, "pair of shares", "alike but for one in seven", 10, "median"),
        (amount, "amount", "very skewed", 6, "median"),
    ],
)
def test_intervals_hold_as_often_as_they_say(
    written: Callable[[np.ndarray, int], str],
    kind: str,
    shape: str,
    n: int,
    of: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """As tables write them, each on a shape that is hard for it: 93 of 100, less three standard errors of 300 cases."""
    monkeypatch.setattr(cells, "RESAMPLES", 1_000)

    def bounds(values: np.ndarray) -> tuple[float, float]:
        low, high = written(values, 6).rpartition("[")[2].rstrip("]").split(", ")
        return float(low), float(high)

    assert held_by(bounds, kind, shape, n, of) > 0.93 - 3 * 0.015


def test_a_percentile_bootstrap_would_not_hold() -> None:
    """What tables had before: of ten seeds of which one in ten fails it misses the mean in a third of the cases."""

    def percentile(values: np.ndarray) -> tuple[float, float]:
        low, high = coverage.percentile(values[None])
        return low[0], high[0]

    assert held_by(percentile, "solved", "one in ten fails", 10) < 0.8


def test_intervals_over_seeds_and_ladders_are_bounds_of_both_factors(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where values are plain they hold, where a fifth of the ladders is far off they do not: so no page shows one."""
    monkeypatch.setattr(two_factors, "EXPERIMENTS", 300)
    monkeypatch.setattr(two_factors, "RESAMPLES", 300)
    for shape, holds in (("both differ", True), ("a fifth of ladders far off", False)):
        values = two_factors.drawn(shape, np.random.default_rng(7), 10)
        for method in two_factors.METHODS.values():
            low, high = method(values)
            coverage_of_it = np.mean((low <= 0) & (high >= 0))
            assert (coverage_of_it > 0.88) == holds
    rows = cells.read_rows(RESULTS / "two-factors.csv")
    assert [two_factors.admitted_from(rows, method) for method in two_factors.METHODS] == [None, None]


def test_tables_show_the_intervals_that_were_chosen() -> None:
    """By the rule, from the committed cells of the simulation, each from its least n on."""
    rows = cells.read_rows(RESULTS / "coverage.csv")
    chosen = {kind: coverage.chosen(rows, kind) for kind in coverage.SHAPES}
    assert chosen["score"] == chosen["pair of scores"] == ("bootstrap-t", cells.SCORES_FROM)
    assert chosen["solved"] == ("bounded", statistics.SHARES_FROM)
    assert chosen["pair of shares"] == chosen["amount"] == ("median", statistics.MEDIANS_FROM)
    values = np.random.default_rng(0).uniform(0.4, 0.9, 10)
    for simulated, shown in ((coverage.bootstrap_t, bootstrap_t), (coverage.bounded, bounded)):
        assert np.ravel(simulated(values[None])) == pytest.approx(shown(values), abs=0.02)
    assert np.ravel(coverage.median(values[None])).tolist() == list(median_bounds(values))


def test_a_wrong_number_is_found(tmp_path: Path) -> None:
    """None is off as published; of a page, README's table and its picture one is, two, and one that is missing."""
    (tmp_path / "docs/results").mkdir(parents=True)
    for name in ("README.md", "docs/results.png", *(f"docs/results/{page}" for page in os.listdir(RESULTS))):
        if name.endswith((".md", ".png")):
            shutil.copy(ROOT / name, tmp_path / name)
    assert not [*recompute.differences(tmp_path)]
    for name, was, now in (
        ("docs/results/rooms.md", "members solve .91", "members solve .93"),
        ("docs/results/agents.md", "takes 5.23 [1.84", "takes 8.76 [1.84"),
        ("docs/results/index.md", "**.31 [.17, .37]**", ".31 [.17, .37]"),
        ("README.md", "| .30 [.18", "| .28 [.18"),
    ):
        text = (ROOT / name).read_text(encoding="utf-8")
        assert text.count(was) == 1, name
        (tmp_path / name).write_text(text.replace(was, now), encoding="utf-8")
    lines = [*recompute.differences(tmp_path)]
    assert {line.partition(":")[0] for line in lines} >= {
        "rooms, both-dbat",
        "agents, later",
        "index",
        "README, one-shape",
    }


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
