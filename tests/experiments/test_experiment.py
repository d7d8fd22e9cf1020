"""Experiments (Spec A6, G4): their cells, as Python functions, TOML files, and those that come with hypogoal."""

import re
from itertools import pairwise
from pathlib import Path

import pytest
from command_line import refuses, run

from hypogoal.cells import Cell
from hypogoal.core import own_code
from hypogoal.core.errors import UserError
from hypogoal.experiments.plan import plan

ROOT = Path(__file__).resolve().parents[2]
OUT = Path("somewhere")
MODULE = """
from hypogoal.core.config import setting


def members(*, sizes: tuple[int, ...] = setting((1, 3), "members", low=1), small: bool = False):
    yield "data", "collect doorkey"
    for size in sizes:
        yield f"ensemble/size-{size}", f"train-ensemble @data --members {size}", {"size": size}
        yield f"agent/size-{size}", f"train-baseline doorkey --data=@data --seed {size}"
"""
TOML = """
format = 1
axes = { seed = [0, 1], layout = "210-212" }
cells = [
  { name = "data", command = "collect doorkey --seed 3" },
  { name = "ensemble", axes = ["seed"], command = "train-ensemble {data} --seed {seed}" },
  { name = "agent", axes = ["seed", "layout"], command = "train-meta {ensemble} --layout-seed {layout} --seed {seed}" },
]
"""


def cells_of(name: str, *assignments: str, **given: str) -> list[Cell]:
    return plan(name, OUT, assignments=assignments, **given)[0]  # type: ignore[arg-type]


def own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: str, *assignments: str) -> list[Cell]:
    """The cells of ``members`` in a module of this text."""
    name = re.sub(r"\W", "_", tmp_path.name)
    (tmp_path / f"{name}.py").write_text(text)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    own_code.allow([f"{name}:members"])
    return cells_of(f"{name}:members", *assignments)


def of_toml(tmp_path: Path, text: str, *assignments: str) -> list[Cell]:
    (tmp_path / "own.toml").write_text(text)
    return cells_of(str(tmp_path / "own.toml"), *assignments)


def test_a_generator_of_names_and_commands(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Spec G4: @NAME is the output of the command of that name; its arguments are settings."""
    made = own(tmp_path, monkeypatch, MODULE, "sizes=2-4")
    cells = {cell.name: cell for cell in made}
    kinds = [f"{kind}/size-{size}" for size in (2, 3, 4) for kind in ("ensemble", "agent")]
    assert [*cells] == ["data", *kinds, "evaluation", "report"]
    ensemble = cells["ensemble/size-3"]
    words = "train-ensemble somewhere/data.h5 --members 3 --out somewhere/ensemble/size-3"
    assert ensemble.command == words.split()
    assert ensemble.needs == ["data.h5"] and ensemble.columns == {"size": 3}
    assert "--data=somewhere/data.h5" in cells["agent/size-3"].command
    assert cells["evaluation"].command == ["evaluate", "somewhere", "--out", "somewhere/evaluation"]
    assert cells["evaluation"].needs == ["data.h5", *kinds] and cells["report"].needs == ["evaluation"]


def test_a_command_for_each_point_of_its_axes(tmp_path: Path) -> None:
    """Spec G4: cells are the product of axes; what they read is what cells of the same point made."""
    cells = of_toml(tmp_path, TOML)
    agents = [cell for cell in cells if cell.stage == "train-meta"]
    assert len(agents) == 6 and [cell.stage for cell in cells].count("collect") == 1
    words = "train-meta somewhere/ensemble/seed-1 --layout-seed 212 --seed 1 --out somewhere/agent/seed-1-layout-212"
    assert agents[-1].command == words.split() and agents[-1].needs == ["ensemble/seed-1"]
    assert agents[-1].columns == {"group": "agent", "seed": 1, "layout": 212}
    ten = of_toml(tmp_path, TOML, "seed=0-4", "layout=1,5", "evaluate=false")
    assert sum(cell.stage == "train-meta" for cell in ten) == 10 and ten[-1].stage == "train-meta"
    assert len(cells_of(str(ROOT / "examples" / "sweep-doorkey.toml"))) == 1 + 4 + 8 + 4 + 2


def test_an_axis_may_mix_integers_and_fractions(tmp_path: Path) -> None:
    """The order of its values does not matter."""
    command = "train-ensemble data.h5 --set learning_rate={rate}"
    for axis in ("[1, 0.5]", "[0.5, 1]"):
        row = f'name = "ensemble"\naxes = ["rate"]\ncommand = "{command}"'
        text = f"format = 1\n[axes]\nrate = {axis}\n[[cells]]\n{row}"
        cells = of_toml(tmp_path, text, "evaluate=false")
        assert {cell.name for cell in cells} == {"ensemble/rate-0.5", "ensemble/rate-1.0"}


NO_FUNCTION = [
    ('"collect doorkey"', '"rm -rf x"', "this is no stage"),
    ('"collect doorkey"', '"import x.npz"', "a cell must be able to go on after a break"),
    ('"collect doorkey"', '"collect \'doorkey"', "this is no command"),
    ('"collect doorkey"', '"collect doorkey @ensemble/size-1"', "reads what no cell before it makes"),
    ('"data", "collect doorkey"', "[3]", r"yields \(name, command\)"),
    ('"collect doorkey"', "3", r"yields \(name, command\)"),
    ('yield "data"', 'yield "../data"', "should match pattern"),
    ('f"agent/size-{size}"', 'f"ensemble/size-{size}"', "a name of its own"),
    ("--members {size}", "--members {size} --set stepps=3", "(?s)train-ensemble has no setting.*ensemble/size-1"),
    ("--members {size}", "--members {size} --steps 0", "(?s)steps.*ensemble/size-1"),
    ("--members {size}", "--diversity bogus", "(?s)unknown diversity objective.*ensemble/size-1"),
    ("--members {size}", "--set network=bogus", "(?s)unknown network.*ensemble/size-1"),
    ("--members {size}", "--set threshold=bogus", "(?s)unknown threshold.*ensemble/size-1"),
    ("--members {size}", "--set view=members:bogus", "(?s)the view cannot be loaded.*ensemble/size-1"),
    ("small: bool = False", "small: bool", "Field required"),
    ("def members", "members = 3\ndef other", "not an experiment"),
]
NO_TOML = [
    ("format = 1", "format = 2", "format: "),
    ("format = 1", "format = 1\nsubmit = 'rm'", "submit: "),
    ('axes = ["seed"],', "axis = ['seed'],", "axis: "),
    ("{ensemble}", "{ensembles}", "cannot be read"),
    ('axes = ["seed"], command', "command", "cannot be read"),
    ("[0, 1]", "[0, 0]", "a name of its own"),
    ("[0, 1]", '"1-"', "seed"),
    ("cells = [", "cells = [ [", "cannot be read"),
    ("collect doorkey --seed", "collect evil:DOMAIN --seed", "a file names code of its own"),
]


@pytest.mark.parametrize(("before", "after", "words"), NO_FUNCTION + NO_TOML)
def test_what_is_no_experiment_is_refused_in_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, before: str, after: str, words: str
) -> None:
    """Spec G2: as the user's to mend, before the first cell starts; stages only, into the run's folder only."""
    function, toml = MODULE.replace(before, after), TOML.replace(before, after)
    with pytest.raises(UserError, match=words) as caught:
        own(tmp_path, monkeypatch, function) if function != MODULE else of_toml(tmp_path, toml)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("given", ["seeds=1", "seed=x", "workers=many", "train-ensemble.stepz=3", "bake.steps=3"])
def test_what_its_settings_cannot_be(tmp_path: Path, given: str) -> None:
    """Spec G2: types, bounds and names are those of the axes, of the signature and of the stages."""
    with pytest.raises(UserError):
        of_toml(tmp_path, TOML, given)


def test_what_is_given_to_all_commands(tmp_path: Path) -> None:
    """Where a command does not say otherwise: device and preset of stages that have them, settings by stage."""
    path = tmp_path / "own.toml"
    path.write_text(TOML.replace("--layout-seed {layout}", "--layout-seed {layout} --steps 9 --device cpu"))
    given = ["train-ensemble.steps=3", "evaluate=false"]
    data, ensemble, *_, agent = cells_of(str(path), *given, device="cuda", preset="paper")
    assert data.words[-2:] == ["--preset", "paper"]
    assert ensemble.words[-6:] == ["--preset", "paper", "--device", "cuda", "--set", "steps=3"]
    assert agent.words[-2:] == ["--preset", "paper"]


def test_a_function_is_the_users_word_only_if_typed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Spec B6: a name on the command line is; the folder is called after the function."""
    (tmp_path / "typed.py").write_text(MODULE)
    monkeypatch.chdir(tmp_path)
    words = "hypogoal train-ensemble runs/members/data.h5 --members 2 --out runs/members/ensemble/size-2\n"
    assert words in run("run", "typed:members", "--set", "sizes=2", "--dry-run").out
    assert not (tmp_path / "runs").exists()


@pytest.mark.parametrize(
    ("experiment", "changes"),
    [
        ("doorkey", ["layout_seeds=100,101", "seeds=0,1"]),
        ("doorkey", ["pretrain=false"]),
        ("choosing", []),
        ("rooms", []),
        ("montezuma-ladders", ["ladders=1L,2-6", "seeds=0,1"]),
    ],
)
def test_cells_need_only_what_cells_before_them_make(experiment: str, changes: list[str]) -> None:
    """Spec A6: an order in which they can run; evaluate waits for all; columns tell all cells of a stage apart."""
    *others, evaluation, _ = cells_of(experiment, *changes)
    made: set[str] = set()
    for cell in others:
        assert {*cell.needs} <= made
        made.add(cell.place)
    assert {*evaluation.needs} == made and len(made) == len(others)
    trained = [(cell.stage, *cell.columns.items()) for cell in others if cell.stage.startswith("train")]
    assert len({*trained}) == len(trained) or experiment == "choosing"


def test_a_single_agent_has_short_names() -> None:
    """Contract: runs/demo/ensemble, runs/demo/options, runs/demo/meta."""
    cells = [cell.place for cell in cells_of("doorkey", preset="demo")]
    assert cells == ["data.h5", "ensemble", "options", "meta", "ppo-tuned", "evaluation", "report"]
    assert "meta/layout-101-seed-1" in [cell.name for cell in cells_of("doorkey", preset="demo", seeds="0-1")]


def settings(cell: Cell) -> dict[str, str]:
    """What a cell's ``--set`` say: of two for one setting the last."""
    return dict(word.split("=", 1) for before, word in pairwise(cell.words) if before == "--set")


def test_what_all_cells_are_given_undoes_no_method() -> None:
    """Spec F1: the single CNN has one member, whatever --set train-ensemble.KEY says."""
    common = [f"train-ensemble.{pair}" for pair in ("members=3", "diversity=none", "batch_size=8")]
    changes = ["groups=1", "ladders=1L", "option_groups=1"]
    cells = cells_of("montezuma-ladders", *changes, *common, "train-options.termination=learned")
    for cell in cells:
        has = settings(cell)
        if cell.stage == "train-ensemble":
            assert has["diversity"] == ("dbat" if cell.columns["method"] == "dbat" else "none")
            assert has["members"] == ("1" if cell.columns["method"] == "cnn" else "3")
            assert has["batch_size"] == "8"
    options = [settings(cell) for cell in cells if cell.stage == "train-options"]
    assert {has["start"] for has in options} == {"1L"}
    assert [has["termination"] for has in options].count("oracle") == 1


def test_a_setting_that_no_command_would_take_is_refused() -> None:
    """In rooms every agent has its steps and every ensemble its members; a setting that some take is no fault."""
    for assignment in ("train-meta.steps=5000", "train-ensemble.members=7"):
        with pytest.raises(UserError, match="has a value of its own"):
            cells_of("rooms", assignment)
    cells_of("rooms", "train-meta.steps=1000")
    cells_of("figure6", "train-ensemble.diversity_weight=1")


def test_controls_and_baselines_keep_the_agents_budget() -> None:
    """Spec E6, E7: as many steps as options and agent together, also where those were changed for all cells."""
    changes = ["train-meta.steps=5000", "train-options.steps=3000", "train-meta.chooser=ppo", "controls=random,oracle"]
    changes += ["train-baseline.steps=7", "train-baseline.setting=tuned"]
    for cell in cells_of("doorkey", *changes, preset="demo"):
        agent, has = cell.columns.get("agent"), settings(cell)
        if cell.stage in ("train-meta", "train-baseline"):
            assert has["steps"] == ("5000" if agent == "meta" else "8000")
        if cell.stage == "train-meta":
            assert has["chooser"] == ("random" if agent == "meta-random" else "ppo")
    for cell in cells_of("doorkey", "train-meta.layout_seed=3", "train-baseline.agent=dqn"):
        assert not {"layout_seed", "agent"} & {*settings(cell)}, "its own options say otherwise"
    with pytest.raises(UserError, match="no such stage"):
        cells_of("montezuma-ladders", "train-meta.steps=3")
    with pytest.raises(UserError, match="no cell before it makes"):
        cells_of("montezuma-ladders", "option_groups=4", "groups=1", "ladders=1L")


def test_the_papers_figures_are_experiments() -> None:
    """Spec E4, F1, F3, F5: each with its preset; layouts and seeds as ranges, all with all or in pairs."""
    assert cells_of("figure6") == cells_of("doorkey", preset="figure6")
    assert cells_of("figure4") == cells_of("montezuma-ladders", preset="figure4")
    assert cells_of("figure3") == cells_of("montezuma-ladders", preset="figure3")
    assert cells_of("figure6", preset="paper") == cells_of("doorkey", preset="paper")
    assert not any(cell.stage == "train-options" for cell in cells_of("figure3", preset="paper"))
    ten = cells_of("figure6", "layout_seeds=210-219", seeds="0")
    agents = [cell.columns for cell in ten if cell.stage == "train-meta" and cell.columns["agent"] == "meta"]
    assert [columns["layout_seed"] for columns in agents] == [*range(210, 220)]
    pairs = cells_of("doorkey", "layout_seeds=7,8", "baselines=ppo-tuned", seeds="3,5")
    places = {(cell.columns["layout_seed"], cell.columns["seed"]) for cell in pairs if "layout_seed" in cell.columns}
    assert places == {(7, 3), (8, 5)}
    with pytest.raises(UserError, match="10 layouts cannot be paired with 2 seeds"):
        cells_of("figure6", seeds="0,1")


@pytest.mark.parametrize("words", ["doorkey --seed=", "rooms --set truths=", "choosing --set layouts="])
def test_a_run_without_an_agent_is_refused(words: str, tmp_path: Path) -> None:
    refuses("a run needs at least one", "run", *words.split(), "--out", tmp_path / "out")
