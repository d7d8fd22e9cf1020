"""Sweeps in TOML (Spec G4): what they can say, and that they can say nothing else."""

import csv
import json
import re
from dataclasses import replace
from pathlib import Path

import pytest

from hypogoal.core.artefacts import create_artefact
from hypogoal.core.errors import UserError
from hypogoal.core.files import path_part
from hypogoal.experiments.cells import Plan
from hypogoal.experiments.planning import make_plan
from hypogoal.experiments.results import write_results
from hypogoal.experiments.toml_file import read_toml

ROOT = Path(__file__).resolve().parents[2]
OUT = Path("somewhere")
GOOD = """
format = 1
axes = { seed = [0, 1], layout = "210-212" }
cells = [
  { name = "data", command = "collect doorkey --seed 3" },
  { name = "ensemble", axes = ["seed"], command = "train-ensemble {data} --seed {seed}" },
  { name = "agent", axes = ["seed", "layout"], command = "train-meta {ensemble} --layout-seed {layout} --seed {seed}" },
]
"""


def planned(tmp_path: Path, text: str, *assignments: str) -> Plan:
    (tmp_path / "own.toml").write_text(text)
    return make_plan(read_toml(tmp_path / "own.toml"), OUT, assignments)


def test_a_command_for_each_point_of_its_axes(tmp_path: Path) -> None:
    """Spec G4: cells are the product of axes; what they read is what cells of the same point wrote."""
    plan = planned(tmp_path, GOOD)
    assert [cell.stage for cell in plan.cells].count("collect") == 1
    agents = [cell for cell in plan.cells if cell.stage == "train-meta"]
    assert len(agents) == 6 and len({cell.out for cell in agents}) == 6
    one = agents[-1]
    assert one.text == (
        "hypogoal train-meta somewhere/ensemble/seed-1 --layout-seed 212 --seed 1 "
        "--out somewhere/agent/seed-1-layout-212"
    )
    assert one.needs == (OUT / "ensemble/seed-1",)
    assert one.axes == (("group", "agent"), ("seed", 1), ("layout", 212))
    assert [cell.name for cell in plan.cells[-2:]] == ["evaluate", "report"]
    assert set(plan.cells[-2].needs) == {cell.out for cell in plan.cells[:-2]}


def test_axes_from_the_command_line(tmp_path: Path) -> None:
    """--seeds 0-4 and --set layout=1,5 take the place of the file's values."""
    plan = planned(tmp_path, GOOD, "seed=0-4", "layout=1,5", "evaluate=false", "workers=3")
    assert sum(cell.stage == "train-meta" for cell in plan.cells) == 10
    assert plan.workers == 3 and plan.cells[-1].stage == "train-meta"


@pytest.mark.parametrize(
    ("more", "cores"),
    [("", 5), ("--set workers=2", 2), ("--set workers=9", 5), ("--set sub_goals=open-red-door,take-red-key", 2)],
)
def test_ensembles_get_a_process_for_each_sub_goal(tmp_path: Path, more: str, cores: int) -> None:
    """Spec G4: as many processors are asked for as it can use."""
    plan = planned(tmp_path, GOOD.replace("train-ensemble {data}", f"train-ensemble {{data}} {more}"))
    found = {cell.stage: cell.cores for cell in plan.cells}
    assert (found["train-ensemble"], found["train-meta"]) == (cores, 1)


def test_values_may_have_a_dot(tmp_path: Path) -> None:
    """Spec G4: 0.1 and 0.2 are two cells, and of data only ``.h5`` is no part of the name."""
    text = GOOD.replace("[0, 1]", "[0.1, 0.2]").replace("doorkey --seed 3", "doorkey").replace('"210-212"', "[1.5]")
    names = [cell.name for cell in planned(tmp_path, text).cells]
    assert names[:4] == ["data", "ensemble-seed-0.1", "ensemble-seed-0.2", "agent-seed-0.1-layout-1.5"]


def test_the_example_is_one() -> None:
    """The file in examples/ is an experiment."""
    plan = make_plan(read_toml(ROOT / "examples" / "sweep-doorkey.toml"), OUT)
    assert len(plan.cells) == 1 + 4 + 8 + 4 + 2


@pytest.mark.parametrize(
    ("before", "after"),
    [
        ("format = 1", "format = 1\ndomain = 'doorkey'"),
        ("format = 1", "format = 1\nsettings.seeds.value = [0]"),
        ("format = 1", "format = 1\npairs = { paired = ['seed', 'layout'] }"),
        ('axes = ["seed"],', "for = ['seed'],"),
        ('axes = ["seed"],', "minutes = 2,"),
        ('axes = ["seed"]', 'axes = { seed = "seed" }'),
    ],
)
def test_the_language_of_before_is_refused_with_what_to_do(tmp_path: Path, before: str, after: str) -> None:
    """Spec G2: what experiments in TOML could say once."""
    with pytest.raises(UserError, match=r"in an experiment.* or write a Python function"):
        planned(tmp_path, GOOD.replace(before, after))


@pytest.mark.parametrize(
    ("before", "after", "words"),
    [
        ("format = 1", "format = 2", "format must be 1"),
        ("format = 1", "format = 1\nsubmit = 'rm'", "no such key"),
        ('axes = ["seed"],', "axis = ['seed'],", "no such key"),
        ('axes = ["seed"],', "axes = true,", "wrong kind"),
        ("train-meta {", "rm -rf {", "must be a stage"),
        ("train-meta {", "train-meta --out /tmp/x {", "given by the sweep"),
        ("train-meta {", "train-meta --force {", "given by the sweep"),
        ("[0, 1]", "['--force']", "given by the sweep"),
        ("{ensemble}", "{ensembles}", "neither an axis"),
        ('axes = ["seed"], command', "command", "neither an axis"),
        ('axes = ["seed", "layout"]', 'axes = ["layout"]', "neither an axis"),
        ('axes = ["seed"]', 'axes = ["sed"]', "an axis that does not exist"),
        ("[0, 1]", "[0, 0]", "values that differ"),
        ("[0, 1]", "['../x']", "parts of names"),
        ("[0, 1]", "[]", "values that differ"),
        ('"210-212"', '"212-210"', "not integers"),
        ('"210-212"', '"0-99999"', "not integers"),
        ("layout =", "value =", "cannot have this name"),
        ('name = "agent"', 'name = "data"', "name of their own"),
        ('name = "agent"', 'name = "../agent"', "name of their own"),
        ('name = "agent"', 'name = "logs"', "name of their own"),
        ("cells = [", 'cells = [{ name = "ensemble-seed-0", command = "collect doorkey" },', "would be the same"),
        ("collect doorkey", "collect 'doorkey", "cannot be read"),
        ("cells = [", "cells = [ [", "not valid TOML"),
    ],
)
def test_what_is_no_experiment_is_told_in_one_line(tmp_path: Path, before: str, after: str, words: str) -> None:
    """Spec G2: a stranger's file is data: stages only, into the sweep's folder only, no code that it names."""
    assert before in GOOD
    with pytest.raises(UserError, match=words):
        planned(tmp_path, GOOD.replace(before, after))


@pytest.mark.parametrize("given", ["seeds=1", "seed=", "seed=x", "workers=many", "evaluate=perhaps"])
def test_what_the_command_line_cannot_say(tmp_path: Path, given: str) -> None:
    """Spec G2: in one line."""
    with pytest.raises(UserError):
        planned(tmp_path, GOOD, given)


FORMULAS = [
    "=1+1", "+1+1", "-1+1", "@SUM(A1)", " =1+1", "'=1+1", "=HYPERLINK('http:x')", "=cmd|' C'!A0", "-2+3+cmd|' C'!A0",
    "@A1", "==1", "=-1", "a;=1+1", "a,=1+1", 'a"=1+1', "a; =1+1", "a,+1", "a;-A1", "a;@A1", "=A1,=A2", "＝1+1", "＋A1",
    "－A1", "＠A1", "\t=1+1", "\r=1+1", "\n=1+1", "a\n=1+1", "a\t=1+1", "=", "-", "+", "@", "=\u2028", "=🙂", "%0A=1",
]  # fmt: skip
NUMBERS = ["-1", "+2.5", "-1e-3", "7", "0.5"]
BEGINS = re.compile(r"(^|[,;\t\r\n\"])\s*[=+@＝＋－＠-]")


def test_no_cell_is_a_formula(tmp_path: Path) -> None:
    """Spec G2, G4: texts of an experiment and of what its cells wrote; numbers are left as they are."""
    fit = [text for text in FORMULAS if path_part(text)]
    assert len(fit) > 20
    toml = f"""format = 1
evaluate = false
axes = {{ text = {json.dumps(fit + NUMBERS, ensure_ascii=False)} }}
cells = [{{ name = "ensemble", axes = ["text"], command = "train-ensemble d.h5" }}]"""
    plan = planned(tmp_path, toml)
    for cell in plan.cells:
        with create_artefact(tmp_path / cell.out, kind="ensemble", config={}, seed=0) as folder:
            lines = [json.dumps({"sub_goal": text, text: 2.5, "loss": -0.5}) for text in FORMULAS]
            (folder / "metrics.jsonl").write_text("\n".join(lines) + "\n")
    moved = replace(plan, cells=[replace(cell, out=tmp_path / cell.out) for cell in plan.cells])
    path = write_results(moved, tmp_path)
    with path.open(newline="", encoding="utf-8") as file:
        header, *rows = csv.reader(file)
    cells = {cell for row in rows for cell in row}
    assert {cell for cell in cells if BEGINS.search(cell)} == {"-0.5", "-1", "+2.5", "-1e-3"}
    assert len(rows) == len(plan.cells) * len(FORMULAS) * 2
    assert {"-0.5", "2.5", *NUMBERS} <= cells, "numbers are numbers"
    assert {cell.replace("'", "") for cell in cells} >= {text.replace("'", "") for text in fit}, (
        "nothing else is changed"
    )
    assert header[:4] == ["cell", "stage", "group", "text"]


def test_nothing_can_be_named_like_a_formula(tmp_path: Path) -> None:
    """Spec G2: groups of cells and their axes, which are columns."""
    for text in FORMULAS:
        for toml in (
            GOOD.replace('"agent"', json.dumps(text, ensure_ascii=False)),
            GOOD.replace("seed =", f"{json.dumps(text, ensure_ascii=False)} ="),
        ):
            with pytest.raises(UserError):
                planned(tmp_path, toml)
