"""Experiments as Python functions (Spec G4): named ones, and those of a user."""

import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from command_line import run

from hypogoal.core import own_code
from hypogoal.core.config import describe
from hypogoal.core.errors import UserError
from hypogoal.experiments.cells import Plan
from hypogoal.experiments.experiment import Command, Seeds, experiment, load_experiment
from hypogoal.experiments.planning import make_plan
from hypogoal.stages.sweep import config_class_of, plan

ROOT = Path(__file__).resolve().parents[2]
OUT = Path("somewhere")
MODULE = """
from typing import Annotated

from hypogoal.experiments.experiment import explained


def members(*, sizes: Annotated[tuple[int, ...], explained("members", low=1)] = (1, 3), small: bool = False):
    yield "data", "collect doorkey"
    for size in sizes:
        yield f"ensemble/size-{size}", f"train-ensemble @data --members {size}", {"size": size}
        yield f"agent/size-{size}", f"train-meta --ensemble=@ensemble/size-{size}"
"""


def own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: str, *assignments: str) -> Plan:
    """The plan of ``members`` in a module of this text."""
    name = re.sub(r"\W", "_", tmp_path.name)
    (tmp_path / f"{name}.py").write_text(text)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    own_code.allow([f"{name}:members"])
    return plan(f"{name}:members", OUT, assignments=assignments)


def test_a_generator_of_names_and_commands(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Spec G4: @NAME is the output of the command of that name; its arguments are settings."""
    made = own(tmp_path, monkeypatch, MODULE, "sizes=2-4", "workers=2")
    assert made.experiment == "members" and made.workers == 2
    cells = {cell.name: cell for cell in made.cells}
    assert [*cells] == ["data", *(f"{kind}-size-{size}" for size in (2, 3, 4) for kind in ("ensemble", "agent")),
                        "evaluate", "report"]  # fmt: skip
    ensemble = cells["ensemble-size-3"]
    assert ensemble.text == ("hypogoal train-ensemble somewhere/data.h5 --members 3 --out somewhere/ensemble/size-3")
    assert ensemble.needs == (OUT / "data.h5",) and ensemble.axes == (("size", 3),)
    assert ensemble.cores == 5
    assert cells["agent-size-3"].arguments[1:3] == ("--ensemble", "somewhere/ensemble/size-3")
    assert cells["agent-size-3"].needs == (OUT / "ensemble/size-3",)
    assert {*cells["evaluate"].needs} == {cell.out for cell in made.cells[:-2]}


@pytest.mark.parametrize(
    ("before", "after", "words"),
    [
        ('"collect doorkey"', '"rm -rf x"', "the command must be a stage"),
        ('"collect doorkey"', '"collect \'doorkey"', "cannot be read"),
        ('"collect doorkey"', '"collect doorkey --out /tmp"', "given by the sweep"),
        ('"collect doorkey"', '"collect doorkey @ensemble/size-1"', "would read what no cell before it makes"),
        ('"collect doorkey"', "[3]", r"yields \(name, command\)"),
        ('yield "data"', 'yield "../data"', "name of their own"),
        ('yield "data"', 'yield "logs"', "name of their own"),
        ("ensemble/size-{size}", "ensemble/../{size}", "outside the run"),
        ('f"agent/size-{size}"', 'f"ensemble/size-{size}"', "two cells would be the same"),
        ('f"agent/size-{size}"', 'f"ensemble-size-{size}"', "two cells would be the same"),
        ('{"size": size}', '{"value": size}', "columns must be names"),
        ('{"size": size}', '{"size": []}', "columns must be names"),
        ("small: bool = False", "small: bool", "cannot be a setting"),
        ("small: bool = False", "workers: int = 3", "cannot be a setting"),
        ("small: bool = False", "small: dict = {}", "cannot be a setting"),
        ("members(*,", "members(stage, *,", "Make it keyword-only"),
        ("def members", "members = 3\ndef other", "not an experiment"),
        ('yield "data", "collect', 'yield from [("data", "collect doorkey")] * 30_000; "collect', "more than 20000"),
    ],
)  # fmt: skip
def test_what_is_no_experiment_is_refused_in_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, before: str, after: str, words: str
) -> None:
    """Spec G2: as the user's to mend."""
    assert before in MODULE
    with pytest.raises(UserError, match=words) as caught:
        own(tmp_path, monkeypatch, MODULE.replace(before, after))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("given", ["sizes=0", "sizes=x", "size=1", "small=perhaps", "train-ensemble.steps=3"])
def test_what_its_settings_cannot_be(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, given: str) -> None:
    """Spec G2: types, bounds and names are those of the signature."""
    with pytest.raises(UserError):
        own(tmp_path, monkeypatch, MODULE, given)


def test_a_function_is_the_users_word_only_if_typed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Spec B6, G2: a name on the command line is."""
    (tmp_path / "typed.py").write_text(MODULE)
    monkeypatch.chdir(tmp_path)
    words = ["sweep", "typed:members", "--out", "out", "--set", "sizes=2", "--dry-run"]
    with pytest.raises(UserError, match="a file names code of its own as its experiment"):
        load_experiment("typed:members")
    assert "hypogoal train-ensemble out/data.h5 --members 2 --out out/ensemble/size-2\n" in run(*words).out
    assert "--out runs/members/data.h5\n" in run("run", "typed:members", "--dry-run").out


def test_settings_and_presets_of_a_domain() -> None:
    """Spec G4: with a domain, presets, the device and settings of stages apply to all commands of a stage."""

    @experiment("doorkey", stages=("collect", "train-ensemble"))
    def two(*, seeds: Seeds = (0, 1)) -> Iterator[Command]:
        yield Command("data", "collect doorkey")
        for seed in seeds:
            yield Command(f"ensemble/seed-{seed}", f"train-ensemble @data --seed {seed}")

    given = {"preset": "choosing", "device": "cpu"}
    cells = make_plan(two, OUT, ["seeds=3", "train-ensemble.steps=7"], **given).cells  # type: ignore[arg-type]
    assert cells[1].text == (
        "hypogoal train-ensemble somewhere/data.h5 --preset choosing --set steps=7 --device cpu --seed 3 "
        "--out somewhere/ensemble/seed-3"
    )
    for given_setting, words in (
        ("train-ensemble.seed=3", "Set seeds instead"),
        ("train-meta.steps=3", "no such stage"),
    ):
        with pytest.raises(UserError, match=words):
            make_plan(two, OUT, [given_setting])


def test_settings_of_run_are_the_signatures() -> None:
    """'hypogoal config run' lists types, defaults, bounds and meanings of the arguments."""
    rows = {row["name"]: row for row in describe(config_class_of("run", "montezuma"))}
    assert (rows["groups"]["default"], rows["groups"]["allowed"]) == ((1, 2, 3, 7), "1 .. 7")
    assert rows["methods"]["allowed"] == "dbat|none|cnn" and rows["methods"]["source"] == "Figure 3"
    assert rows["oracle"]["type"] == "bool" and "workers" in rows and "evaluate" in rows


@pytest.mark.parametrize(("name", "count"), [("figure6", 133), ("preference", 139), ("choosing_baselines", 23)])
def test_the_examples_are_experiments(monkeypatch: pytest.MonkeyPatch, name: str, count: int) -> None:
    """The functions in examples/."""
    monkeypatch.chdir(ROOT)
    monkeypatch.syspath_prepend(str(ROOT))
    own_code.allow([f"examples.{name}:{name}"])
    assert len(plan(f"examples.{name}:{name}", OUT).cells) == count
