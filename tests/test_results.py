"""Published tables are drawn from the committed cells (Spec F5, H7)."""

import ast
import importlib
import re
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from hypogoal.cli import main
from hypogoal.core.errors import UserError
from hypogoal.domains.doorkey.domain import DOMAIN, DoorKeyConfig
from studies import choosing, figure6, hypotheses, ladder_options, pages
from studies.cells import collect_once, difference, interval, read_rows, run_cells

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


def test_history_is_short_and_each_row_whole() -> None:
    """A question, what ran, its effect, how many, and the commit where that is not the last with the code."""
    text = (RESULTS / "history.md").read_text(encoding="utf-8")
    rows = [line.strip("|").split("|") for line in text.splitlines() if line.startswith("| ")]
    assert len(text.split()) <= 900 and len(rows) > 30
    for row in rows:
        *cells, commit = (cell.strip() for cell in row)
        assert len(cells) == 4 and all(cells)
        assert re.fullmatch("commit|[0-9a-f]{7,8}|", commit)


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
    """By a setting's source, by code, by the docs and by what tests say they do."""
    texts = {path: path.read_text(encoding="utf-8") for path in [ROOT / "README.md", *(ROOT / "docs").rglob("*.md")]}
    for folder in ("hypogoal", "studies", "examples", "benchmarks"):
        for path in (ROOT / folder).rglob("*"):
            if path.suffix in (".py", ".toml", ".json", ".html"):
                texts[path] = path.read_text(encoding="utf-8")
    for path in (ROOT / "tests").rglob("*.py"):
        texts[path] = "\n".join(docstrings(path))
    named = {path: {*NAMED.findall(text), *map(as_path, MODULE.findall(text))} for path, text in texts.items()}
    assert sum(map(len, named.values())) > 50
    gone = [
        f"{path.relative_to(ROOT)}: {name}"
        for path, names in named.items()
        for name in sorted(names)
        if not (ROOT / name).exists()
    ]
    assert not gone


def docstrings(path: Path) -> Iterator[str]:
    """Those of a module, its classes and its functions."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef):
            yield ast.get_docstring(node) or ""


def as_path(module: str) -> str:
    """The file of a module."""
    return f"{module.replace('.', '/')}.py"


def _numbers(text: str) -> set[str]:
    lines = "\n".join(line for line in text.splitlines() if line.startswith("|"))
    return {number.lstrip("0") for number in re.findall(r"\d*\.\d+", lines)}


def test_learned_options_stand_beside_planned_ones(tmp_path: Path) -> None:
    """Rows of both, and how long the learned ones were practised; of planned ones alone nobody says so."""
    rows = ["method,policy,layout,seed,chooser,quantity,value", "ppo,,1,0,agent,success,0"]
    for policy, solved in (("planned", 1), ("learned", 0.5)):
        rows += [f"dbat,{policy},{layout},0,agent,success,{solved}" for layout in (1, 2)]
        rows += [f"dbat,{policy},{layout},0,uniform,success,0.25" for layout in (1, 2)]
    for layout, steps, until in ((1, 120016, 1), (2, 400000, 0)):
        rows += [f"dbat,learned,{layout},0,agent,practice,{steps}", f"dbat,learned,{layout},0,agent,practised,{until}"]
    (tmp_path / "both.csv").write_text("\n".join(rows) + "\n")
    lines = list(choosing.tables(tmp_path / "both.csv"))
    assert "| D-BAT, K = 6, learned options | 0.50 / 0.25 | 0.50 / 0.25 |" in lines
    assert "| D-BAT, K = 6, planned options | 1.00 / 0.25 | 1.00 / 0.25 |" in lines
    assert lines.count("| D-BAT, K = 6, learned options | 120 | 400 (limit) |") == 1
    (tmp_path / "one.csv").write_text("\n".join(row for row in rows if ",learned," not in row) + "\n")
    assert not any("options" in line.split("|")[1] for line in choosing.tables(tmp_path / "one.csv") if "|" in line)


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


def test_a_bootstrap_of_ten_holds_in_nine_of_ten_cases() -> None:
    """Of shares drawn from a known mean, as skewed as those of the pages."""
    rng = np.random.default_rng(1)
    held = 0
    for _ in range(300):
        low, high = map(float, re.findall(r"[\d.]+", interval(rng.beta(2, 1, 10), 4))[1:])
        held += low <= 2 / 3 <= high
    assert held / 300 >= 0.85


def test_agents_of_figure_6_are_told_apart() -> None:
    """By the folders of ``examples/figure6.py``, where the ensemble's name is in those of other agents, too."""
    place = "method-dbat-k3-layout-300-seed-3000"
    assert figure6.method_of({}, place) == "dbat-k3"
    assert figure6.method_of({"termination": "oracle"}, place) == "oracle"
    assert figure6.method_of({"network": "paper"}, "meta") == "literal"
    assert figure6.method_of({}, "agent-dqn-paper-layout-300-seed-3000") == "dqn-paper"


def test_members_one_after_the_other_stay_by_their_rule() -> None:
    """The row of the history is that of its cells, and they fail the rule by which ``sequential`` would have gone."""
    solved: dict[str, list[float]] = {"simultaneous": [], "sequential": []}
    for row in read_rows(RESULTS / "rooms-schedules.csv"):
        if row["chooser"] == "agent":
            solved[row["schedule"]].append(float(row["success"]))
    differences = np.subtract(solved["simultaneous"], solved["sequential"])
    printed = difference(differences, 2).replace("0.", ".")
    assert f"| {printed} | 10 |" in (RESULTS / "history.md").read_text(encoding="utf-8")
    assert len(differences) == 10 and differences.mean() < -0.03


def test_switches_of_montezuma_s_options_stay_by_their_rule() -> None:
    """The row of the history is that of its cells; on one ladder each is worth a tenth of the executions or more."""
    rows = [row for row in read_rows(RESULTS / "montezuma-steps.csv") if row["ladder"] == "3-9"]
    printed = []
    for column, better in (("n_step", "10"), ("exploration", "persistent")):
        differences = []
        for seed in ("0", "1", "2"):
            of_seed = [row for row in rows if row["seed"] == seed]
            with_it = [int(row["at_base"]) / 100 for row in of_seed if row[column] == better]
            without = [int(row["at_base"]) / 100 for row in of_seed if row[column] != better]
            assert len(with_it) == len(without) == 2
            differences.append(np.mean(with_it) - np.mean(without))
        assert np.mean(differences) >= 0.1
        printed.append(interval(np.array(differences), 3).replace("0.", "."))
    assert f"| {'; '.join(printed)} | 3 |" in (RESULTS / "history.md").read_text(encoding="utf-8")


def test_figure_6_holds_without_what_went() -> None:
    """The row of the history is that of its cells: all layouts reach 95 %, in the median not 1.3 times as late."""
    rows = read_rows(RESULTS / "figure6-again.csv")
    assert [row["layout"] for row in rows] == [str(layout) for layout in range(300, 310)]
    now, before = (np.median([int(row[name]) for row in rows]) for name in ("steps_to_95", "steps_to_95_before"))
    assert now <= 1.3 * before
    assert f"| ten of ten; {now:,.0f}, {before:,.0f} |" in (RESULTS / "history.md").read_text(encoding="utf-8")


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


def test_leads_on_ladders_are_means_over_seeds_of_what_has_no_labels() -> None:
    """Ladders of the labelled group do not count, nor does one without a peer."""
    far, near = np.array([9.0, 5.0]), np.array([1.0, 3.0])
    pairs = {("none", ladder): {10: far, 11: far + 2} for ladder in ("1L", "3-9", "14-22", "0-4")}
    pairs |= {("dbat", ladder): {10: near, 11: near} for ladder in ("1L", "3-9", "14-22")}
    pairs["none", "14-22"] = {10: far + 2, 11: far + 4}
    best, mean = ladder_options._leads(1, {"": pairs})
    assert best == "no diversity minus D-BAT, best member: 6 [-7, 19], 2 ladders"  # 5 and 7
    assert mean == "no diversity minus D-BAT, mean member: 7 [-6, 20], 2 ladders"  # 6 and 8; t(1) = 12.7


def test_a_study_keeps_its_data_and_refuses_others(tmp_path: Path) -> None:
    """Begun again, it goes on with the states it has; with other settings it says so."""
    path, config = tmp_path / "data.h5", DoorKeyConfig(heldout_layouts=1)
    collect_once(DOMAIN, config, path)
    states = path.read_bytes()
    collect_once(DOMAIN, config, path)
    assert path.read_bytes() == states
    with pytest.raises(UserError, match="heldout_layouts"):
        collect_once(DOMAIN, config.model_copy(update={"heldout_layouts": 2}), path)
