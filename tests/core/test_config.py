"""Settings, presets and what is said of mistakes in them."""

import tomllib
from pathlib import Path
from typing import Any

import pytest

import hypogoal
from hypogoal.core.config import (
    MODELS,
    OWN,
    STAGES,
    Config,
    assigned,
    integers,
    known,
    model_of,
    part,
    resolve,
    setting,
)
from hypogoal.core.errors import UserError
from hypogoal.core.presets import TABLES, as_toml, described, preset
from hypogoal.domains.doorkey.domain import DoorKeyConfig
from hypogoal.domains.find import settings_of
from hypogoal.experiments.experiment import config_class_of
from hypogoal.hypotheses.config import TrainEnsembleConfig
from hypogoal.meta.config import MetaConfig, TrainMetaConfig
from hypogoal.options.config import PaperConfig

PRESETS = Path(hypogoal.__file__).parent / "presets"


class Example(Config):
    """What a stage may have. More of it."""

    steps: int = setting(10, "steps", unit="steps", source="Table 1", low=1, high=1000)
    rate: float = setting(0.5, "rate", low=0.0)
    kind: str = setting("a", "kind", choices=("a", "b"))
    code: str = setting("a", "code", choices=("a", "b"), own=True)
    on: bool = setting(True, "switch")
    seeds: tuple[int, ...] = setting((1, 2), "seeds", low=0)
    names: tuple[str, ...] = setting(("x",), "names", choices=("x", "y"))


class Slow(Config):
    """Only slow ones."""

    patience: int = setting(3, "patience", low=1)


class Fast(Config):
    """Only fast ones."""

    speed: float = setting(2.0, "speed")


class Either(Slow, Fast):
    """Code of one's own."""


class Staged(Example):
    """A stage with parts."""

    pace: Slow | Fast | None = part("code", {"a": Slow, "b": Fast, OWN: Either})


def resolved(*assignments: str) -> Any:
    return resolve(Example, assigned(assignments), stage="example")


def test_texts_become_values() -> None:
    config = resolved("steps=1_000", "rate=1e-3", "on=no", "seeds=3, 5-7,4", "names=", "code=mine:Class", "kind=b")
    values = {"steps": 1000, "rate": 1e-3, "on": False, "seeds": (3, 5, 6, 7, 4), "names": ()}
    assert config == Example(**values, code="mine:Class", kind="b")
    assert resolved("steps=3e2").steps == 300 and isinstance(resolved("steps=3e2").steps, int)
    assert integers("0-3,7") == [0, 1, 2, 3, 7]


@pytest.mark.parametrize(
    ("value", "words"),
    [
        ({"step": 3}, "example has no setting: step. Did you mean 'steps'? See 'hypogoal config example'."),
        ({"steps": 0}, "value not allowed: steps=0 in example. Allowed: 1 .. 1000."),
        ({"steps": "many"}, "valid integer, unable to parse string as an integer: steps='many' in example"),
        ({"steps": "1e400"}, "steps=inf"),
        ({"steps": True}, "must be a number: steps=True"),
        ({"rate": "nan"}, "finite number: rate='nan' in example. Allowed: 0.0 .."),
        ({"kind": "c"}, "kind='c' in example. Allowed: a|b."),
        ({"code": "c"}, "Allowed: a|b|module:object."),
        ({"on": "perhaps"}, "valid boolean"),
        ({"seeds": "1,-1"}, "Allowed: 0 .."),
        ({"seeds": "1,x"}, "seeds='1,x'"),
        ({"seeds": "0-999999999"}, "at most 10000 integers"),
        ({"seeds": 3}, "valid tuple"),
        ({"kind": "c\n" * 300}, "kind="),
    ],
)
def test_each_mistake_gets_one_line(value: dict[str, Any], words: str) -> None:
    with pytest.raises(UserError) as caught:
        resolve(Example, value, stage="example")
    line = str(caught.value)
    assert words in line and "\n" not in line and len(line) < 400


def test_what_is_no_assignment_or_no_list_is_refused() -> None:
    for text in ("steps", "=3", ""):
        with pytest.raises(UserError, match="--set needs key=value"):
            assigned([text])
    with pytest.raises(UserError, match=r"not integers: '3-'. Write them as 0-3,7\."):
        integers("3-")
    with pytest.raises(UserError, match=r"a range goes up, over at most 10000 integers: '9-3'\."):
        integers("9-3")


def test_later_layers_win_and_none_is_not_given() -> None:
    """The domain's defaults, a preset, what is typed."""
    layers = {"steps": 20, "rate": 1.0, "kind": "b"}, {"steps": 30, "rate": 2}, {"steps": "40", "kind": None}
    assert resolve(Example, *layers, stage="example") == Example(steps=40, rate=2.0, kind="b")


def test_a_part_has_its_settings_where_it_is_chosen() -> None:
    """Flat names; a part's setting without the part is dropped from presets and refused where typed."""
    assert resolve(Staged, {"patience": 5}, stage="staged").flat() == Example().flat() | {"patience": 5}
    fast = resolve(Staged, {"patience": 5}, {"code": "b", "speed": 3}, stage="staged")
    assert fast.pace == Fast(speed=3.0) and fast.part(Fast) is fast.pace and "patience" not in fast.flat()
    with pytest.raises(TypeError, match="these settings have no Slow"):
        fast.part(Slow)
    own = resolve(Staged, {"patience": 5, "speed": 1, "code": "mine:Class"}, stage="staged")
    assert own.pace == Either(patience=5, speed=1)
    with pytest.raises(UserError) as caught:
        resolve(Staged, {"code": "b"}, {"patience": 5}, stage="staged")
    told = "staged has this setting only beside another choice: patience. See 'hypogoal config staged'."
    assert str(caught.value) == told
    with pytest.raises(UserError, match=r"staged has no setting: patients. Did you mean 'patience'"):
        resolve(Staged, {"patients": 5}, {}, stage="staged")
    with pytest.raises(UserError, match=r"code='c' in staged. Allowed: a\|b\|module:object"):
        resolve(Staged, {"code": "c", "patience": 5}, {}, stage="staged")
    of_a_manifest = known(Staged, {"steps": 7, "gone": 1, "speed": 9.0, "patience": 2})
    read = resolve(Staged, of_a_manifest, {}, stage="staged")
    assert (read.steps, read.pace) == (7, Slow(patience=2))


def test_settings_are_described_with_their_parts() -> None:
    rows = {row["name"]: row for row in described(Staged, ({"steps": "9", "patience": 4}, "its own"))}
    assert [*rows] == [*Example.model_fields, "patience", "speed"]
    expected = {"type": "int", "default": 9, "unit": "steps", "meaning": "steps", "source": "its own"}
    assert rows["steps"] == {"name": "steps", "allowed": "1 .. 1000", "part": "What a stage may have"} | expected
    assert rows["speed"]["part"] == "Only fast ones" and rows["code"]["allowed"] == "a|b|module:object"
    assert (rows["kind"]["source"], rows["names"]["default"], rows["patience"]["default"]) == ("", ["x"], 4)
    table = tomllib.loads(as_toml("staged", [*rows.values()]))["staged"]
    assert table == {name: row["default"] for name, row in rows.items()}


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[train_ensemble]\nsteps = 3", "no such table in a preset: train_ensemble in "),
        ("[trane]\nsteps = 3", "A preset has tables for collect, "),
        ("steps = 7\n[train-ensemble]\nmembers = 3", "no such table in a preset: steps in "),
        ("collect = 3", "no such table in a preset: collect in "),
        ("[collect\n", "the preset cannot be read"),
        ("[collect]\nx = '\udcff'", "the preset cannot be read"),
        (None, "no such preset: .* Choose one of choosing, demo, figure6, paper, or give a .toml file"),
    ],
)
def test_a_broken_preset_is_one_line(tmp_path: Path, text: str | None, words: str) -> None:
    file = tmp_path / "own.toml"
    if text is not None:
        file.write_bytes(text.encode(errors="surrogateescape"))
    for name in [str(file)] if text else [str(file), "nosuch"]:
        with pytest.raises(UserError, match=words):
            preset(name, "collect")


@pytest.mark.parametrize(("domain", "name"), [(file.parent.name, file.stem) for file in sorted(PRESETS.glob("*/*"))])
def test_the_presets_resolve_for_every_stage(domain: str, name: str) -> None:
    """Every table of a preset is a stage, every key a setting, with a value in range; a manifest gives it back."""
    for stage in STAGES:
        config = settings_of(Config, stage, domain, name)
        assert resolve(config_class_of(stage, domain), config.flat(), stage=stage) == config
    assert resolve(config_class_of("run", domain), preset(name, "run", domain), stage="run")


@pytest.mark.parametrize("stage", TABLES)
def test_every_setting_has_a_meaning_and_its_default_is_allowed(stage: str) -> None:
    """'hypogoal config' says something of each setting."""
    model = config_class_of(stage)
    assert all(row["meaning"] for row in described(model))
    assert resolve(model, resolve(model, stage=stage).flat(), {}, stage=stage) == resolve(model, stage=stage)


def test_the_paper_preset_has_the_papers_tables() -> None:
    """Spec C6, D3, D5, E3: Tables 3, 4 and 5 to the letter; no options are learned beforehand."""
    ensemble = settings_of(TrainEnsembleConfig, "train-ensemble", "doorkey", "paper")
    assert (ensemble.learning_rate, ensemble.diversity_weight, ensemble.members) == (2e-4, 1e-4, 3)
    assert (ensemble.l2_weight, ensemble.batch_size) == (1e-4, 64)
    assert (ensemble.class_weight_negative, ensemble.class_weight_positive) == (0.5, 0.5)
    meta = settings_of(TrainMetaConfig, "train-meta", "doorkey", "paper")
    learner, ppo = meta.part(PaperConfig), meta.part(MetaConfig)
    assert (learner.replay, learner.update_interval, learner.target_interval) == (100_000, 4, 10)
    assert (learner.epsilon_steps, learner.epsilon_final, learner.epsilon_from) == (8_000, 0.01, "start")
    assert (learner.option_learning_rate, learner.option_batch, meta.option_timeout) == (2.5e-4, 32, 10)
    assert (ppo.decisions, ppo.gae_lambda, ppo.meta_batch, ppo.epochs) == (100, 0.97, 64, 10)
    assert (meta.steps, meta.max_episode_steps, meta.experience, meta.network) == (1_500_000, 500, "own", "paper")
    assert (ppo.meta_network, ppo.head) == ("paper", "gaussian")
    run: Any = resolve(config_class_of("run"), preset("paper", "run"), stage="run")
    assert not run.pretrain
    assert len(set(run.layout_seeds)) == len(set(run.seeds)) == 10, "ten agents, each with an ensemble of its own"
    assert settings_of(DoorKeyConfig, "collect", "doorkey", "paper").door_label == "in-front"


def test_the_paper_preset_has_the_papers_ladders() -> None:
    """Spec D4, F1, F3: Figures 3 and 4 for every number of labelled ladder groups, ten seeds."""
    run: Any = resolve(config_class_of("run", "montezuma"), preset("paper", "run", "montezuma"), stage="run")
    assert run.groups == run.option_groups == tuple(range(1, 8))
    assert len(set(run.seeds)) == 10 and run.ladders
    ensemble = settings_of(TrainEnsembleConfig, "train-ensemble", "montezuma", "paper")
    assert (ensemble.view, ensemble.threshold, ensemble.unlabelled_bn) == ("full", "0.5", False)


def test_stages_have_no_more_settings_than_a_reader_can_take() -> None:
    counts = {stage: len(described(model_of(stage))) for stage in MODELS}
    assert counts["train-ensemble"] <= 20 and counts["train-options"] <= 33 and counts["train-meta"] <= 41
