"""Settings, presets and their errors (the command line's contract in the house rules)."""

import tomllib
from dataclasses import dataclass
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

import hypogoal
from hypogoal.core.config import as_dict, describe, from_values, resolve, setting
from hypogoal.core.errors import UserError
from hypogoal.domains.base import defaults_of
from hypogoal.experiments.run import config_class_of
from hypogoal.settings import TABLES, configuration, described

PRESETS = Path(hypogoal.__file__).parent / "presets"


@dataclass(frozen=True)
class Example:
    steps: int = setting(10, "steps", unit="steps", low=1, high=1000)
    rate: float = setting(0.5, "rate", low=0.0)
    kind: str = setting("a", "kind", choices=("a", "b"))
    on: bool = setting(True, "switch")
    seeds: tuple[int, ...] = setting((1, 2), "seeds", low=0)


def resolved(*assignments: str, **options: object) -> Example:
    return resolve(Example, stage="example", options=options, assignments=assignments)


def test_precedence_is_set_over_option_over_preset_over_default(tmp_path: Path) -> None:
    """--set > option > preset > default."""
    preset = tmp_path / "own.toml"
    preset.write_text("[example]\nsteps = 20\nrate = 1\nkind = 'b'\n")
    config = resolve(
        Example,
        stage="example",
        preset=str(preset),
        options={"steps": 30, "rate": 2.0, "kind": None},
        assignments=["steps=40"],
    )
    assert config == Example(steps=40, rate=2.0, kind="b", on=True, seeds=(1, 2))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[train_ensemble]\nsteps = 3", "Did you mean 'train-ensemble'"),
        ("[trane]\nsteps = 3", "A preset has tables for collect, "),
        ("steps = 7\n[train-ensemble]\nmembers = 3", "no such table in a preset: steps in "),
    ],
)
def test_what_belongs_to_no_stage_is_no_preset(tmp_path: Path, text: str, words: str) -> None:
    """Spec G2: a mistyped table must not pass for one that changes nothing."""
    preset = tmp_path / "own.toml"
    preset.write_text(text)
    with pytest.raises(UserError, match=words):
        resolve(Example, stage="train-ensemble", preset=str(preset), tables=TABLES)


def test_a_domains_defaults_stand_between_the_presets_and_the_general_ones(tmp_path: Path) -> None:
    """Preset > the domain's default > default; an unknown key of a domain is told like any other."""
    preset = tmp_path / "own.toml"
    preset.write_text("[example]\nsteps = 20\n")
    config = resolve(Example, stage="example", preset=str(preset), defaults={"steps": 5, "rate": 3.0})
    assert (config.steps, config.rate, config.kind) == (20, 3.0, "a")
    with pytest.raises(UserError, match="no setting: rates"):
        resolve(Example, stage="example", defaults={"rates": 3.0})
    assert {row["name"]: row["default"] for row in describe(Example, ({"steps": 5}, "its own"))}["steps"] == 5


def test_texts_become_values() -> None:
    config = resolved("steps=1_000", "rate=1e-3", "on=false", "seeds=3,4,5")
    assert config == Example(steps=1000, rate=1e-3, on=False, seeds=(3, 4, 5))


@pytest.mark.parametrize(
    ("assignment", "words"),
    [
        ("step=3", "Did you mean 'steps'"),
        ("steps=0", "Allowed: 1 .. 1000"),
        ("steps=1001", "out of range"),
        ("steps=many", "It must be int"),
        ("steps=2.5", "It must be int"),
        ("rate=nan", "not finite"),
        ("kind=c", "Choose one of a, b"),
        ("on=perhaps", "true or false"),
        ("seeds=1,-1", "out of range"),
        ("steps", "key=value"),
    ],
)
def test_each_mistake_gets_one_line(assignment: str, words: str) -> None:
    with pytest.raises(UserError) as caught:
        resolved(assignment)
    assert words in str(caught.value) and "\n" not in str(caught.value)


def test_unknown_and_broken_presets(tmp_path: Path) -> None:
    broken = tmp_path / "broken.toml"
    broken.write_text("[example\n")
    for preset, words in (("nosuch", "demo"), (str(broken), "not valid TOML"), (str(tmp_path / "no.toml"), "no such")):
        with pytest.raises(UserError, match=words):
            resolve(Example, stage="example", preset=preset)


@pytest.mark.parametrize(
    ("experiment", "preset"), [(path.parent.name, path.stem) for path in sorted(PRESETS.glob("*/*.toml"))]
)
def test_the_presets_resolve_for_every_stage(experiment: str, preset: str) -> None:
    """Every table of a preset is a stage, every key a setting, with a value in range."""
    tables = tomllib.loads((PRESETS / experiment / f"{preset}.toml").read_text())
    assert set(tables) <= set(TABLES)
    for stage in TABLES:
        config_class, defaults = config_class_of(stage, experiment), defaults_of(experiment, stage)
        config = resolve(config_class, stage=stage, preset=preset, domain=experiment, defaults=defaults)
        assert from_values(type(config), as_dict(config), stage) == config


@pytest.mark.parametrize("stage", ["train-options", "train-meta"])
def test_what_was_published_keeps_its_settings(stage: str) -> None:
    """Spec D3: DoorKey's own defaults end exploration early and update often; presets of published results do not."""
    published = {"paper": (8_000, 4), "choosing": (8_000, 16), "demo": (8_000, 16)}
    for preset, settings in {None: (2_000, 8), "figure6": (2_000, 8), **published}.items():
        config = configuration(stage, "doorkey", preset, [], {})
        assert (config.epsilon_steps, config.update_interval) == settings
    rows = {row["name"]: row for row in described(config_class_of(stage), stage, "doorkey")}
    assert (rows["epsilon_steps"]["default"], rows["update_interval"]["default"]) == (2_000, 8)
    assert defaults_of("doorkey", stage) == {"epsilon_steps": 2_000, "update_interval": 8}


def test_the_paper_preset_has_the_papers_tables() -> None:
    """Spec C6, D3, E3: Tables 3, 4 and 5 to the letter."""
    ensemble = resolve(config_class_of("train-ensemble"), stage="train-ensemble", preset="paper")
    assert (ensemble.learning_rate, ensemble.diversity_weight, ensemble.members) == (2e-4, 1e-4, 3)
    assert (ensemble.l2_weight, ensemble.batch_size) == (1e-4, 64)
    assert (ensemble.class_weight_negative, ensemble.class_weight_positive) == (0.5, 0.5)
    meta = resolve(config_class_of("train-meta"), stage="train-meta", preset="paper")
    assert (meta.replay, meta.update_interval, meta.target_interval, meta.target_tau) == (100_000, 4, 10, 1.0)
    assert (meta.epsilon_steps, meta.epsilon_final, meta.epsilon_from) == (8_000, 0.01, "start")
    assert (meta.option_learning_rate, meta.option_batch, meta.option_timeout) == (2.5e-4, 32, 10)
    assert (meta.decisions, meta.entropy, meta.gae_lambda, meta.meta_batch, meta.epochs) == (100, 0.01, 0.97, 64, 10)
    assert (meta.steps, meta.max_episode_steps, meta.experience, meta.network) == (1_500_000, 500, "own", "paper")
    assert (meta.meta_network, meta.head) == ("paper", "gaussian")
    run = resolve(config_class_of("run"), stage="run", preset="paper")
    assert not run.pretrain and run.paired
    assert len(set(run.layout_seeds)) == len(set(run.seeds)) == 10, "ten agents, each with an ensemble of its own"
    collect = resolve(config_class_of("collect"), stage="collect", preset="paper")
    assert collect.door_label == "in-front"


def test_the_paper_preset_has_the_papers_ladders() -> None:
    """Spec D4, F1, F3: Figures 3 and 4 for every number of labelled ladder groups, ten seeds."""
    run = resolve(config_class_of("run", "montezuma"), stage="run", preset="paper", domain="montezuma")
    assert run.groups == run.option_groups == tuple(range(1, 8))
    assert len(set(run.seeds)) == 10 and run.ladders
    ensemble = resolve(config_class_of("train-ensemble"), stage="train-ensemble", preset="paper", domain="montezuma")
    beyond = {"view": "full", "threshold": "0.5", "unlabelled_bn": False}
    assert {name: getattr(ensemble, name) for name in beyond} == beyond


@pytest.mark.parametrize("stage", TABLES)
def test_every_setting_has_a_meaning_and_its_default_is_allowed(stage: str) -> None:
    """'hypogoal config' says something of each setting."""
    config_class = config_class_of(stage)
    assert all(row["meaning"] for row in describe(config_class))
    from_values(config_class, as_dict(config_class()), stage)


@given(st.text(max_size=40))
def test_no_text_crashes_the_parser(text: str) -> None:
    """Any --set text either resolves or is a UserError."""
    for key in ("steps", "rate", "kind", "on", "seeds"):
        lines = 0
        try:
            resolved(f"{key}={text}")
        except UserError as error:
            lines = str(error).count("\n")
        assert lines == 0
