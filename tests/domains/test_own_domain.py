"""A user's own domain goes through the stages without a change to hypogoal (Spec B6)."""

import json
from pathlib import Path

import pytest
from command_line import refuses, run, settings

import hypogoal
from hypogoal.cli import main
from hypogoal.core.artefacts import open_artefact
from hypogoal.core.errors import UserError
from hypogoal.data import open_dataset
from hypogoal.domains.base import load_domain
from hypogoal.options.tables import Episodes
from hypogoal.stages.train_baseline import train_baseline

TESTS = Path(__file__).parents[1]


@pytest.fixture(autouse=True)
def importable(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(TESTS))
    monkeypatch.setenv("HYPOGOAL_TRUST", "1")


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


@pytest.mark.parametrize("agent", ["ppo", "dqn"])
def test_baselines_play_an_own_domain(tmp_path: Path, agent: str) -> None:
    """Spec E7, B6: on images that no 8 x 8 cells fill, of a layout whose shortest path nobody knows."""
    train = ["train-baseline", "own_domain:ODD", "--agent", agent, "--out", str(tmp_path / agent), "-q"]
    few = settings("steps=128", "max_episode_steps=20")
    run(*train, *few)
    facts = json.loads((tmp_path / agent / "layout.json").read_text(encoding="utf-8"))
    assert (facts["shortest_path"], facts["random_success"], facts["random_episodes"]) == (None, None, 0)
    assert json.loads((tmp_path / agent / "manifest.json").read_text())["config"]["domain"] == "own_domain:ODD"


@pytest.mark.parametrize(
    ("domain", "message"),
    [
        ("NAMELESS", "different names that are usable as file names: "),
        ("TWICE", "different names that are usable as file names: End, end"),
        ("STACKED", "observations have their channels, or stacked frames, first: uint8 (4, 48, 48)"),
        ("FRAMES", "observations are stacks of pictures: uint8 (4, 48, 48, 3). Give pictures as uint8 (H, W, C), "),
        ("TURNED", "the environment gave an observation that does not fit its space: uint8 (48, 48, 3)"),
        ("RAISING", "your code raised AttributeError: "),
    ],
)
def test_what_is_wrong_with_an_own_domain_is_one_line(domain: str, message: str, tmp_path: Path) -> None:
    """Spec B6, G2: at once, not when all is played; of the user's own code its place."""
    err = refuses(message, "collect", f"corridor_env:{domain}", "--out", tmp_path / "data.h5", "-q")
    assert domain != "RAISING" or "corridor_env.py, line " in err
    assert not list(tmp_path.glob("data.h5"))


def test_success_is_what_the_domain_says_wherever_it_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Spec B6, F5: in the table of episodes, the evaluation; by reward it would be another."""
    monkeypatch.setenv("HYPOGOAL_TRUST", "1")
    few = {"steps": 2_048, "max_episode_steps": 20}
    train_baseline("corridor_env:SWIFT", tmp_path / "ppo", quiet=True, **few)
    episodes = Episodes.read(tmp_path / "ppo" / "episodes.csv")
    succeeded, cut = episodes.succeeded, ~episodes.terminated
    assert (succeeded == (episodes.length <= 5))[~cut].all() and succeeded[cut].any()
    assert (~succeeded & (episodes.reward > 0)).any()
    run("evaluate", tmp_path)
    agent = json.loads((tmp_path / "evaluation" / "metrics.json").read_text())["agents"][0]
    assert agent["success"]["mean"] == pytest.approx(succeeded[-100:].mean())


def test_a_domains_own_settings_reach_all_who_play_in_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Spec B6: states are collected, options and agents trained, baselines, films and judgements made in one world."""
    import corridor_env

    monkeypatch.setenv("HYPOGOAL_TRUST", "1")
    data, folder = tmp_path / "run" / "data.h5", tmp_path / "run"
    small = settings("steps=60", "states=30", "mirrored=true")
    play = settings("steps=200", "environments=2", "warm_up=50")
    few = settings("steps=64", "environments=2", "max_episode_steps=20")
    network = settings("steps=5", "workers=1")
    commands = (
        ["collect", "corridor_env:MIRRORED", "--out", str(data), *small],
        ["train-ensemble", str(data), "--out", str(folder / "ensemble"), *network],
        ["train-options", str(folder / "ensemble"), "--out", str(folder / "options"), *play],
        ["train-meta", str(folder / "ensemble"), "--out", str(folder / "meta"), *play],
        ["train-baseline", "corridor_env:MIRRORED", "--data", str(data), "--out", str(folder / "ppo"), *few],
        ["evaluate", str(folder)],
        ["report", str(folder), "--videos", "1"],
    )
    for command in commands:
        corridor_env.Mirrored.played.clear()
        run(*command, *([] if command[0] == "report" else ["-q"]))
        worlds = {*corridor_env.Mirrored.played}
        assert worlds == (set() if command[0] == "train-ensemble" else {True}), command
    env = hypogoal.load_options(folder / "meta").make_env()
    assert env.unwrapped.mirrored


def test_baselines_play_in_the_world_of_the_data(tmp_path: Path) -> None:
    """Spec E7: a wrong key ends episodes where it did in the data; not on states of another domain."""
    data = tmp_path / "data.h5"
    few = settings("wrong_key=ends", "heldout_layouts=1")
    run("collect", "doorkey", "--out", data, *few, "-q")
    steps = ["--set", "steps=64", "--set", "environments=2", "--layout-seed", "1", "-q"]
    run("train-baseline", "doorkey", "--data", data, "--out", tmp_path / "ppo", *steps)
    world = {"door_label": "open", "wrong_key": "ends"}
    assert open_artefact(tmp_path / "ppo").config["domain_config"] == world
    # On layout 1 a wrong key is in the way.
    assert json.loads((tmp_path / "ppo" / "layout.json").read_text())["shortest_path"] is None
    assert main(["train-baseline", "montezuma", "--data", str(data), "--out", str(tmp_path / "other"), *steps]) == 2
