"""Experiments as data (Spec A6, G4): what their cells are, in which order they can run, and what they cost."""

from itertools import pairwise
from pathlib import Path

import pytest

from hypogoal.core.errors import UserError
from hypogoal.experiments.cells import Cell, Plan, moved
from hypogoal.experiments.named import EXPERIMENTS
from hypogoal.experiments.records import check_same, write_plan
from hypogoal.settings import configuration
from hypogoal.stages.sweep import plan

OUT = Path("somewhere")


@pytest.mark.parametrize(
    ("experiment", "changes"),
    [
        ("doorkey", ["layout_seeds=100,101", "seeds=0,1"]),
        ("doorkey", ["pretrain=false"]),
        ("choosing", []),
        ("montezuma-ladders", ["ladders=1L,2-6", "seeds=0,1"]),
    ],
)
def test_every_cell_needs_only_what_cells_before_it_write(experiment: str, changes: list[str]) -> None:
    """Spec A6: an order in which they can run; no two write the same place; evaluate waits for all, report for it."""
    cells = plan(experiment, OUT, assignments=changes).cells
    made: set[Path] = set()
    for cell in cells:
        assert set(cell.needs) <= made
        assert cell.out not in made
        made.add(cell.out)
    *others, evaluation, report = cells
    needed = {need for cell in others for need in cell.needs} | set(evaluation.needs)
    assert needed == {cell.out for cell in others} and report.needs == (evaluation.out,)
    assert len({cell.name for cell in cells}) == len(cells)
    assert {cell.arguments[0] for cell in others} <= set(EXPERIMENTS[experiment].stages)


def test_the_ladders_experiment_has_every_method_group_and_control() -> None:
    """Spec F1, F3, D4: methods x N x seeds of ensembles; options for each ladder, and the oracle beside them."""
    changes = ["groups=1,2", "ladders=1L,2-6", "seeds=0,1,2", "option_groups=2", "methods=dbat,cnn"]
    cells = plan("montezuma-ladders", OUT, assignments=[*changes, "option_methods=dbat"]).cells
    stages = [cell.arguments[0] for cell in cells]
    assert stages.count("collect") == 2 and stages.count("train-ensemble") == 2 * 2 * 3
    options = [cell for cell in cells if cell.arguments[0] == "train-options"]
    assert sum("termination=oracle" in cell.arguments for cell in options) == 2 * 3
    assert len(options) == 2 * 3 * 2


def test_choosing_has_cells_of_its_own_and_a_preset_of_its_worlds() -> None:
    """Each method on ten layouts with seeds of their own, options learned in the plain world, and planned."""
    planned = plan("doorkey", OUT, preset="choosing")
    assert planned == plan("choosing", OUT) != plan("doorkey", OUT)
    cells = {name: [cell for cell in planned.cells if cell.stage == name] for name in ("train-options", "train-meta")}
    assert [len(own) for own in cells.values()] == [30, 60]
    learned = [cell for cell in cells["train-meta"] if "--options" in cell.arguments]
    assert len(learned) == 30 == sum("network=planned" in cell.arguments for cell in cells["train-meta"])
    assert [cell.needs[1] for cell in learned] == [cell.out for cell in cells["train-options"]]
    where = {tuple(dict(cell.axes)[axis] for axis in ("layout_seed", "seed")) for cell in cells["train-meta"]}
    assert len(where) == len({layout for layout, _ in where}) == len({seed for _, seed in where}) == 10
    assert all("choosing" in cell.arguments for own in cells.values() for cell in own), "the preset"
    practice, play = (configuration(stage, "doorkey", "choosing", ()) for stage in cells)
    assert (practice.until, practice.steps, practice.world, practice.chooser) == (0.95, 400_000, (), "random")
    assert (play.cap, play.steps, play.world) == (1.5, 50_000, ("wrong_key=ends",))
    stages = {cell.stage for cell in plan("choosing", OUT, assignments=["learned=false"]).cells}
    assert "train-options" not in stages and "train-meta" in stages
    with pytest.raises(UserError, match=r"choosing has a preset of its own: demo. Give choosing\."):
        plan("choosing", OUT, preset="demo")


def test_each_variant_gives_one_more_ensemble_per_method_and_seed() -> None:
    """Spec F1: the settings that are compared stand in the commands, and what has none of them stays."""
    changes = ["groups=1", "seeds=0,1", "methods=dbat,none", "variants=unlabelled_bn=false,steps=9 network=montezuma"]
    cells = plan("montezuma-ladders", OUT, assignments=changes).cells
    trained = [cell for cell in cells if cell.arguments[0] == "train-ensemble"]
    assert len(trained) == 3 * 2 * 2
    assert sum("unlabelled_bn=false" in cell.arguments for cell in trained) == 4
    assert {len(cell.out.relative_to(OUT).parts) for cell in trained} == {3}  # evaluate looks no deeper
    short = [cell for cell in trained if "steps=9" in cell.arguments]
    assert len(short) == 4 and all("network=montezuma" in cell.arguments for cell in short)


def settings(cell: Cell) -> dict[str, str]:
    """What a cell's ``--set`` say: of two for one setting the last."""
    words = cell.arguments
    return dict(word.split("=", 1) for before, word in pairwise(words) if before == "--set")


def test_what_all_cells_are_given_undoes_no_variant_and_no_method() -> None:
    """Spec F1: the single CNN has one member and a variant its own setting, whatever --set train-ensemble.KEY says."""
    common = [f"train-ensemble.{pair}" for pair in ("members=3", "diversity=none", "batch_size=8")]
    changes = ["groups=1", "variants=batch_size=16", "ladders=1L", "option_groups=1", "train-options.start=2-6"]
    cells = plan("montezuma-ladders", OUT, assignments=[*changes, *common, "train-options.termination=learned"]).cells
    trained = [cell for cell in cells if cell.stage == "train-ensemble"]
    for cell in trained:
        axes, has = dict(cell.axes), settings(cell)
        assert has["diversity"] == ("dbat" if axes["method"] == "dbat" else "none")
        assert has["members"] == ("1" if axes["method"] == "cnn" else "3")
        assert has["batch_size"] == ("16" if axes["variant"] else "8")
        assert not {"--members", "--diversity"} & {*cell.arguments}  # before which any --set would go
    options = [cell for cell in cells if cell.stage == "train-options"]
    assert {settings(cell)["start"] for cell in options} == {"1L"}
    assert [settings(cell)["termination"] for cell in options].count("oracle") == 1


def test_controls_and_baselines_keep_the_agents_budget() -> None:
    """Spec E6, E7: as many steps as options and agent together, also where those were changed for all cells."""
    changes = ["train-meta.steps=5000", "train-options.steps=3000", "train-meta.chooser=ppo"]
    changes += ["train-baseline.steps=7", "train-baseline.setting=tuned"]
    for cell in plan("doorkey", OUT, preset="demo", assignments=changes).cells:
        agent, has = dict(cell.axes).get("agent"), settings(cell)
        if cell.stage in ("train-meta", "train-baseline"):
            assert has["steps"] == ("5000" if agent == "meta" else "8000")
        assert has.get("setting", "paper") == ("tuned" if str(agent).endswith("-tuned") else "paper")
        if cell.stage == "train-meta":
            assert has["chooser"] == ("random" if agent == "meta-random" else "ppo")
    for given, instead in (("train-meta.layout_seed=3", "layout_seeds"), ("train-baseline.agent=dqn", "baselines")):
        with pytest.raises(UserError, match=f"Set .*{instead}.* instead"):
            plan("doorkey", OUT, assignments=[given])


def begun(run: Path, *arguments: str) -> None:
    """A folder in which the sweep of one ensemble was begun."""
    write_plan(run, Plan("x", [Cell("e", ("train-ensemble", "d.h5", *arguments), run / "e")], 1))


def test_a_sweep_is_the_same_whatever_the_order_of_its_settings(tmp_path: Path) -> None:
    """Spec G4: it goes on, as does one whose cells were called otherwise; one that meant something else does not."""

    def same(*arguments: str) -> None:
        check_same(tmp_path, [Cell("e", ("train-ensemble", "d.h5", *arguments), tmp_path / "e")])

    settings = ("--set", "diversity=none", "--set", "members=1")
    begun(tmp_path, *settings, "--seed", "0", "--preset", "demo", "--set", "steps=6")
    same("--preset", "demo", "--set", "steps=6", *settings, "--seed", "0")
    for words, arguments in (
        ("'--set steps=6', not '--set steps=7'", ("--set", "steps=6", "--set", "steps=7", "--seed", "0")),
        ("'--seed 0', not '--seed 1'", ("--set", "steps=6", "--seed", "1")),
    ):
        with pytest.raises(UserError, match=words):
            same("--preset", "demo", *settings, *arguments)
    begun(tmp_path, "--seed", "0")
    check_same(tmp_path, [Cell("e-0.1", ("train-ensemble", "d.h5", "--seed", "0"), tmp_path / "e")])
    begun(tmp_path, "--set", "members=1", "--set", "members=3")  # the last counts
    with pytest.raises(UserError, match="begun with"):
        same("--set", "members=3", "--set", "members=1")


def test_a_sweep_of_one_seed_can_be_given_more(tmp_path: Path) -> None:
    """Spec G4: its cells are called as those of many; those of ``run``, and of what was begun so, have short names."""
    one = plan("doorkey", tmp_path, preset="demo")
    assert tmp_path / "meta" in {cell.out for cell in plan("doorkey", tmp_path, preset="demo", short=True).cells}
    write_plan(tmp_path, one)
    check_same(tmp_path, plan("doorkey", tmp_path, preset="demo", seeds="0-2").cells)
    assert plan("doorkey", tmp_path, preset="demo", short=True).cells == one.cells
    write_plan(tmp_path / "x", plan("doorkey", tmp_path / "x", preset="demo", short=True))
    check_same(tmp_path / "x", plan("doorkey", tmp_path / "x", preset="demo").cells)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        (["option_groups=3", "groups=1,2", "ladders=1L"], "no cell before it makes: ensemble/dbat/groups-3"),
        (["option_methods=none", "methods=dbat", "ladders=1L"], "no cell before it makes: ensemble/none"),
        (["train-meta.steps=3"], "no such stage"),
    ],
)
def test_a_ladders_experiment_that_cannot_be_is_told_in_one_line(changes: list[str], words: str) -> None:
    """Options of ensembles that are not there, settings of a stage that it has not."""
    with pytest.raises(UserError, match=words):
        plan("montezuma-ladders", OUT, assignments=changes)


@pytest.mark.parametrize(
    ("experiment", "changes", "words"),
    [
        ("doorkey", ["seeds=0,1,0"], "ensemble-seed-0"),
        ("doorkey", ["layout_seeds=5-7,6,7"], "options-layout-6-seed-0"),
        ("doorkey", ["controls=random,random"], "meta-random-layout-100-seed-0"),
        ("doorkey", ["paired=true", "layout_seeds=1,2", "seeds=3,3"], "ensemble-seed-3"),
        ("montezuma-ladders", ["seeds=0,0", "groups=1"], "ensemble-dbat-groups-1-seed-0"),
    ],
)
def test_a_value_that_is_given_twice_is_told_in_one_line(experiment: str, changes: list[str], words: str) -> None:
    """Spec A6, G2: two cells of one output would be made twice, and their sweep never be finished."""
    with pytest.raises(UserError, match=rf"two cells would be the same: {words}\. Give each value once"):
        plan(experiment, OUT, assignments=changes)
    apart = plan("doorkey", OUT, assignments=["paired=true", "layout_seeds=1,1", "seeds=3,4"]).cells
    assert len({cell.out for cell in apart}) == len(apart)


def test_every_cell_of_a_named_experiment_has_a_place() -> None:
    """Spec G4: axes that tell all cells of a stage apart."""
    for experiment, changes in (("figure6", []), ("montezuma-ladders", ["ladders=1L", "variants=batch_size=16"])):
        cells = plan(experiment, OUT, assignments=changes).cells
        trained = [(cell.stage, cell.axes) for cell in cells if cell.stage.startswith("train")]
        assert len(set(trained)) == len(trained)


def test_the_papers_figures_are_experiments() -> None:
    """Spec E4, F1, F3, F5: each with its preset; seeds and layouts as ranges."""
    figure = plan("figure6", OUT).cells
    assert figure == plan("doorkey", OUT, preset="figure6").cells
    assert plan("figure3", OUT).cells == plan("montezuma-ladders", OUT, preset="figure3").cells
    assert plan("figure4", OUT).cells == plan("montezuma-ladders", OUT, preset="figure4").cells
    assert figure == plan("figure6", OUT, preset="figure6").cells
    with pytest.raises(UserError, match=r"figure6 has a preset of its own: demo. Give figure6 or paper, or doorkey"):
        plan("figure6", OUT, preset="demo")
    whole = plan("montezuma-ladders", OUT, preset="paper").cells
    assert plan("figure4", OUT, preset="paper").cells == whole
    classifiers = [cell for cell in plan("figure3", OUT, preset="paper").cells if cell.stage == "train-ensemble"]
    assert classifiers == [cell for cell in whole if cell.stage == "train-ensemble"]
    assert not any(cell.stage == "train-options" for cell in plan("figure3", OUT, preset="paper").cells)
    assert plan("figure6", OUT, preset="paper").cells == plan("doorkey", OUT, preset="paper").cells
    ten = plan("figure6", OUT, seeds="0", assignments=["paired=false", "layout_seeds=210-219"]).cells
    agents = [cell for cell in ten if cell.stage == "train-meta" and dict(cell.axes)["agent"] == "meta"]
    assert [dict(cell.axes)["layout_seed"] for cell in agents] == [*range(210, 220)]


def test_layouts_and_seeds_in_pairs() -> None:
    """Spec E4: ten agents, each with a layout and an ensemble of its own; as many of both or one line."""
    pairs = plan("doorkey", OUT, seeds="3,5", assignments=["paired=true", "layout_seeds=7,8", "baselines=ppo-tuned"])
    axes = [dict(cell.axes) for cell in pairs.cells if cell.stage == "train-meta" or cell.stage == "train-baseline"]
    assert len(axes) == 4 * 2
    assert {(found["layout_seed"], found["seed"]) for found in axes} == {(7, 3), (8, 5)}
    assert [dict(cell.axes)["seed"] for cell in pairs.cells if cell.stage == "train-ensemble"] == [3, 5]
    with pytest.raises(UserError, match="10 layouts cannot be paired with 1 seeds"):
        plan("figure6", OUT, seeds="0")


def test_a_moved_cell_is_the_same_in_another_place() -> None:
    """Paths that begin with the run's folder move, others and folders of a similar name do not."""
    words = ("train-meta", "runs/x/a", "runs/xy", "--out", "runs/x/b")
    cell = Cell("a", words, Path("runs/x/b"), (Path("runs/x/a"),))
    there = moved(cell, "runs/x", "{run}")
    assert there.arguments == ("train-meta", "{run}/a", "runs/xy", "--out", "{run}/b")
    assert (there.out, there.needs) == (Path("{run}/b"), (Path("{run}/a"),))
    assert moved(there, "{run}", "runs/x") == cell
    for name in ("report", "train-meta", "collect", "doorkey", "steps=6", "demo"):
        cells = plan("doorkey", Path(name), preset="demo", assignments=["train-meta.steps=6"]).cells
        elsewhere = plan("doorkey", Path("{run}"), preset="demo", assignments=["train-meta.steps=6"]).cells
        assert [moved(cell, name, "{run}") for cell in cells] == elsewhere
        assert [moved(cell, "{run}", name) for cell in elsewhere] == cells
