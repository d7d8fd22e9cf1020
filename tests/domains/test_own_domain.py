"""A user's own domain goes through the stages without a change to hypogoal (Spec B6)."""

import json
from pathlib import Path

import corridor_env
import pytest
from command_line import FIXED, run, settings

import hypogoal
from hypogoal.core.errors import UserError
from hypogoal.data import open_dataset
from hypogoal.domains.find import IMPORTED, load_domain, settings_of
from hypogoal.films import agent_to_film, films_of
from hypogoal.hypotheses.config import TrainEnsembleConfig

pytestmark = pytest.mark.usefixtures("trusted")


def test_an_own_domain_goes_through_the_stages(corridor_run: Path) -> None:
    """Spec B6: ``module:object`` is collected; its hypotheses, options and meta-policy are trained."""
    assert open_dataset(corridor_run / "data.h5").counts()["labelled"]["left-end"] == {"states": 54, "positives": 9}
    for stage in ("options", "meta"):
        facts = json.loads((corridor_run / stage / "layout.json").read_text())
        assert (facts["shortest_path"], facts["random_success"], facts["random_episodes"]) == (None, None, 0)
    assert (corridor_run / "meta" / "episodes.csv").read_text().count("\n") > 10


def test_what_is_no_domain_is_refused() -> None:
    """Spec B6, G2: one line that says what a domain needs."""
    with pytest.raises(UserError, match="not a domain"):
        load_domain("own_domain:CorridorConfig")
    with pytest.raises(UserError, match="cannot be loaded"):
        load_domain("own_domain:NOTHING")


def test_a_domains_own_settings_reach_all_who_play_in_it(tmp_path: Path) -> None:
    """Spec B6: states are collected, options and agents trained, baselines, films and judgements made in one world."""
    data, folder = tmp_path / "run" / "data.h5", tmp_path / "run"
    small = settings("steps=60", "states=30", "mirrored=true")
    play = settings("steps=80", "environments=2", "warm_up=50")
    few = settings("steps=64", "environments=2", "max_episode_steps=20")
    network = settings("steps=5", "workers=1", *FIXED)
    commands = (
        ["collect", "corridor_env:MIRRORED", "--out", str(data), *small],
        ["train-ensemble", str(data), "--out", str(folder / "ensemble"), *network],
        ["train-options", str(folder / "ensemble"), "--out", str(folder / "options"), *play],
        ["train-meta", str(folder / "ensemble"), "--out", str(folder / "meta"), *play],
        ["train-baseline", "corridor_env:MIRRORED", "--data", str(data), "--out", str(folder / "ppo"), *few],
        ["evaluate", str(folder)],
    )
    for command in commands:
        corridor_env.Mirrored.played.clear()
        run(*command, "-q")
        worlds = {*corridor_env.Mirrored.played}
        assert worlds == (set() if command[0] == "train-ensemble" else {True}), command
    corridor_env.Mirrored.played.clear()
    films_of(agent_to_film(folder), "meta", 1)
    assert {*corridor_env.Mirrored.played} == {True}
    env = hypogoal.load_options(folder / "meta").make_env()
    assert env.unwrapped.mirrored


def test_a_domain_that_does_not_load_is_no_missing_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its settings are not dropped without a word; data of a domain that is not installed is trained on without it."""
    monkeypatch.syspath_prepend(str(tmp_path))
    (tmp_path / "damaged_domain.py").write_text("import no_such_module\n")
    settings_of(TrainEnsembleConfig, "train-ensemble", "not-installed")
    settings_of(TrainEnsembleConfig, "train-ensemble", IMPORTED)
    for name in ("damaged_domain:DOMAIN", "no_such_module:DOMAIN"):
        with pytest.raises(UserError, match="the domain cannot be loaded: ModuleNotFoundError"):
            settings_of(TrainEnsembleConfig, "train-ensemble", name)
